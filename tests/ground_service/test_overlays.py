"""Optional parts of a deployment: overlays of the Kustomize base and of the compose file."""

from __future__ import annotations

import copy
import re
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

from ground_service.settings import SECRETS, URLS, Settings

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
BASE = DEPLOY / "kubernetes"
COMPOSE: dict[str, Any] = yaml.safe_load((DEPLOY.parent / "docker-compose.yml").read_text())
NAMES = ("objects", "oidc")
KNOWN = {f"LINNA_{name.upper()}" for name in Settings.model_fields}
KNOWN |= {f"LINNA_{name.upper()}_FILE" for name in (*URLS, *SECRETS)}


def resources(folder: Path) -> list[dict[str, Any]]:
    names = yaml.safe_load((folder / "kustomization.yaml").read_text())["resources"]
    files = [folder / name for name in names if name.endswith(".yaml")]
    return [one for file in files for one in yaml.safe_load_all(file.read_text())]


def patched(resource: dict[str, Any], operations: list[dict[str, Any]]) -> None:
    """Apply JSON patches (RFC 6902: add, replace, test)."""
    for one in operations:
        *way, last = one["path"].strip("/").split("/")
        place: Any = resource
        for part in way:
            place = place[int(part) if isinstance(place, list) else part]
        if isinstance(place, list):
            if last == "-":
                assert one["op"] == "add"
                place.append(one["value"])
                continue
            last = int(last)
        if one["op"] == "test":
            assert place[last] == one["value"], one
        elif one["op"] == "replace":
            assert place[last] is not None
            place[last] = one["value"]
        else:
            assert one["op"] == "add" and last not in place
            place[last] = one["value"]


def overlaid(name: str) -> dict[str, dict[str, Any]]:
    """Return the resources of an overlay on the base, by kind and name."""
    folder = DEPLOY / "overlays" / name
    written = yaml.safe_load((folder / "kustomization.yaml").read_text())
    assert written["resources"][0] == "../../kubernetes" and written["namespace"] == "linna"
    found = copy.deepcopy([*resources(BASE), *resources(folder)])
    for patch in written["patches"]:
        target = patch["target"]
        text = patch.get("patch") or (folder / patch["path"]).read_text()
        chosen = [
            one
            for one in found
            if one["kind"] == target["kind"]
            and re.fullmatch(target.get("name", ".*"), one["metadata"]["name"])
        ]
        assert chosen, patch
        for one in chosen:
            patched(one, yaml.safe_load(text))
    return {f"{one['kind']} {one['metadata']['name']}": one for one in found}


def pod_of(resource: dict[str, Any]) -> dict[str, Any]:
    spec = resource["spec"]
    return dict((spec.get("jobTemplate", {}).get("spec") or spec)["template"]["spec"])


@pytest.mark.parametrize("name", NAMES)
def test_an_overlay_is_valid_and_sets_what_exists(name: str) -> None:
    found = overlaid(name)
    for one in found.values():
        kubernetes_validate.validate(one, "1.31.0", strict=True)
    data = found[f"ConfigMap linna-{name}"]["data"]
    assert set(data) <= KNOWN and any(key.endswith("_FILE") for key in data)
    used = 0
    for one in found.values():
        if one["kind"] not in ("Deployment", "Job", "CronJob"):
            continue
        pod = pod_of(one)
        (container,) = pod["containers"]
        assert {mount["name"] for mount in container["volumeMounts"]} <= {v["name"] for v in pod["volumes"]}
        if {"configMapRef": {"name": f"linna-{name}"}} not in container.get("envFrom", []):
            continue
        used += 1
        (mount,) = (one for one in container["volumeMounts"] if one["name"] == name)
        (volume,) = (one for one in pod["volumes"] if one["name"] == name)
        assert mount["readOnly"] and volume["secret"]["secretName"] == f"linna-{name}"
        for key, value in data.items():
            assert not key.endswith("_FILE") or value.startswith(f"{mount['mountPath']}/")
    assert used == {"objects": 5, "oidc": 1}[name]


def test_with_an_object_store_only_the_api_has_the_shared_volume() -> None:
    """What its links have received and not yet stored is there."""
    found = overlaid("objects")
    holders = set()
    for name, one in found.items():
        if one["kind"] in ("Deployment", "Job", "CronJob"):
            claims = [v.get("persistentVolumeClaim", {}).get("claimName") for v in pod_of(one)["volumes"]]
            if "linna-archive" in claims:
                holders.add(name)
    assert holders == {"Deployment linna-api"}


@pytest.mark.parametrize("name", NAMES)
def test_a_compose_overlay_changes_services_that_exist_and_sets_what_exists(name: str) -> None:
    text = (DEPLOY / name / "compose.yml").read_text()
    overlay = yaml.safe_load(text)
    assert set(overlay["services"]) <= set(COMPOSE["services"])
    assert f"-f deploy/{name}/compose.yml" in text
    for service in overlay["services"].values():
        assert set(service["environment"]) <= KNOWN
        for key, value in service["environment"].items():
            if key.endswith("_FILE"):
                assert value.removeprefix("/run/secrets/") in service["secrets"]
        assert set(service["secrets"]) <= set(overlay["secrets"])
        for volume in service.get("volumes", []):
            assert volume.partition(":")[0] in overlay["volumes"]
    for key, secret in overlay["secrets"].items():
        assert secret == {"file": f"${{LINNA_SECRETS_DIR:-./secrets}}/{key}"}


def test_services_with_the_object_store_reach_it() -> None:
    overlay = yaml.safe_load((DEPLOY / "objects" / "compose.yml").read_text())["services"]
    for name in ("api", "worker", "backup"):
        networks = [*COMPOSE["services"][name]["networks"], *overlay[name].get("networks", [])]
        assert "egress" in networks, name
