"""Every operation asked with what its schema allows and does not: no server error, answers as it says."""

import json
import os

import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from pydantic import SecretStr
from pytest import fixture, mark, param
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from ground_service.app import create_app
from ground_service.ground import ground_from_settings
from ground_service.jobs.service import enter_job
from ground_service.passes.archive_import import import_archive
from ground_service.settings import Settings
from tests.serving import TestClient

V1 = "/api/v1"
CHECKS = [
    not_a_server_error, status_code_conformance, content_type_conformance, response_headers_conformance,
    response_schema_conformance,
]  # fmt: skip
EXAMPLES = int(os.environ.get("SCHEMA_EXAMPLES", "1"))
"""Number of requests of each kind to each operation; SCHEMA_EXAMPLES=50, for instance, sends more."""


@schemathesis.serializer("application/zip")
def _as_octets(_context, value):
    """Bodies of archives: whatever octets were made up."""
    octets = getattr(value, "data", value)
    return octets if isinstance(octets, bytes) else json.dumps(octets).encode()


class Queue:
    """Enters jobs and has none of them done: making hundreds of reports is not what is looked at here."""

    def __init__(self, ground):
        self._ground = ground

    def submit(self, kind, arguments, *, job_id=None):
        return enter_job(self._ground, kind, arguments, job_id=job_id)

    def start(self, job_id):
        pass

    def resume(self):
        pass

    def close(self):
        pass


@fixture(scope="module", params=["sqlite", param("postgresql", marks=mark.campaign)])
def client(request, synthetic_pass, tmp_path_factory):
    deployment = Settings(home=tmp_path_factory.mktemp("fuzz"))
    if request.param == "postgresql":
        url = request.getfixturevalue("migrated_postgres")()
        deployment = deployment.model_copy(update={"database_url": SecretStr(url)})
    with ground_from_settings(deployment) as ground:
        import_archive(ground, synthetic_pass.folder)
    with TestClient(create_app(deployment, inline_jobs=True), raise_server_exceptions=False) as opened:
        opened.app.state.dispatcher = Queue(opened.app.state.ground)
        yield opened


@mark.parametrize("mode", [GenerationMode.POSITIVE, GenerationMode.NEGATIVE])
def test_every_operation_answers_as_its_schema_says(client, mode):
    document = client.get(f"{V1}/openapi.json").json()
    schema = schemathesis.openapi.from_dict(document)
    asked = set()
    for found in schema.get_all_operations():
        operation = found.ok()

        @settings(
            max_examples=EXAMPLES, deadline=None, database=None, derandomize=True, phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )  # fmt: skip
        @given(case=operation.as_strategy(generation_mode=mode))
        def ask(case):
            asked.add((case.method, case.operation.path))
            wanted = case.as_transport_kwargs(base_url="http://testserver")
            answer = client.request(
                wanted["method"],
                wanted["url"],
                **{
                    name: wanted[name]
                    for name in ("params", "headers", "json", "content", "files")
                    if wanted.get(name) is not None
                },
                **({"content": wanted["data"]} if isinstance(wanted.get("data"), (bytes, str)) else {}),
            )
            case.validate_response(answer, checks=CHECKS)

        try:
            ask()
        except schemathesis.errors.SchemathesisError as error:
            if mode is GenerationMode.POSITIVE:
                raise
            # Nothing that this operation is asked with could be wrong.
            assert not operation.body, error
    described = {(m.upper(), p) for p, one in document["paths"].items() for m in one}
    if mode is GenerationMode.POSITIVE:
        assert asked == described
    assert len(asked) > len(described) // 2
