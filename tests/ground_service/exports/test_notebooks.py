"""`linna.open` on a home folder, a server and pass archives; and the notebooks of the documentation, executed."""

import builtins
import importlib.util
import json
import re
import threading
import time
from pathlib import Path

import numpy as np
import uvicorn
from numpy.testing import assert_array_equal
from pytest import approx, fixture, mark, raises

import docs_site
import linna
from ground_service.access.service import add_user
from ground_service.app import create_app
from ground_service.passes.archive_import import zip_folder
from ground_service.settings import Settings
from linna.errors import UsageError
from tests.ground_service.conftest import SPHERICAL_ERROR_RTN_M, free_port
from tests.ground_service.exports.conftest import FRAMES
from tmtc.errors import MissingLibrary

ROOT = Path(__file__).resolve().parents[3]
NOTEBOOKS = sorted((ROOT / "docs/notebooks").glob("*.ipynb"))


def check(archive):
    """The tables and figures of the synthetic pass."""
    one = archive.passes[0]
    residuals = one.residuals
    spherical = residuals[residuals["solution"] == "spherical"]
    assert len(spherical) == FRAMES
    assert spherical["error_3d_m"].median() == approx(np.linalg.norm(SPHERICAL_ERROR_RTN_M), abs=1.0)
    assert residuals.attrs["units"]["error_3d_m"] == "m"
    assert str(one.states["utc"].dtype) == "datetime64[ns, UTC]"
    assert one.states["utc"].iloc[0].isoformat() == "2029-08-07T06:00:00+00:00"
    assert sorted(one.images) == [0, 4, 8]
    assert one.images[4][0, 0] == 40
    summary = archive.summary()
    assert summary.loc[one.id, "spherical median_3d_m"] == approx(spherical["error_3d_m"].median(), rel=1e-3)


@mark.filterwarnings("ignore:ERFA function")  # leap seconds of 2029 are not announced
def test_the_examples_of_other_tools_run_where_the_tool_is_installed(rich_ground, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("LINNA_HOME", str(rich_ground.home))
    monkeypatch.chdir(tmp_path)
    text, names = (ROOT / "docs/other-tools.md").read_text(), {"__name__": "example"}
    examples = re.findall(r"<!-- tool: (\w+) -->\n```python\n(.*?)```", text, re.DOTALL)
    for tool, source in examples:
        program = compile(source, tool, "exec")
        if importlib.util.find_spec(tool):
            exec(program, names)
    assert [tool for tool, _ in examples] == ["pandas", "polars", "xarray", "astropy", "spiceypy"]
    assert capsys.readouterr().out.splitlines()[-1].endswith(" km")


def test_an_archive_is_opened_as_folder_and_as_zip(rich_pass):
    with linna.open(rich_pass.folder) as archive:
        check(archive)
    packed = zip_folder(rich_pass.folder)
    try:
        named = packed.with_suffix(".zip")
        packed.rename(named)
        with linna.open(named) as archive:
            assert [one.name for one in archive.passes] == ["synthetic pass"]
    finally:
        named.unlink()


@fixture
def server(rich_ground):
    """Address of a server on the home folder, and a token."""
    port = free_port()
    app = create_app(Settings(home=rich_ground.home, allowed_hosts="127.0.0.1"), inline_jobs=True)
    running = uvicorn.Server(uvicorn.Config(app, port=port, log_level="error", ws="none"))
    thread = threading.Thread(target=running.run)
    thread.start()
    while not running.started:
        time.sleep(0.05)
    yield f"http://127.0.0.1:{port}", add_user(rich_ground, "notebook-reader", "viewer")
    running.should_exit = True
    thread.join()


def test_a_server_is_opened_with_a_token(server):
    url, token = server
    with linna.open(url, token=token) as archive:
        check(archive)


def test_a_home_folder_is_opened_and_its_tables_have_the_types_of_their_columns(rich_ground):
    with linna.open(rich_ground.home) as archive:
        check(archive)
        assert "passes" in repr(archive)
        one = archive[1]
        assert set(one.tables) >= {"states", "residuals", "frames", "detections", "events", "reference"}
        detections = one.detections
        assert (str(detections["crater_id"].dtype), str(detections["u_px"].dtype)) == ("int64", "float64")
        assert one.states.loc[one.states["estimator"] == "paper", "sigma_r_m"].isna().all()
        tree = one.dataset()
        assert_array_equal(tree["detections"]["u_px"].values, detections["u_px"].to_numpy())
        with raises(UsageError, match=r"table: expected states, residuals.*, found 'statse'"):
            one.table("statse")


@mark.parametrize("name", ["missing", "empty"])
def test_a_source_of_no_kind_is_one_line(tmp_path, name):
    (tmp_path / "empty").mkdir()
    found = "another folder" if name == "empty" else "none"
    with raises(UsageError, match=rf"{name}: expected a home folder with linna.db, .*, found {found}"):
        linna.open(tmp_path / name)
    assert list((tmp_path / "empty").iterdir()) == []


def test_without_pandas_one_line_names_the_extra(rich_ground, monkeypatch):
    usual = builtins.__import__

    def without(name, *rest):
        if name == "pandas":
            raise ImportError(name)
        return usual(name, *rest)

    with linna.open(rich_ground.home) as archive:
        monkeypatch.setattr(builtins, "__import__", without)
        with raises(MissingLibrary, match=r"pandas, found none; install linna\[notebook\]"):
            _ = archive.passes[0].states


@mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_stored_without_outputs_and_small(path):
    assert [one.stem for one in NOTEBOOKS] == ["campaign", "detector", "pass"]
    assert path.stat().st_size < 20_000
    for cell in json.loads(path.read_text())["cells"]:
        assert cell.get("outputs", []) == [] and cell.get("execution_count") is None


@mark.slow
@mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path, rich_ground, monkeypatch):
    import nbformat  # two seconds, which the other tests need not spend
    from nbclient import NotebookClient

    monkeypatch.setenv("LINNA_HOME", str(rich_ground.home))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.delenv("MPLBACKEND", raising=False)  # pictures are outputs of cells
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=900, kernel_name="python3").execute()
    shown = [one for cell in notebook.cells for one in cell.get("outputs", [])]
    assert any("image/png" in one.get("data", {}) for one in shown)
    assert not any(one["output_type"] == "error" or one.get("name") == "stderr" for one in shown)
    page, pictures = docs_site.notebook_page(path.stem, json.loads(nbformat.writes(notebook)))
    assert re.findall(r"!\[Output of the cell\]\((.*?)\)", page) == list(pictures)
    assert all(octets.startswith(b"\x89PNG") and len(octets) < 150_000 for octets in pictures.values())
    assert "<table" in page and "<style" not in page
    assert len(page) < 40_000


def test_a_page_shows_outputs_in_the_order_of_the_cells():
    cells = [
        {"cell_type": "markdown", "source": ["# Title\n", "Text."]},
        {
            "cell_type": "code",
            "source": "both()",
            "outputs": [
                {"output_type": "stream", "name": "stdout", "text": ["12 frames\n"]},
                {
                    "output_type": "execute_result",
                    "data": {"text/plain": ["3"], "text/html": "<style>a</style><p>\n\n3</p>"},
                },
                {"output_type": "display_data", "data": {"image/png": "iVBORw==", "text/plain": "<Figure>"}},
            ],
        },
        {
            "cell_type": "code",
            "source": "7",
            "outputs": [{"output_type": "execute_result", "data": {"text/plain": "7"}}],
        },
    ]
    page, pictures = docs_site.notebook_page("pass", {"cells": cells})
    assert page.split("\n\n") == [
        "# Title\nText.",
        "```python\nboth()\n```",
        "```text\n12 frames\n```",
        "<p>\n3</p>",
        "![Output of the cell](pass-1.png)",
        "```python\n7\n```",
        "```text\n7\n```\n",
    ]
    assert pictures == {"pass-1.png": b"\x89PNG"}
