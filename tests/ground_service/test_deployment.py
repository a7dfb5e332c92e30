"""The compose file and the image as a reviewer reads them; there is no container engine to start them with here."""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import redis
import yaml
from pytest import mark, raises, skip

from ground_service.settings import Settings
from studies.harness.parts import Part, free_port, listens
from tests.ground_service.conftest import cells
from tests.serving import ran

ROOT = Path(__file__).resolve().parents[2]
COMPOSE = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
SERVICES = COMPOSE["services"]
DOCKERFILE = (ROOT / "Dockerfile").read_text()
(SECRETS,) = cells(
    "database_superuser_password | database_owner_password | database_password | database_backup_password | "
    "broker_password | admin_token"
)
OPTIONAL = ("objects_access_key", "objects_secret_key", "oidc_client_secret")
"""Secrets of optional parts: empty files until a setting names them."""

CERTIFICATE = ("certificate", "key")
PROCESSES = ("api", "api2", "worker", "scheduler", "migrate", "backup")
EXACT = re.compile(r"[a-z]+:\d+\.\d+(\.\d+)?-[a-z-]+")


def environment_of(name):
    """Return the environment of a service: the common declaration, then what the service itself states."""
    service, found = SERVICES[name], {}
    if "env_file" in service:
        lines = (ROOT / "deploy/service.env").read_text().splitlines()
        found = dict(line.split("=", 1) for line in lines if line and not line.startswith("#"))
    return found | service.get("environment", {})


def sets(table):
    return {name: set(words.split()) for name, words in cells(table)}


def default_of(text):
    """Return a value with a variable and a default as it is without the variable."""
    return re.sub(r"\$\{[A-Z_]+:-([^}]*)\}", r"\1", text)


@mark.parametrize("name", sorted(SERVICES))
def test_every_service_is_confined(name):
    service = SERVICES[name]
    assert service["read_only"] and service["cap_drop"] == ["ALL"]
    assert "no-new-privileges:true" in service["security_opt"]
    assert service["pids_limit"] and service["mem_limit"]
    assert service["logging"]["options"]["max-size"]
    assert not {"privileged", "pid", "ipc", "devices"} & set(service)
    assert service.get("network_mode", "none") == "none"
    assert not any("docker.sock" in volume for volume in service["volumes"])


def test_images_are_exact_versions_and_the_lock_file_of_the_displays_has_checksums():
    for name in "db", "broker", "proxy":
        assert EXACT.fullmatch(default_of(SERVICES[name]["image"]))
    for name in "PYTHON_IMAGE", "NODE_IMAGE":
        given = default_of(SERVICES["api"]["build"]["args"][name])
        (written,) = re.findall(rf"^ARG {name}=(\S+)$", DOCKERFILE, re.MULTILINE)
        assert given == written and EXACT.fullmatch(written)
    images = set(re.findall(r"^FROM (\S+)", DOCKERFILE, re.MULTILINE)) - {"sources"}
    assert images == {"${PYTHON_IMAGE}", "${NODE_IMAGE}"}
    lock = json.loads((ROOT / "deploy/openmct/package-lock.json").read_text())
    wanted = json.loads((ROOT / "deploy/openmct/package.json").read_text())["dependencies"]
    found = {name: one for name, one in lock["packages"].items() if name}
    assert {f"node_modules/{name}": version for name, version in wanted.items()} == {
        name: one["version"] for name, one in found.items()
    }
    for one in found.values():
        assert "resolved" not in one and one["integrity"].startswith("sha512-")


def test_only_the_proxy_is_reached_from_outside_and_by_default_from_this_machine_alone():
    assert [name for name in SERVICES if "ports" in SERVICES[name]] == ["proxy"]
    assert [default_of(port) for port in SERVICES["proxy"]["ports"]] == ["127.0.0.1:8443:8443"]


def test_a_service_is_in_the_networks_that_it_needs_and_no_others():
    members = {
        network: {name for name in SERVICES if network in SERVICES[name].get("networks", [])}
        for network in COMPOSE["networks"]
    }
    assert members == sets("""
edge | proxy
front | proxy api api2
data | db migrate api api2 worker scheduler backup
queue | broker api api2 worker scheduler
egress | api api2 worker scheduler backup
""")
    inner = {name for name, options in COMPOSE["networks"].items() if (options or {}).get("internal")}
    assert inner == {"front", "data", "queue"}


def test_the_api_believes_the_proxy_and_nobody_else():
    (subnet,) = (entry["subnet"] for entry in COMPOSE["networks"]["front"]["ipam"]["config"])
    assert SERVICES["api"]["environment"]["LINNA_TRUSTED_PROXIES"] == subnet
    assert not default_of(subnet).endswith("/0")


def test_every_process_has_the_same_settings():
    """A setting in the common declaration reaches all; none of them is given to one process alone."""
    own = {name: set(SERVICES[name]["environment"]) for name in PROCESSES}
    without_broker = "LINNA_BROKER_URL LINNA_BROKER_PASSWORD_FILE"
    assert own == sets(f"""
api | LINNA_ALLOWED_HOSTS LINNA_TRUSTED_PROXIES LINNA_BACKUPS
api2 | LINNA_ALLOWED_HOSTS LINNA_TRUSTED_PROXIES LINNA_BACKUPS
worker | LINNA_ALLOWED_HOSTS LINNA_TRUSTED_PROXIES
scheduler | LINNA_ALLOWED_HOSTS LINNA_TRUSTED_PROXIES
migrate | {without_broker} LINNA_MIGRATION_DATABASE_URL LINNA_MIGRATION_DATABASE_PASSWORD_FILE LINNA_BACKUP_ROLE
backup | {without_broker} LINNA_DATABASE_URL LINNA_DATABASE_PASSWORD_FILE
""")
    files = {json.dumps(SERVICES[name]["env_file"]) for name in PROCESSES}
    assert len(files) == 1 and "settings.env" in files.pop()
    assert {name for name in SERVICES if "env_file" in SERVICES[name]} == set(PROCESSES)
    known = {f"LINNA_{name.upper()}" for name in Settings.model_fields}
    known |= {f"LINNA_{name}_PASSWORD_FILE" for name in ("DATABASE", "MIGRATION_DATABASE", "BROKER")}
    assert all(set(environment_of(name)) <= known for name in PROCESSES)


def test_pools_fit_into_the_connections_and_the_role_of_the_backup_changes_nothing():
    text = (ROOT / "ground_service/store/database.py").read_text()
    each = sum(int(re.search(rf"{name}=(\d+)", text)[1]) for name in ("pool_size", "max_overflow"))
    processes = sum(int(default_of(str(SERVICES[name].get("scale", 1)))) for name in PROCESSES)
    permitted = int(re.search(r"max_connections=(\d+)", (ROOT / "deploy/postgres.sh").read_text())[1])
    assert each * processes <= permitted - 10
    backup = SERVICES["backup"]
    assert backup["profiles"] == ["backup"] and backup["restart"] == "no"
    assert "archive:/var/lib/linna:ro" in backup["volumes"]
    assert backup["environment"]["LINNA_DATABASE_URL"].startswith("postgresql+psycopg://linna_backup@")
    assert SERVICES["migrate"]["environment"]["LINNA_BACKUP_ROLE"] == "linna_backup"


def test_secrets_are_files_of_those_who_need_them_and_in_no_command_or_environment():
    assert set(COMPOSE["secrets"]) == {*SECRETS, *OPTIONAL}
    for name, secret in COMPOSE["secrets"].items():
        # A file: contents of variables cannot be given to a container with a read-only root.
        assert secret == {"file": f"${{LINNA_SECRETS_DIR:-./secrets}}/{name}"}
    text = (ROOT / "docker-compose.yml").read_text()
    assert not re.search(r"\$\{?LINNA_[A-Z_]*(PASSWORD|TOKEN)", text)
    holders = {
        name: {user for user in SERVICES if name in SERVICES[user].get("secrets", [])} for name in COMPOSE["secrets"]
    }
    needed = sets("""
database_superuser_password | db
database_owner_password | db migrate
database_password | db migrate api api2 worker scheduler
database_backup_password | db backup
broker_password | broker api api2 worker scheduler
admin_token | migrate
""")
    assert holders == needed | {key: set(PROCESSES) for key in OPTIONAL}
    for service in SERVICES.values():
        for name, value in service.get("environment", {}).items():
            # A password or token is named by a file, and no URL holds one.
            secret = any(word in name for word in ("PASSWORD", "TOKEN", "SECRET"))
            assert not secret or not value or (name.endswith("_FILE") and value.startswith("/run/secrets/"))
            assert not re.search(r"://[^/@]*:[^/@]*@", str(value))


def test_the_service_is_not_the_owner_of_its_schema():
    for name in "api", "worker", "scheduler":
        environment = environment_of(name)
        assert environment["LINNA_DATABASE_URL"].startswith("postgresql+psycopg://linna@")
        assert not {key for key in environment if "MIGRATION" in key or "ALLOW_DATABASE_OWNER" in key}
    owner = SERVICES["migrate"]["environment"]["LINNA_MIGRATION_DATABASE_URL"]
    assert owner.startswith("postgresql+psycopg://linna_owner@")
    roles = (ROOT / "deploy/postgres-roles.sh").read_text()
    assert roles.count("LOGIN NOSUPERUSER NOCREATEDB NOCREATEROLE NOREPLICATION") == 3
    assert "ALTER SCHEMA public OWNER TO linna_owner" in roles


def test_the_runner_has_no_secret_no_network_and_no_archive():
    runner = SERVICES["runner"]
    assert runner["network_mode"] == "none" and "networks" not in runner and "secrets" not in runner
    assert runner["volumes"] == ["exchange:/exchange", "${LINNA_DATA_DIR:-empty-data}:/data:ro"]
    assert set(runner["environment"]) == {"LINNA_LOG_FORMAT", "LINNA_DATA"}
    assert "user" not in runner and "cap_add" not in runner and runner["cap_drop"] == ["ALL"]
    assert runner["security_opt"] == [
        "no-new-privileges:true", "seccomp=deploy/runner-seccomp.json", "apparmor=unconfined",
        "systempaths=unconfined",
    ]  # fmt: skip
    assert "install -y --no-install-recommends bubblewrap" in DOCKERFILE.rpartition("\nFROM ")[2]
    assert all("size=" in place for place in runner["tmpfs"])
    assert runner["memswap_limit"] == runner["mem_limit"]
    (exchange,) = re.findall(r"chmod (\d+) /exchange", DOCKERFILE)
    assert int(exchange, 8) & 0o007 == 0
    assert "exchange:/exchange" in SERVICES["worker"]["volumes"]
    assert environment_of("worker")["LINNA_RUNNER_EXCHANGE"] == "/exchange"
    assert {name for name in SERVICES if "exchange:/exchange" in SERVICES[name]["volumes"]} == {"worker", "runner"}


def sh(name, programs="", *words, **environment):
    """Run a script of the deployment, with a folder of programs before the others."""
    given = {key: str(value) for key, value in environment.items()}
    return ran(
        ["sh", str(ROOT / "deploy" / name), *words],
        env={"PATH": f"{programs}:{os.environ['PATH']}", **given},
        stdin=subprocess.DEVNULL,
    )


def program(folder, name, text):
    """Write a program of this name; return its folder."""
    programs = folder / "programs"
    programs.mkdir()
    (programs / name).write_text(f"#!/bin/sh\n{text}\n")
    (programs / name).chmod(0o755)
    return programs


def test_the_secrets_that_are_missing_are_made_and_those_that_are_there_are_kept(tmp_path):
    folder = tmp_path / "secrets"
    assert sh("secrets.sh", LINNA_SECRETS_DIR=folder, LINNA_ADMIN_TOKEN="given" * 5).returncode == 0
    made = {path.name: path.read_text() for path in folder.rglob("*") if path.is_file()}
    assert set(made) == {*SECRETS, *OPTIONAL, *CERTIFICATE}
    assert {made[name] for name in OPTIONAL} == {""}
    assert made["admin_token"] == "given" * 5
    drawn = [made[name] for name in SECRETS if name != "admin_token"]
    assert len(set(drawn)) == 5 and all(re.fullmatch("[0-9a-f]{48}", one) for one in drawn)
    assert folder.stat().st_mode & 0o077 == 0
    assert sh("secrets.sh", LINNA_SECRETS_DIR=folder, LINNA_ADMIN_TOKEN="other").returncode == 0
    assert {path.name: path.read_text() for path in folder.rglob("*") if path.is_file()} == made


def test_an_error_of_openssl_is_reported(tmp_path):
    programs = program(tmp_path, "openssl", "echo 'a reason' >&2; exit 1")
    done = sh("secrets.sh", programs, LINNA_SECRETS_DIR=tmp_path / "secrets")
    assert done.returncode == 1 and "secrets are in" not in done.stdout
    assert "no certificate was made for localhost:\na reason" in done.stderr


HOLDERS = {
    "redis.sh": ("redis-server", ("broker_password",)),
    "postgres-roles.sh": ("psql", ("database_password", "database_owner_password", "database_backup_password")),
}
"""Scripts that read passwords, with the program that they start and the names of the passwords."""


def start_script(name, secrets, folder):
    """Run a script with these secrets and a program that only prints its arguments and its input."""
    programs = program(folder, HOLDERS[name][0], 'echo "started $*"; cat')
    (folder / "secrets").mkdir()
    for secret, value in secrets.items():
        (folder / "secrets" / secret).write_text(value)
    written = folder / "written"
    done = sh(
        name, programs, LINNA_SECRETS=folder / "secrets", LINNA_REDIS_USERS=written, POSTGRES_USER="postgres",
        POSTGRES_DB="linna",
    )  # fmt: skip
    return done, written


@mark.parametrize("is_empty", [True, False])
@mark.parametrize("name, missing", [(name, secret) for name, (_, secrets) in HOLDERS.items() for secret in secrets])
def test_a_server_does_not_start_with_an_empty_password(name, missing, is_empty, tmp_path):
    secrets = {secret: "given" for secret in HOLDERS[name][1] if secret != missing}
    done, _ = start_script(name, secrets | ({missing: ""} if is_empty else {}), tmp_path)
    assert done.returncode == 2 and "started" not in done.stdout
    (line,) = done.stderr.splitlines()
    assert f"secrets/{missing}: " in line


def test_passwords_may_have_any_character(tmp_path):
    odd = """two words, 'quotes' "and" \\ #%s"""
    done, written = start_script("redis.sh", {"broker_password": odd}, tmp_path)
    assert done.returncode == 0, done.stderr
    assert f" #{hashlib.sha256(odd.encode()).hexdigest()} " in written.read_text() and odd not in written.read_text()


def test_the_broker_grants_what_a_worker_needs_and_no_administration(tmp_path):
    """A right that is missing would be a traceback in the log of the worker every second."""
    for program in "redis-server", "redis-cli":
        if shutil.which(program) is None:
            skip(f"{program} is not installed")
    (tmp_path / "broker_password").write_text("secret")
    port = free_port()
    environment = {**os.environ, "LINNA_SECRETS": str(tmp_path), "LINNA_REDIS_USERS": str(tmp_path / "users.acl")}
    words = ["--port", str(port), "--bind", "127.0.0.1", "--dir", str(tmp_path)]
    broker = Part(
        ["sh", str(ROOT / "deploy/redis.sh"), *words], tmp_path / "redis.log", lambda: listens(port),
        env=environment,
    )  # fmt: skip
    url = f"redis://linna:secret@127.0.0.1:{port}/0"
    log = tmp_path / "worker.log"
    worker = Part(
        [sys.executable, "-m", "linna", "worker"], log, lambda: log.exists() and " ready." in log.read_text(),
        env={**os.environ, "LINNA_HOME": str(tmp_path / "home"), "LINNA_BROKER_URL": url},
    )  # fmt: skip
    try:
        broker.start()
        worker.start()
        time.sleep(2.5)  # its scripts run every second
        worker.finish()
        assert "Error" not in log.read_text()
        client = redis.Redis.from_url(url)
        for command in "CONFIG GET dir", "FLUSHALL", "ACL LIST", "SHUTDOWN":
            with raises(redis.exceptions.NoPermissionError):
                client.execute_command(*command.split())
        client.close()
    finally:
        worker.end()
        broker.end()


@mark.parametrize("name", CERTIFICATE)
def test_a_certificate_without_its_key_is_refused_and_kept(name, tmp_path):
    tls = tmp_path / "tls"
    tls.mkdir()
    (tls / name).write_text("of a certification authority")
    done = sh("secrets.sh", LINNA_SECRETS_DIR=tmp_path)
    (other,) = set(CERTIFICATE) - {name}
    assert done.returncode == 2
    assert done.stderr == f"secrets: expected {tls}/{other} for {tls}/{name}, found none\n"
    assert (tls / name).read_text() == "of a certification authority"
    assert not (tls / other).exists()


def test_nothing_stays_of_a_base_backup_that_fails(tmp_path):
    wal = tmp_path / "wal"
    programs = program(tmp_path, "pg_basebackup", 'mkdir -p "$2" && echo part > "$2/file"; exit 1')
    done = sh("base-backup.sh", programs, LINNA_WAL=wal)
    assert done.returncode == 1 and list((wal / "base").iterdir()) == []


def test_a_segment_that_differs_from_the_archived_one_is_not_overwritten(tmp_path):
    segments, wal = [tmp_path / name for name in ("one", "two")], tmp_path / "wal"
    wal.mkdir()
    for path in segments:
        path.write_text(path.name)
    done = [sh("wal-archive.sh", "", str(path), "0001", LINNA_WAL=wal) for path in (segments[0], *segments)]
    assert [one.returncode for one in done] == [0, 0, 1]
    assert {path.name: path.read_text() for path in wal.iterdir()} == {"0001": "one"}


def test_the_proxy_has_a_second_api_while_one_drains_and_sees_certificates_at_the_documented_reload():
    proxy = (ROOT / "deploy/nginx.conf").read_text()
    upstream = re.findall(r"^ +server (\w+):8042 ", proxy, re.MULTILINE)
    assert upstream == ["api", "api2"] and set(upstream) <= set(SERVICES["proxy"]["depends_on"])
    (idle_s,) = (int(one) for one in re.findall(r"keepalive 32;.*?keepalive_timeout (\d+)s;", proxy, re.DOTALL))
    for name in upstream:
        drain_s = int(environment_of(name)["LINNA_DRAIN_S"])
        # Then 20 s for requests in progress.
        assert idle_s < drain_s and drain_s + 20 < int(SERVICES[name]["stop_grace_period"].removesuffix("s"))
    # The default configuration of nginx names another file with the number of the process.
    program, flag, configuration, *_ = SERVICES["proxy"]["entrypoint"]
    reload = f"`docker compose exec proxy {program} {flag} {configuration} -s reload`"
    for name in "docs/deployment.md", "deploy/prometheus/linna.rules.yml":
        text = (ROOT / name).read_text()
        assert reload in text and text.count("-s reload") == text.count(reload), name
    assert f"./deploy/nginx.conf:{configuration}:ro" in SERVICES["proxy"]["volumes"]
    # A mount of one file keeps the old file when a new one takes its place.
    (mount,) = (one for one in SERVICES["proxy"]["volumes"] if one.endswith(":/run/tls:ro"))
    assert mount == "${LINNA_SECRETS_DIR:-./secrets}/tls:/run/tls:ro"
    used = re.findall(r"ssl_certificate(?:_key)? (\S+);", (ROOT / "deploy/nginx.conf").read_text())
    assert used == [f"/run/tls/{name}" for name in CERTIFICATE]


def test_the_documented_restore_uses_services_volumes_and_folders_that_exist():
    text = (ROOT / "docs/deployment.md").read_text()
    (volume, folder) = re.findall(r"--volume linna_(\w+):(/\w+):ro worker db restore /\w+/", text)[0]
    assert COMPOSE["name"] == "linna" and volume in COMPOSE["volumes"]
    assert f"{volume}:{folder}" in SERVICES["backup"]["volumes"]
    assert "--no-deps --entrypoint linna migrate db upgrade\n" in text
    # The worker writes the archive and has the role of the service, the migration that of the owner.
    assert "archive:/var/lib/linna" in SERVICES["worker"]["volumes"]
    assert "LINNA_MIGRATION_DATABASE_URL" in SERVICES["migrate"]["environment"]


def test_the_image_runs_as_nobody_in_particular_and_holds_every_package_and_no_more():
    stage = DOCKERFILE.split("\nFROM ")[-1]
    (user,) = re.findall(r"^USER (\d+):\d+$", stage, re.MULTILINE)
    assert int(user) >= 10_000
    assert stage.index("USER") > stage.index("COPY")
    assert not re.search(r"^(ADD|RUN .*(curl|wget|chmod 777))", DOCKERFILE, re.MULTILINE)
    copied = {line.split()[1] for line in re.findall(r"^COPY (?!--from).*$", DOCKERFILE, re.MULTILINE)}
    found = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]["find"]
    packages = {name.rstrip("*") for name in found["include"]}
    assert packages <= {line.replace("COPY ", "") for line in copied}
    allowed = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert packages <= allowed and "tests" not in allowed and ".git" not in allowed
    assert (ROOT / ".dockerignore").read_text().splitlines()[0] == "*"
    for name in allowed:
        assert (ROOT / name).exists(), name
