"""A client generated from the OpenAPI document by openapi-python-client works against the service."""

import importlib
import json
import os
import sys
from datetime import UTC, datetime
from pathlib import Path

from pytest import fixture

from ground_service.app import create_app
from ground_service.settings import Settings
from tests.serving import TestClient, ran

PACKAGE = "linna_generated_client"


@fixture(scope="module")
def service(tmp_path_factory):
    with TestClient(create_app(Settings(home=tmp_path_factory.mktemp("api")))) as opened:
        yield opened


@fixture(scope="module")
def generated(service, tmp_path_factory):
    folder = tmp_path_factory.mktemp("client")
    (folder / "openapi.json").write_text(json.dumps(service.get("/api/v1/openapi.json").json()))
    command = [
        str(Path(sys.executable).with_name("openapi-python-client")), "generate",
        "--path", str(folder / "openapi.json"), "--output-path", str(folder / PACKAGE), "--meta", "none",
        "--fail-on-warning",
    ]  # fmt: skip
    # The generator calls ruff, which lies in the same folder.
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    made = ran(command, cwd=folder, env=environment)
    assert made.returncode == 0, made.stdout + made.stderr
    sys.path.insert(0, str(folder))
    yield folder / PACKAGE
    sys.path.remove(str(folder))
    for name in [name for name in sys.modules if name.startswith(PACKAGE)]:
        del sys.modules[name]


@fixture
def client(service, generated):
    made = importlib.import_module(PACKAGE).Client(base_url="http://testserver")
    return made.set_httpx_client(service)


def operation(name):
    return importlib.import_module(f"{PACKAGE}.api.{name}")


def test_every_operation_has_a_function(service, generated):
    paths = service.get("/api/v1/openapi.json").json()["paths"]
    wanted = {f"{one['tags'][0]}.{one['operationId']}" for methods in paths.values() for one in methods.values()}
    found = {f"{file.parent.name}.{file.stem}" for file in (generated / "api").glob("*/*.py")}
    assert wanted <= found
    for file in generated.rglob("*.py"):
        compile(file.read_text(), str(file), "exec")  # a warning is an error


def test_a_pass_is_defined_listed_and_shown_with_its_types(client):
    models = importlib.import_module(f"{PACKAGE}.models")
    start = datetime(2029, 8, 7, 6, tzinfo=UTC)
    given = models.PassDefinition(name="evening", start=start, stop=start.replace(hour=7), spacecraft_id=76)
    made = operation("passes.define_pass").sync(client=client, body=given)
    assert isinstance(made, models.PassDetail)
    assert (made.name, made.start, made.instance) == ("evening", start, "flight")
    page = operation("passes.list_passes").sync(client=client, limit=1)
    assert isinstance(page, models.PassSummaryPage) and [one.id for one in page.items] == [made.id]
    shown = operation("passes.get_pass").sync(made.id, client=client)
    assert shown == made


def test_errors_are_problem_documents(client):
    models = importlib.import_module(f"{PACKAGE}.models")
    answer = operation("passes.get_pass").sync_detailed(99, client=client)
    assert answer.status_code == 404
    assert isinstance(answer.parsed, models.Problem) and answer.parsed.status == 404


def test_a_file_is_uploaded(client):
    types = importlib.import_module(f"{PACKAGE}.types")
    import io

    answer = operation("telemetry.upload_telemetry").sync_detailed(
        client=client, body=types.File(payload=io.BytesIO(bytes(2230))), spacecraft_id=76
    )
    assert answer.status_code == 202 and answer.parsed.octets == 2230
