"""Every operation asked with values that nobody expects: a problem document with a status that it names."""

import json

from pytest import fixture, mark, param

from ground_service.app import create_app
from ground_service.contacts.commanding.service import enter_command
from ground_service.passes.archive_import import import_archive
from ground_service.planning.service import WindowEntry, add_window
from ground_service.settings import Settings
from tests.serving import TestClient

NS = 1_000_000_000
TEXTS = (
    "", "x", "1", "-1", "0", "1e308", "nan", "true", "a" * 5000, "ä\u202e☾", "%00", "' OR 1=1 --",
    "../../etc/passwd",
)  # fmt: skip
NUMBERS = ("1", "0", "-1", str(2**31), str(2**63), str(2**70), "1.5", "x", "")
BODIES = [
    json.loads(line.replace("BIG", str(2**70)))
    for line in r"""null
[]
{}
"text"
5
{"a": 1}
[[[[]]]]
{"start": 5}
{"points": []}
{"points": [{"ticks": BIG}]}
{"name": "test_connection", "spacecraft_id": 76, "arguments": {"x": [[]]}}
{"name": "insert_activity", "spacecraft_id": 76, "arguments": {"release_ticks": 1e400, "items": "x"}}
{"name": "perform_function", "spacecraft_id": 76, "arguments": {"function_id": {}, "argument_1": null}}
{"start": "2029-08-07T06:00:00Z", "stop": "2029-08-07T06:00:00Z", "spacecraft_id": 76}
{"start": "9999-12-31T23:59:59Z", "stop": "0001-01-01T00:00:00Z", "spacecraft_id": 76, "cadence_s": 0.1}
{"name": "x", "start": "2262-04-11T23:47:16Z", "stop": "2262-04-11T23:47:17Z", "spacecraft_id": 0}
{"altitude_km": {"min": -1e308, "max": 1e308}, "step_s": 1, "maximum_duration_s": 30, "latitude_deg": {"min": 0}}
{"latitude_deg": {"min": "x", "max": 1e9}}
{"state": "approved", "reason": "\u0000"}
{"reason": "x"}
{"predecessor_id": 1}""".splitlines()
]
OCTETS = (
    b"", b"\x00" * 100, b"PK\x03\x04", b"CCSDS_OEM_VERS = 2.0\n", b"\x1a\xcf\xfc\x1d" * 50, b"[" * 100_000,
    b'{"a":' * 20_000,
)  # fmt: skip


@fixture(scope="module")
def client(synthetic_pass, tmp_path_factory):
    """A service with one of everything; errors are answered, not raised, as they are in operation."""
    settings = Settings(home=tmp_path_factory.mktemp("nasty"), upload_limit_mib=1)
    with TestClient(create_app(settings, inline_jobs=True), raise_server_exceptions=False) as opened:
        ground = opened.app.state.ground
        import_archive(ground, synthetic_pass.folder)
        enter_command(ground, "test_connection", {}, spacecraft_id=76, actor="ann")
        add_window(ground, WindowEntry("w", 2_000_000_000 * NS, 2_000_000_100 * NS, 15.0, 76), actor="ann")
        yield opened


def checked(client, method, path, operation, **request):
    answer = client.request(method, path, **request)
    message = f"{method} {path[:100]} {str(request)[:200]}: {answer.status_code} {answer.text[:300]}"
    assert answer.status_code < 500, message
    # A path that no operation fits is answered before any operation is asked.
    known = {*operation["responses"], "404", "405", "307"}
    assert str(answer.status_code) in known, message
    if answer.status_code >= 400:
        assert answer.headers["content-type"] == "application/problem+json", message
        assert answer.json()["status"] == answer.status_code


@mark.parametrize("every", [20, param(1, marks=mark.campaign)])
def test_no_request_makes_the_server_fail(client, every):
    """Each parameter and body is asked with one of `every` values, the next one with other values."""
    document = client.get("/api/v1/openapi.json").json()
    asked = 0

    def some(values):
        return values[asked % every :: every]

    for template, operations in document["paths"].items():
        for method, operation in operations.items():
            parameters = operation.get("parameters", [])
            in_path = [p["name"] for p in parameters if p["in"] == "path"]
            # Reports of a pass that is not there: those of one that is take seconds each, and are tested elsewhere.
            plain = template.replace("{pass_id}/reports", "99/reports")
            for name in in_path:
                plain = plain.replace("{" + name + "}", {"parameter": "power_w", "spacecraft_id": "76"}.get(name, "1"))
            for name in in_path:
                for value in some((*NUMBERS, "ä", "a" * 300, "0" * 32)):
                    if template.endswith(("/reports", "/summary")) and value == "1":
                        continue
                    path = template.replace("{" + name + "}", value)
                    for other in in_path:
                        path = path.replace("{" + other + "}", "1")
                    checked(client, method.upper(), path, operation)
                    asked += 1
            for parameter in parameters:
                if parameter["in"] == "query":
                    for value in some((*TEXTS, *NUMBERS)):
                        checked(client, method.upper(), plain, operation, params={parameter["name"]: value})
                        asked += 1
                elif parameter["in"] == "header":
                    for value in some(("", "x", "*", '"a", "b"', "x" * 3000)):
                        checked(client, method.upper(), plain, operation, headers={parameter["name"]: value})
                        asked += 1
            if "requestBody" in operation:
                content = operation["requestBody"]["content"]
                if "application/json" in content:
                    for body in some(BODIES):
                        octets = json.dumps(body).encode()
                        checked(client, method.upper(), plain, operation, content=octets,
                                headers={"content-type": "application/json"})  # fmt: skip
                        asked += 1
                for octets in some(OCTETS):
                    kind = next(iter(content))
                    checked(
                        client, method.upper(), plain, operation, content=octets, headers={"content-type": kind},
                    )  # fmt: skip
                    asked += 1
    assert asked > 4000 / every
