"""The chain from passes to a new catalogue and table on board."""

import io
import json
import shutil
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pytest import fixture, mark

from ground_service.evaluation.inputs import load_pass_inputs
from ground_service.evaluation.landmarks.service import decide_landmark, uploaded_tables
from ground_service.evaluation.service import pass_summary
from ground_service.ground import open_ground
from ground_service.passes.archive_import import import_archive
from linna import cli
from lunar.catalogue import CraterCatalogue, load_catalogue, save_catalogue
from lunar.datafolder import DataFolder
from payload_emulator.session.archive.replay import FlightBuild, replay_archive
from payload_emulator.session.archive.suite import suite_scenarios, write_suite
from tests.ground_service.conftest import enter_files
from tmtc.dictionary.tables import pack_catalogue_table, unpack_catalogue_table

SCENARIO = "suite-real-sun"
FRAMES = 8
KEPT = 6
"""The service knows every sixth crater."""


@dataclass(frozen=True)
class Learned:
    """A service that has searched two passes, and the files of the chain.

    `archive` is an emulated pass with its frames, `thin` the catalogue of the service, which has every sixth
    crater.
    """

    folder: Path
    archive: Path
    thin: CraterCatalogue
    proposed: int
    unmatched: int
    linna: Callable[..., Any]


@fixture(scope="module")
def linna(tmp_path_factory):
    """Run a command on one service; return its JSON output."""
    home = tmp_path_factory.mktemp("chain") / "home"

    def run(words):
        with redirect_stdout(io.StringIO()) as output:
            assert cli.run([*words.split(), "--home", str(home), "--json"]) == 0, words
        return json.loads(output.getvalue())

    run.home = home
    return run


@fixture(scope="module")
def learned(linna, tmp_path_factory):
    """An emulated pass over a procedural Moon, imported twice as two passes, up to the decisions and exports."""
    folder = tmp_path_factory.mktemp("learned")
    [scenario] = [one for one in suite_scenarios(frames=FRAMES) if one.name == SCENARIO]
    [written] = write_suite([scenario], DataFolder(), folder / "suite")
    full = load_catalogue(written.folder / "catalogue.csv")
    thin = full.select(np.arange(len(full)) % KEPT == 0)
    save_catalogue(thin, folder / "old.csv")
    with open_ground(linna.home) as ground:
        ids = [import_archive(ground, _pass(written.folder, folder, name, thin)) for name in ("first", "second")]

    before = linna("landmarks find {} {}".format(*ids))["passes"][1]
    proposed = [one["id"] for one in linna("landmarks list --state proposed --limit 500")["landmarks"]]
    assert before["proposed"] == len(proposed) > 20
    linna(f"landmarks reject {proposed[0]} --reason rimless --as ann")
    linna(f"landmarks accept {proposed[1]} --as ann")
    with open_ground(linna.home) as ground:
        for one in proposed[2:]:
            decide_landmark(ground, one, accept=True, reason="", actor="ann")
    shown = linna(f"landmarks show {proposed[1]}")
    assert (shown["state"], shown["decided_by"], len(shown["evidence"])) == ("accepted", "ann", 2)
    linna(f"landmarks export --catalogue {folder}/old.csv --out {folder}/new.csv")
    return Learned(folder, written.folder, thin, len(proposed), before["unmatched"], linna)


@mark.campaign
def test_the_uploaded_table_gives_a_later_pass_more_landmarks(learned):
    """The table goes up by PUS 13, released by a second person; the flight software flies with it."""
    folder, linna = learned.folder, learned.linna
    flown = unpack_catalogue_table((learned.archive / "payload/tables/catalogue.bin").read_bytes())
    old = flown.select(np.isin(flown.ids, learned.thin.ids))
    (folder / "old.bin").write_bytes(pack_catalogue_table(old))
    linna(f"landmarks export --table {folder}/old.bin --out {folder}/new.bin")
    queued = linna(f"landmarks upload {folder}/new.bin --spacecraft-id 76 --instance flight --as ann")
    for one in queued["telecommands"]:
        linna(f"command release {one} --as bob")
    linna(f"command uplink --spacecraft-id 76 --format packets --out {folder}/uplink.bin")
    [onboard] = uploaded_tables((folder / "uplink.bin").read_bytes())
    assert onboard == (folder / "new.bin").read_bytes()
    assert len(unpack_catalogue_table(onboard)) == len(old) + learned.proposed - 1 == queued["craters"]

    extended = load_catalogue(folder / "new.csv")
    assert len(extended) == len(learned.thin) + learned.proposed - 1
    archives = [
        _flown(learned, "unaware", (folder / "old.bin").read_bytes(), learned.thin),
        _flown(learned, "aware", onboard, extended),
    ]
    with open_ground(linna.home) as ground:
        ids = [import_archive(ground, one) for one in archives]
        unaware, aware = (pass_summary(ground, one)["detector"]["precision"] for one in ids)
        used = [_matched(ground, one) for one in ids]
    for one, name in zip(ids, ("old.bin", "new.bin"), strict=True):
        made = linna(f"landmarks table {one} --out {folder}/onboard.bin")
        assert (folder / "onboard.bin").read_bytes() == (folder / name).read_bytes()
        assert made["craters"] == len(unpack_catalogue_table((folder / name).read_bytes()))
    assert used[1] > 2 * used[0] > 0
    assert aware > 0.8 > 0.3 > unaware
    after = linna(f"landmarks find {ids[1]}")["passes"][0]
    assert after["unmatched"] < 0.3 * learned.unmatched


def _pass(archive, folder, name, catalogue):
    """Copy an archive as another pass, with the catalogue that the ground has."""
    target = shutil.copytree(archive, folder / name)
    save_catalogue(catalogue, target / "catalogue.csv")
    enter_files(target, pass_name=name)
    return target


def _flown(learned, name, table, catalogue):
    """Fly the frames of the pass with a table of landmarks; return the archive of that pass."""
    target = _pass(learned.archive, learned.folder, name, catalogue)
    (target / "payload/tables/catalogue.bin").write_bytes(table)
    replay_archive(target, FlightBuild(), learned.folder / f"out-{name}")
    shutil.copyfile(learned.folder / f"out-{name}" / "downlink.cadu", target / "downlink.cadu")
    enter_files(target)
    return target


def _matched(ground, pass_id):
    """Return the number of landmarks that the anchored estimator used in all frames."""
    [anchored] = [one for one in load_pass_inputs(ground, pass_id).navigation if one.estimator == "anchored"]
    return int(anchored.matched.sum())
