"""Hours of new users and the cost of requests: campaigns; here their records and tables."""

from pytest import mark

from benchmarks.campaigns import costs, engineer, operator_http, operator_pages
from benchmarks.campaigns._strangers import Diary, commands_of
from ground_service.app import create_app
from ground_service.settings import Settings


@mark.campaign
def test_an_operator_comes_from_an_empty_folder_to_a_report_by_http():
    assert operator_http.main() == 0


@mark.campaign
def test_an_operator_spends_an_hour_with_the_pages():
    assert operator_pages.main() == 0


@mark.campaign
def test_an_engineer_judges_builds_by_command_line():
    assert engineer.main() == 0


@mark.campaign
def test_no_request_costs_more_than_the_rule_allows():
    assert costs.main([]) == 0


def test_a_wrong_turn_that_harms_or_misleads_fails_the_hour(capsys):
    for kind, status in (("A", 1), ("B", 1), ("C", 0)):
        diary = Diary("an hour")
        assert diary.expect(kind, "what holds", True) and not diary.expect(kind, "what does not", False, 7)
        assert diary.close() == status
        assert f'["{kind}: what does not; found 7"]' in capsys.readouterr().out


def test_commands_and_files_are_those_of_the_page(tmp_path):
    assert 'linna regress suite || [[ ",0,1," == *",$?,"* ]]' in list(commands_of("tutorials/own-build.md", tmp_path))
    assert (tmp_path / "parameters.toml").read_text() == "detector.score_threshold = 0.8\n"


def test_every_operation_has_a_request_and_every_request_an_operation(tmp_path):
    document = create_app(Settings(home=tmp_path)).openapi()
    paths, schemas = document["paths"], document["components"]["schemas"]
    found = {one["operationId"]: (path, one) for path, methods in paths.items() for one in methods.values()}
    assert {key.split("`")[1] for key in costs.table()} == set(found), (
        "python -m benchmarks.campaigns.costs --missing --write"
    )
    special = {one[0] for one in costs.cases()}
    assert special <= set(found)
    for name, (path, described) in found.items():
        if name not in special:
            assert "{" not in costs.derived(path, described, schemas)[1]


# status, memory in MiB, processor time in s, and whether it is kept
REQUESTS = "200 256 10 1, 200 257 1 0, 200 1 10.1 0, 500 1 1 0, 422 1 1 1"


@mark.parametrize("row", REQUESTS.split(","))
def test_a_request_is_judged_by_memory_processor_time_and_status(row):
    status, memory_mib, processor_s, kept = map(float, row.split())
    cost = costs.Cost("get_status", "", int(status), memory_mib, 0.0, processor_s)
    assert (cost.fault == "") == kept
    assert cost.cells().startswith(f"| `get_status` |  | {status:.0f} | {memory_mib:.0f} | 0 |")
