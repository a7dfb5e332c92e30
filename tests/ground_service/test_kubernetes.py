"""The Kustomize base: valid by the schemas of Kubernetes, confined, and in agreement with itself and the program."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from sqlalchemy import make_url

from ground_service.settings import Settings
from linna.cli import GROUPS

BASE = Path(__file__).resolve().parents[2] / "deploy"
KUSTOMIZATION: dict[str, Any] = yaml.safe_load((BASE / "kustomization.yaml").read_text())
RESOURCES: list[dict[str, Any]] = [
    document
    for name in KUSTOMIZATION["resources"]
    for document in yaml.safe_load_all((BASE / name).read_text())
]
VERSIONS = ("1.31.0", "1.37.0")
(GENERATED,) = KUSTOMIZATION["configMapGenerator"]
LINES = (BASE / GENERATED["envs"][0]).read_text().splitlines() + GENERATED["literals"]
CONFIGURATION = dict(line.split("=", 1) for line in LINES if line and not line.startswith("#"))
"""Settings of every process: the declaration that the compose file has, and names of this cluster."""


def name_of(resource: dict[str, Any]) -> str:
    return f"{resource['kind']} {resource['metadata']['name']}"


def pod_of(resource: dict[str, Any]) -> dict[str, Any] | None:
    spec = resource.get("spec", {})
    template = spec.get("jobTemplate", {}).get("spec", {}).get("template") or spec.get("template")
    return None if template is None else template["spec"]


PODS = {name_of(one): pod for one in RESOURCES if (pod := pod_of(one)) is not None}


def test_every_file_is_part_of_the_base() -> None:
    assert {f"kubernetes/{path.name}" for path in BASE.glob("kubernetes/*")} == {*KUSTOMIZATION["resources"]}
    names = [name_of(one) for one in RESOURCES]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("resource", [one for one in RESOURCES if one["kind"] != "Cluster"], ids=name_of)
def test_a_resource_is_valid(resource: dict[str, Any], version: str) -> None:
    import kubernetes_validate

    kubernetes_validate.validate(resource, version, strict=True)


def test_the_base_leads_to_the_primary_and_keeps_a_copy_of_every_commit() -> None:
    """The resource of the operator has no schema here."""
    (cluster,) = (one for one in RESOURCES if one["kind"] == "Cluster")
    (policy,) = (one for one in RESOURCES if name_of(one) == "NetworkPolicy database-servers")
    spec = cluster["spec"]
    (service,) = spec["managed"]["services"]["additional"]
    host = make_url(CONFIGURATION["LINNA_DATABASE_URL"]).host
    assert service["selectorType"] == "rw" and service["serviceTemplate"]["metadata"]["name"] == host
    assert spec["instances"] >= 3 and spec["postgresql"]["synchronous"]["number"] == 1
    # The base permits its pods to connect to pods with this label.
    assert spec["inheritedMetadata"]["labels"] == policy["spec"]["podSelector"]["matchLabels"]


@pytest.mark.parametrize("name", sorted(PODS))
def test_a_pod_meets_the_restricted_standard_and_has_limits(name: str) -> None:
    pod = PODS[name]
    assert pod["automountServiceAccountToken"] is False
    assert pod["securityContext"]["runAsNonRoot"] and pod["securityContext"]["runAsUser"] >= 10_000
    assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert not {"hostNetwork", "hostPID", "hostIPC"} & set(pod)
    for volume in pod["volumes"]:
        assert set(volume) <= {"name", "persistentVolumeClaim", "emptyDir", "projected"}
    for container in pod["containers"]:
        assert container["securityContext"] == {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        }
        assert container["resources"]["limits"]["memory"] and container["resources"]["requests"]["cpu"]
        mounted = {mount["name"] for mount in container["volumeMounts"]}
        assert mounted == {volume["name"] for volume in pod["volumes"]}


def test_what_stays_is_watched_spread_and_survives_the_loss_of_a_node() -> None:
    budgets = {
        tuple(one["spec"]["selector"]["matchLabels"].items()): one["spec"]["minAvailable"]
        for one in RESOURCES
        if one["kind"] == "PodDisruptionBudget"
    }
    stays = [one for one in RESOURCES if one["kind"] == "Deployment"]
    assert len(stays) == 2
    for one in stays:
        selector, template = one["spec"]["selector"]["matchLabels"], one["spec"]["template"]
        assert template["metadata"]["labels"] == selector
        assert one["spec"]["replicas"] >= 2 and budgets[tuple(selector.items())] == 1
        assert "livenessProbe" in template["spec"]["containers"][0]
        assert template["spec"]["topologySpreadConstraints"][0]["labelSelector"]["matchLabels"] == selector
    (api,) = PODS["Deployment linna-api"]["containers"]
    assert api["readinessProbe"]["httpGet"]["path"] == "/readyz"
    assert api["livenessProbe"]["httpGet"]["path"] == "/healthz"


def test_secrets_are_files_of_those_who_need_them() -> None:
    keys = {"objects_access_key", "objects_secret_key"}
    holders = {}
    for name, pod in PODS.items():
        (volume,) = (one["projected"] for one in pod["volumes"] if one["name"] == "secrets")
        sources = [one["secret"] for one in volume["sources"]]
        holders[name] = {item["path"] for one in sources for item in one.get("items", [{"path": "all"}])}
    assert holders == {
        "Deployment linna-api": {"all", "database_password"},
        "Deployment linna-worker": {"all", "database_password"},
        "Job linna-migrate": {*keys, "database_password", "database_owner_password"},
        "CronJob linna-backup": {*keys, "database_backup_password"},
    }
    assert not any(one["kind"] == "Secret" for one in RESOURCES)


def test_every_variable_is_a_setting_and_every_command_exists() -> None:
    known = {f"LINNA_{name.upper()}" for name in Settings.model_fields}
    known |= {f"LINNA_{name}_PASSWORD_FILE" for name in ("DATABASE", "MIGRATION_DATABASE", "BROKER")}
    assert GENERATED["envs"] == ["service.env"] and set(CONFIGURATION) <= known
    assert not any(one["kind"] == "ConfigMap" for one in RESOURCES)
    for pod in PODS.values():
        for container in pod["containers"]:
            assert container["envFrom"] == [{"configMapRef": {"name": GENERATED["name"]}}]
            assert {variable["name"] for variable in container.get("env", [])} <= known
            words = container.get("args") or container["command"][2].removeprefix("exec linna ").split()
            assert words[0] in GROUPS


def test_the_network_refuses_what_is_not_named() -> None:
    policies = {one["metadata"]["name"]: one["spec"] for one in RESOURCES if one["kind"] == "NetworkPolicy"}
    assert policies["default-deny"] == {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}

    def members(name: str) -> set[str]:
        (expression,) = policies[name]["podSelector"]["matchExpressions"]
        return set(expression["values"])

    assert members("api-ingress") == {"api"}
    assert members("database") == {"api", "worker", "migrate", "backup"}
    assert members("broker") == {"api", "worker"}
    assert members("outside") == {"api", "worker", "backup"}
    assert [name for name, spec in policies.items() if spec.get("ingress")] == [
        "database-servers",
        "api-ingress",
    ]


def test_the_backup_cannot_change_the_archive() -> None:
    (container,) = PODS["CronJob linna-backup"]["containers"]
    (mount,) = (one for one in container["volumeMounts"] if one["name"] == "archive")
    assert mount["readOnly"] is True
    (url,) = (one["value"] for one in container["env"] if one["name"] == "LINNA_DATABASE_URL")
    assert url.startswith("postgresql+psycopg://linna_backup@")


def test_the_ingress_refuses_metrics_and_health() -> None:
    (ingress,) = (one for one in RESOURCES if one["kind"] == "Ingress")
    (rule,) = ingress["spec"]["rules"]
    backends = {
        (path["path"], path["pathType"]): path["backend"]["service"]["name"] for path in rule["http"]["paths"]
    }
    assert backends.pop(("/", "Prefix")) == "linna-api"
    assert backends == {(f"/{name}", "Exact"): "linna-refused" for name in ("metrics", "healthz", "readyz")}
    services = {one["metadata"]["name"]: one["spec"] for one in RESOURCES if one["kind"] == "Service"}
    assert "selector" not in services["linna-refused"] and services["linna-api"]["selector"]
    assert not any(one["kind"] in ("Endpoints", "EndpointSlice") for one in RESOURCES)
