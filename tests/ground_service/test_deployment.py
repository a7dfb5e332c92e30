"""The compose file and the image as a reviewer reads them; there is no container engine to start them with here."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
DOCKERFILE = (ROOT / "Dockerfile").read_text()
SECRETS = ("LINNA_DB_PASSWORD", "LINNA_REDIS_PASSWORD", "LINNA_ADMIN_TOKEN", "REDISCLI_AUTH")
EXACT = re.compile(r"[a-z]+:\d+\.\d+(\.\d+)?-[a-z-]+")


def default_of(text: str) -> str:
    """What a value with a variable and a default is when the variable is not set."""
    return re.sub(r"\$\{[A-Z_]+:-([^}]*)\}", r"\1", text)


@pytest.mark.parametrize("name", sorted(SERVICES))
def test_every_service_is_confined(name: str) -> None:
    service = SERVICES[name]
    assert service["read_only"] and service["cap_drop"] == ["ALL"]
    assert "no-new-privileges:true" in service["security_opt"]
    assert service["pids_limit"] and service["mem_limit"]
    assert service["logging"]["options"]["max-size"]
    assert not {"privileged", "network_mode", "pid", "ipc", "devices"} & set(service)
    assert not any("docker.sock" in volume for volume in service["volumes"])


@pytest.mark.parametrize("name", sorted(set(SERVICES) - {"migrate"}))
def test_every_service_that_stays_is_watched_and_comes_back(name: str) -> None:
    service = SERVICES[name]
    assert service["restart"] == "unless-stopped"
    assert {"test", "interval", "timeout", "retries"} <= set(service["healthcheck"])


def test_nothing_starts_before_what_it_needs() -> None:
    for name in ("api", "worker", "scheduler"):
        assert SERVICES[name]["depends_on"]["migrate"]["condition"] == "service_completed_successfully"
        assert SERVICES[name]["depends_on"]["broker"]["condition"] == "service_healthy"
    assert SERVICES["migrate"]["depends_on"]["db"]["condition"] == "service_healthy"


def test_images_are_exact_versions() -> None:
    for name in ("db", "broker"):
        assert EXACT.fullmatch(default_of(SERVICES[name]["image"]))
    given = default_of(SERVICES["api"]["build"]["args"]["PYTHON_IMAGE"])
    (written,) = re.findall(r"^ARG PYTHON_IMAGE=(\S+)$", DOCKERFILE, re.MULTILINE)
    assert given == written and EXACT.fullmatch(written)
    assert set(re.findall(r"^FROM (\S+)", DOCKERFILE, re.MULTILINE)) == {"${PYTHON_IMAGE}"}


def test_only_the_interface_is_reached_from_outside_and_from_this_machine_alone() -> None:
    assert [name for name in SERVICES if "ports" in SERVICES[name]] == ["api"]
    assert all(port.startswith("127.0.0.1:") for port in SERVICES["api"]["ports"])
    assert COMPOSE["networks"]["inner"] == {"internal": True}
    assert all(SERVICES[name]["networks"] == ["inner"] for name in SERVICES if name != "api")


def test_secrets_have_no_default_and_are_in_no_command() -> None:
    text = (ROOT / "docker-compose.yml").read_text()
    for secret in SECRETS[:3]:
        uses = re.findall(rf"\$\{{{secret}([^}}]*)\}}", text)
        assert uses and all(use.startswith(":?") for use in uses)
    for service in SERVICES.values():
        words = [*service.get("command", []), *service.get("entrypoint", [])]
        words += service.get("healthcheck", {}).get("test", [])
        # A shell may expand a variable inside of the container ($$), where compose does not put its value.
        assert not any(secret in str(word).replace(f"$${secret}", "") for word in words for secret in SECRETS)


def test_one_scheduler_and_workers_without_one() -> None:
    assert [name for name in SERVICES if "--beat" in SERVICES[name].get("command", [])] == ["scheduler"]
    assert "scale" not in SERVICES["scheduler"] and default_of(SERVICES["worker"]["scale"]) == "2"


def test_the_image_runs_as_nobody_in_particular() -> None:
    stage = DOCKERFILE.split("\nFROM ")[-1]
    (user,) = re.findall(r"^USER (\d+):\d+$", stage, re.MULTILINE)
    assert int(user) >= 10_000
    assert stage.index("USER") > stage.index("COPY")
    assert not re.search(r"^(ADD|RUN .*(curl|wget|chmod 777))", DOCKERFILE, re.MULTILINE)


def test_the_image_holds_every_package_and_the_folder_of_the_build_no_more_than_it_needs() -> None:
    copied = {line.split()[1] for line in re.findall(r"^COPY (?!--from).*$", DOCKERFILE, re.MULTILINE)}
    found = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]["find"]
    packages = {name.rstrip("*") for name in found["include"]}
    assert packages <= {line.replace("COPY ", "") for line in copied}
    allowed = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert packages <= allowed and "tests" not in allowed and ".git" not in allowed
    assert (ROOT / ".dockerignore").read_text().splitlines()[0] == "*"
    for name in allowed:
        assert (ROOT / name).exists(), name
