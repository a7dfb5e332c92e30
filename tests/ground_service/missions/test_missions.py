"""Mission descriptions: refused and missing values, revisions, references of passes, automation, receivers."""

import json
import logging
from concurrent.futures import ThreadPoolExecutor

from pytest import mark, raises

from ground_service.access.service import Caller
from ground_service.contacts.commanding.service import enter_command, release_command
from ground_service.errors import Conflict, Forbidden, InvalidInput, NotFound
from ground_service.http.model import Paging
from ground_service.missions import store
from ground_service.missions.frames import mission_of_manifest
from ground_service.missions.model import (
    Evidence,
    Mission,
    format_mission,
    parse_mission,
    read_document,
    weakest_evidence,
)
from ground_service.missions.service import (
    add_mission,
    check_mission,
    check_mission_file,
    enter,
    mission_of_pass,
    read_mission,
    without_tokens,
)
from ground_service.missions.store import approval_in_force, find_revision, list_missions, newest_of_spacecraft
from ground_service.passes.archive_import import import_archive
from ground_service.passes.service import define_pass, get_pass
from ground_service.passes.store import get_pass as stored_pass
from linna import cli
from tests.ground_service.conftest import cells

TEXT = """
schema_version = 1
name = "test"
[spacecraft]
id = 76
[frames]
orientation = "DE421"
[camera]
fov_deg = 120
[reference]
sigma_rtn_m = [10, 30, 15.5]
"""


FAULTS = """
fow_deg = 90 | expected 'fov_deg', found unknown key 'fow_deg'
fov_deg = 190 | expected less than or equal to 170, found 190
fov_deg = "wide" | expected a valid number
fov_deg = nan | expected a finite number, found nan
fov_deg = true | expected a valid number, found True
width_px = true | expected a valid integer, found True
width_px = "5" | expected a valid integer, found '5'
fov_deg = | expected TOML
"""


@mark.parametrize("line, message", cells(FAULTS))
def test_a_fault_is_named_with_its_place_what_was_expected_and_what_was_found(line, message):
    text = f'name = "test"\n[camera]\n{line}\n'
    with raises(InvalidInput) as caught:
        parse_mission(text, "m.toml")
    place = "m.toml" if message == "expected TOML" else f"m.toml, camera.{line.split()[0]}"
    assert str(caught.value).startswith(f"{place}: {message}")
    assert list(map(str, read_document(text, "m.toml"))) == [str(caught.value)]


def test_every_unknown_key_has_a_line_and_what_is_not_stated_is_none_and_listed():
    faults = read_document('name = "test"\nlinc = 1\n[camera]\nwidht_px = 5\n', "m.toml")
    assert list(map(str, faults)) == [
        "m.toml, camera.widht_px: expected 'width_px', found unknown key 'widht_px'",
        "m.toml, linc: expected 'link', found unknown key 'linc'",
    ]
    mission = parse_mission(TEXT)
    assert mission.camera.width_px is None and mission.frames.gravity_field is None
    assert "camera.width_px" in mission.unknown and "camera.fov_deg" not in mission.unknown
    assert mission.evidence.level is None and mission.evidence.text == ""


def test_a_revision_depends_on_what_is_stated_not_on_its_layout_and_a_formatted_mission_is_the_same():
    other = TEXT.replace("[10, 30, 15.5]", "[10.0, 30.0, 15.50] # rounded").replace("\n[", "\n\n[")
    assert parse_mission(other).revision == parse_mission(TEXT).revision
    assert parse_mission(TEXT.replace("15.5", "15.6")).revision != parse_mission(TEXT).revision
    mission = parse_mission(TEXT)
    assert parse_mission(format_mission(mission)) == mission


LEVELS = """
None | None | None
unit-geometry | None | 1
procedural | None | 2
real-terrain | None | None
real-terrain | 0.0 | 3s
real-terrain | 0.999 | 3s
real-terrain | 1.0 | 3
other-renderer | None | 4
photographs | None | 5
"""


@mark.parametrize("world, share, level", cells(LEVELS))
def test_the_evidence_level_follows_from_the_world_that_was_flown(world, share, level):
    values = {"world": world, "unseen_share": share if share == "None" else float(share)}
    assert str(Evidence(**{name: value for name, value in values.items() if value != "None"}).level) == level


def test_several_passes_stand_on_the_weakest_evidence_among_them():
    seen, unseen = (Evidence(world="real-terrain", unseen_share=share) for share in (0.5, 1.0))
    assert weakest_evidence([unseen, seen]).startswith("3s (")
    assert weakest_evidence([unseen, Evidence(world="photographs")]).startswith("3 (")
    assert weakest_evidence([seen, Evidence(world="procedural")]).startswith("2 (")
    assert weakest_evidence([seen, Evidence()]) == weakest_evidence([]) == ""


def test_entering_the_same_content_again_gives_the_same_revision(ground):
    first = add_mission(ground, TEXT.encode(), actor="ada")
    again = add_mission(ground, (TEXT + "# a remark\n").encode(), actor="bob")
    assert again == first and first.entered_by == "ada" and first.text == TEXT
    other = add_mission(ground, TEXT.replace('"DE421"', '"IAU WGCCRE 2009"').encode())
    page = ground.read(list_missions, Paging())
    listed, total = page.items, page.total
    assert [one.revision for one in listed] == [other.revision, first.revision] and total == 2
    assert ground.read(find_revision, first.revision[:8]) == first


@mark.parametrize("name", ["", "xyz", "0000000", "00000000", "%" * 8, "a" * 65])
def test_a_revision_that_is_not_entered_is_not_found(ground, name):
    add_mission(ground, TEXT.encode())
    with raises(NotFound):
        ground.read(find_revision, name)


def test_a_pass_refers_to_the_newest_description_of_its_spacecraft(ground):
    def define(spacecraft):
        return get_pass(
            ground, define_pass(ground, name="p", start_utc_ns=0, stop_utc_ns=10**9, spacecraft_id=spacecraft)
        )

    assert define(76).mission_revision is None
    first = add_mission(ground, TEXT.encode())
    add_mission(ground, TEXT.replace("id = 76", "id = 77").encode())
    before = define(76)
    assert before.mission_revision == first.revision
    second = add_mission(ground, TEXT.replace("120", "90").encode())
    assert define(76).mission_revision == second.revision
    assert get_pass(ground, before.id).mission_revision == first.revision


def test_an_archive_without_a_description_states_what_its_manifest_declares(ground, synthetic_pass):
    key = import_archive(ground, synthetic_pass.folder)
    with ground.database.reading() as connection:
        record = stored_pass(connection, key)
        mission = mission_of_pass(connection, record.mission_id, record.manifest)
    assert record.mission_id is not None
    assert (mission.name, mission.spacecraft.id) == ("synthetic", 76)
    assert (mission.camera.width_px, mission.camera.fov_deg, mission.camera.k1) == (512, 120.0, None)
    assert mission.frames.orientation == "IAU WGCCRE 2009"
    assert mission.requirements.median_error_m is None and mission.link.coding is None


def test_the_description_in_an_archive_becomes_a_revision(ground, make_pass):
    folder = make_pass(frames=2, seed=31, mission=TEXT).folder
    detail = get_pass(ground, import_archive(ground, folder))
    assert (detail.mission, detail.mission_revision) == ("test", parse_mission(TEXT).revision)


def test_the_description_of_an_archive_holds_for_its_own_pass_only(ground, make_pass):
    folder = make_pass(frames=2, seed=33, mission=TEXT).folder

    def define():
        return get_pass(ground, define_pass(ground, name="p", start_utc_ns=0, stop_utc_ns=10**9, spacecraft_id=76))

    import_archive(ground, folder)
    assert define().mission_revision is None
    entered = add_mission(ground, TEXT.replace("120", "90").encode())
    import_archive(ground, make_pass(frames=2, seed=34).folder)
    assert define().mission_revision == entered.revision


def test_a_description_that_came_with_an_archive_is_in_force_once_a_person_enters_it(ground, make_pass):
    text = TEXT + '\n[approval]\none_person_for = ["perform_function/set_mode"]\n'
    import_archive(ground, make_pass(frames=2, seed=35, mission=text).folder)
    add_mission(ground, TEXT.replace("120", "90").encode(), actor="ada")
    taken = add_mission(ground, text.encode(), actor="bob")
    assert taken.entered_by == "bob"
    again = add_mission(ground, text.encode(), actor="eve")
    assert again == taken
    with ground.database.reading() as connection:
        assert newest_of_spacecraft(connection, 76) == taken.id
        assert approval_in_force(connection, 76).one_person_for == ("perform_function/set_mode",)
        assert approval_in_force(connection, 77).one_person_for is None


def test_a_description_of_another_spacecraft_is_refused_and_nothing_is_stored(ground, make_pass):
    folder = make_pass(frames=2, seed=32, mission=TEXT.replace("id = 76", "id = 5")).folder
    with raises(InvalidInput, match=r"mission\.toml, spacecraft\.id: expected 76 .*, found 5"):
        import_archive(ground, folder)
    assert ground.read(list_missions, Paging()).items == []


DECLARED = """
{"data_sources": ["orientation DE421"]} | DE421
{"data_sources": ["the orientation DE421 is not meant"]} | None
{"data_sources": ["orientation DE421", "orientation IAU WGCCRE 2009"]} | None
{"data_sources": "orientation DE421"} | None
{} | None
"""


@mark.parametrize("manifest, expected", cells(DECLARED))
def test_the_orientation_of_an_old_archive_is_read_where_it_was_declared(manifest, expected):
    assert str(mission_of_manifest(json.loads(manifest)).frames.orientation) == expected


def test_text_that_mentions_terrain_does_not_decide_the_evidence_level():
    def level(**manifest):
        evidence = mission_of_manifest({"seed": 7, **manifest}).evidence
        return evidence.world, evidence.level

    assert level(data_sources=["height model LROC WAC GLD100"]) == (None, None)
    declared = """
LROC WAC GLD100 | real-terrain | None
procedural Moon, seed 7 | procedural | 2
a procedural Moon and GLD100 | None | None
photograph big_tile.tif | photographs | 5
"""
    for terrain, *expected in cells(declared):
        assert [*map(str, level(terrain=terrain))] == expected


def test_values_of_a_wrong_type_in_a_manifest_are_not_stated():
    mission = mission_of_manifest({"gravity": "none", "camera": {"fov_deg": "wide", "width_px": 512}})
    assert mission.camera.width_px == 512 and mission.camera.fov_deg is None


def approval_text(*lines):
    return "\n".join((TEXT, "[approval]", *lines)).encode()


RAISED = 'second_person_for = ["replay_store"]'
RELAXED = 'one_person_for = ["perform_function/set_mode"]'


def released_by_one(ground, name, arguments):
    command = enter_command(ground, name, arguments, spacecraft_id=76, actor="ann")
    try:
        release_command(ground, command, actor="ann")
    except Conflict as error:
        assert "expected a person other than ann" in str(error)
        return False
    return True


REPLAY = ("replay_store", {"start_ticks": 0, "stop_ticks": 1})
SET_MODE = ("perform_function", {"function_id": "set_mode", "argument_1": 1.0, "argument_2": 0.0})


def test_the_mission_changes_which_telecommands_need_a_second_person(ground):
    assert (released_by_one(ground, *REPLAY), released_by_one(ground, *SET_MODE)) == (True, False)
    add_mission(ground, approval_text(RAISED, RELAXED))
    assert (released_by_one(ground, *REPLAY), released_by_one(ground, *SET_MODE)) == (False, True)


def test_a_description_in_an_archive_changes_nothing_of_what_people_approve(ground):
    mission, text = read_mission(approval_text(RELAXED))
    ground.write(enter, mission, text, actor="archive")
    assert not released_by_one(ground, *SET_MODE)


OPERATOR = Caller("ann", "operator")


def test_only_an_administrator_changes_which_telecommands_need_a_second_person(ground):
    with raises(Forbidden, match="expected an administrator"):
        add_mission(ground, approval_text(RELAXED), actor="ann", caller=OPERATOR)
    add_mission(ground, approval_text(RAISED), actor="root")
    with raises(Forbidden):
        add_mission(ground, TEXT.encode(), actor="ann", caller=OPERATOR)
    changed = approval_text(RAISED).replace(b"fov_deg = 120", b"fov_deg = 119")
    assert add_mission(ground, changed, actor="ann", caller=OPERATOR).entered_by == "ann"


@mark.parametrize(
    "line, message",
    [
        ('one_person_for = ["replay_stor"]', "expected 'replay_store', found 'replay_stor'"),
        ('one_person_for = ["replay_store"]\n' + RAISED, "found replay_store in both"),
    ],
)
def test_a_rule_about_a_telecommand_that_does_not_exist_or_twice_is_refused(line, message):
    [fault] = read_document(approval_text(line).decode(), "m.toml")
    assert message in str(fault)


def test_windows_approved_automatically_with_critical_telecommands_are_refused(ground, tmp_path):
    extra = '\n[approval]\nwindows = "automatic"\n[uploads]\ntables = ["orientation"]\n'
    found = "a second person needed for perform_function/set_mode, uplink_first, uplink_middle, uplink_last"
    with raises(InvalidInput, match=found):
        add_mission(ground, (TEXT + extra).encode())
    (tmp_path / "m.toml").write_text(TEXT + extra)
    mission, faults = check_mission_file(tmp_path / "m.toml")
    assert mission is None and len(faults) == 1 and found in faults[0]
    subjects = '["perform_function/set_mode", "uplink_first", "uplink_middle", "uplink_last"]'
    released = extra.replace("[uploads]", f"one_person_for = {subjects}\n[uploads]")
    assert add_mission(ground, (TEXT + released).encode()).document.critical_in_windows == ()


def test_a_description_has_a_hundred_links_at_most():
    link = '[[links]]\nname = "l{}"\nkind = "file"\ndownlink = "/nowhere"\n'
    links = [link.format(k) for k in range(101)]
    assert len(read_mission((TEXT + "".join(links[1:])).encode())[0].links or ()) == 100
    with raises(InvalidInput, match="at most 100 items"):
        read_mission((TEXT + "".join(links)).encode())


def test_a_check_of_texts_that_take_long_to_compare_counts_their_lines(ground):
    head = TEXT + "\n".join(f"# {k % 7}" for k in range(1500)) + "\n"
    add_mission(ground, head.encode())
    (change,) = check_mission(ground, (TEXT + "# x\n" + "# y\n# z\n" * 700).encode()).changes
    assert change == (
        f"@@ 1500 lines from line {TEXT.count(chr(10)) + 1} on are replaced by 1401: too many to compare @@"
    )


def test_a_wrong_address_of_a_webhook_is_not_shown(ground):
    (fault,) = check_mission(ground, (TEXT + '[notify.ops]\nwebhook = "htp://ann:S3CRET@x"\n').encode()).faults
    assert "notify.ops.webhook" in fault and "S3CRET" not in fault


def test_a_check_tells_all_faults_or_what_changes_and_adds_nothing(ground):
    add_mission(ground, TEXT.encode())
    assert check_mission(ground, TEXT.encode()).changes == ()
    found = check_mission(ground, TEXT.replace("fov_deg = 120", "fov_deg = 90").encode())
    assert "camera.width_px" in found.unknown
    line = TEXT.splitlines().index("fov_deg = 120")
    assert found.changes[0] == f"@@ -{line},3 +{line},3 @@"
    assert [one for one in found.changes if one[0] in "+-"] == ["-fov_deg = 120", "+fov_deg = 90"]
    assert len(check_mission(ground, (TEXT + "[linc]\n[camara]\n").encode()).faults) == 2
    other = Caller("eve", "operator", missions=("other",), spacecraft=frozenset({77}))
    with raises(Forbidden):
        check_mission(ground, TEXT.encode(), caller=other)
    with ground.database.reading() as connection:
        assert list_missions(connection, Paging()).total == 1


def test_viewers_see_neither_passwords_nor_tokens_of_webhooks(guarded):
    secret = "https://user:p4ss@hooks.example/services/T0KEN"
    text = f'''
name = "m"
[spacecraft]
id = 76
[notify.hook]
webhook = "{secret}"
[notify.escaped]
webhook = "https://hooks.example/\\u0054WO"
'''
    client, heads = guarded
    revision = add_mission(client.app.state.ground, text.encode()).revision

    def shown(role):
        return client.get(f"/api/v1/missions/{revision}", headers=heads[role]).json()

    assert shown("operator")["text"] == text
    assert shown("operator")["document"]["notify"]["hook"]["webhook"] == secret
    found = shown("viewer")
    channels = found["document"]["notify"]
    assert {one["webhook"] for one in channels.values()} == {"https://hooks.example/..."}
    assert not any(word in str(found) for word in ("p4ss", "T0KEN", "TWO", "u0054"))
    assert found["revision"] == revision


def test_descriptions_are_entered_and_read_over_http(client):
    made = client.post("/api/v1/missions", content=TEXT, headers={"Content-Type": "text/plain"})
    assert made.status_code == 201, made.text
    revision = made.json()["revision"]
    assert revision == parse_mission(TEXT).revision
    page = client.get("/api/v1/missions").json()
    assert [one["revision"] for one in page["items"]] == [revision] and page["total"] == 1
    assert client.get(f"/api/v1/missions/{revision[:8]}").json()["document"]["camera"]["fov_deg"] == 120.0
    refused = client.post("/api/v1/missions", content="name = 5", headers={"Content-Type": "text/plain"})
    assert refused.status_code == 422
    assert "body, name: expected a valid string" in refused.json()["detail"]
    assert client.get("/api/v1/missions/00000000").status_code == 404


def test_commands_check_enter_list_and_show_a_description(tmp_path, capsys):
    file, home = tmp_path / "mission.toml", ["--home", str(tmp_path / "home"), "--json"]
    file.write_text(TEXT)
    revision = parse_mission(TEXT).revision

    def run(*arguments):
        assert cli.run(["mission", *arguments]) == 0
        return json.loads(capsys.readouterr().out)

    for figures in (run("check", str(file), "--json"), run("add", str(file), *home)):
        assert (figures["mission"], figures["revision"]) == ("test", revision)
        assert "camera.width_px" in figures["unknown"]
    assert [one["revision"] for one in run("list", *home)["missions"]] == [revision]
    assert run("show", revision[:8], *home)["document"]["frames"]["orientation"] == "DE421"
    file.write_text("name = 5")
    assert cli.run(["mission", "check", str(file)]) == 2
    assert "name: expected a valid string, found 5" in capsys.readouterr().out


def test_several_that_enter_one_description_at_once_get_one_revision(either):
    with ThreadPoolExecutor(4) as pool:
        entered = list(pool.map(lambda _: add_mission(either, TEXT.encode()), range(8)))
    assert len({one.id for one in entered}) == 1
    assert either.read(list_missions, Paging()).total == 1


def test_a_description_names_a_mission():
    with raises(InvalidInput, match="name: expected"):
        parse_mission("schema_version = 1")
    assert Mission(name="x").unknown


IMPOSSIBLE = """
latitude_deg = 40.4 | latitude_deg and longitude_deg together
outages = ["2029-08-10T06:00:00Z/2029-08-10T00:00:00Z"] | a stop after the start
outages = ["tomorrow"] | START/STOP in UTC
longitude_deg = 0.0; latitude_deg = 95.0 | latitude_deg
"""


@mark.parametrize("keys, expected", cells(IMPOSSIBLE))
def test_an_impossible_place_or_outage_of_a_station_is_refused(keys, expected):
    lines = keys.replace("; ", "\n")
    with raises(InvalidInput, match=expected):
        parse_mission(f'schema_version = 1\nname = "m"\n[link.stations.madrid]\n{lines}\n')


HEAD = 'name = "m"\n'
RULE = '[[automation.rules]]\nname = "a"\non = "window ended"\ndo = ["report"]\n'
PEOPLE = '[automation.channels.people]\nemail = ["a@b"]\n'


@mark.parametrize("text, line",
    [
        (RULE, "automation: expected no rules (the follow-up of an event is fixed, and alert rules are those of "
               "Prometheus), found automation.rules"),
        (PEOPLE, "automation: expected receivers of notifications as [notify.NAME], found automation.channels"),
        ("[automation]\nrules = []\n", "automation: expected no rules"),
        ("[automation]\nevalute = true\n", "automation.evalute: expected 'evaluate', found unknown key 'evalute'"),
        (
            "[notify.ops]\nwebhook = 'http://x/'\nemail = ['a@b']\n",
            "notify.ops: expected either webhook or email, found",
        ),
        (
            "[notify.ops]\nwebhook = 'http://x/'\nsigning_secret = '..'\n",
            "notify.ops.signing_secret: expected ",
        ),
        ("[notify.ops]\nemail = ['a@b']\nsigning_secret = 'x'\n", "notify.ops: expected signing_secret with a webhook"),
    ],
)  # fmt: skip
def test_a_new_description_with_rules_or_an_impossible_receiver_is_refused_with_one_line(text, line):
    [fault] = read_document(HEAD + text, "mission.toml")
    assert str(fault).startswith(f"mission.toml, {line}")


def test_rules_of_a_stored_description_are_ignored_with_a_remark_and_its_channels_are_notified(caplog):
    with caplog.at_level(logging.WARNING):
        found = parse_mission(HEAD + RULE + PEOPLE, "revision 1", stored=True)
    assert found == parse_mission(HEAD + PEOPLE.replace("automation.channels", "notify"))
    [remark] = caplog.messages
    assert remark.startswith("revision 1: 1 rules of an earlier version have no effect")


def test_a_stored_description_with_an_empty_list_of_rules_evaluates_nothing():
    assert parse_mission(f"{HEAD}[automation]\nrules = []\n", stored=True).automation.evaluate is False
    assert parse_mission(HEAD + RULE, stored=True).automation.evaluate is None
    stated = f"{HEAD}[automation]\nevaluate = true\nrules = []\n"
    assert parse_mission(stored=True, text=stated).automation.evaluate is True


def test_a_stored_revision_with_rules_opens_and_names_its_receivers(either):
    text = f"{HEAD}[spacecraft]\nid = 76\n{RULE}[automation.channels.hook]\nwebhook = 'https://x.example/T0KEN'\n"
    mission = parse_mission(text, stored=True)
    key, _ = either.write(store.add_revision, mission, text, actor="ann", now_utc_ns=1)
    [(spacecraft, name, channel)] = either.read(store.channels_in_force)
    assert (spacecraft, name, channel.webhook) == (76, "hook", "https://x.example/T0KEN")
    shown = without_tokens(either.read(store.detail, key))
    assert "T0KEN" not in shown.text and RULE in shown.text
    assert shown.document.notify["hook"].webhook == "https://x.example/..."


def test_receivers_survive_the_format():
    mission = parse_mission(f"{HEAD}[notify.ops]\nwebhook = 'http://x/'\nsigning_secret = 'ops'\n")
    assert parse_mission(format_mission(mission)) == mission
    assert mission.notify["ops"].server == ("x", 80)
