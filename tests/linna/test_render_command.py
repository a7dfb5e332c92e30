"""`linna render`: a frame, sheets, renderers side by side, and what it refuses."""

import numpy as np
from pytest import fixture, mark

from lunar.constants import GM_MOON_M3_S2
from tests.lazy import Lazy

cv2 = Lazy("cv2")

SMALL = """
name = "small"
seed = 5
[terrain]
source = "procedural"
[dynamics]
degree = 10
gravity = "builtin"
[camera]
width_px = 96
height_px = 96
"""
EPOCHS = ("2029-08-07T00:10:00Z", "2029-08-07T00:20:00Z")


@fixture
def scenario(tmp_path, monkeypatch):
    monkeypatch.delenv("LINNA_DATA", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    file = tmp_path / "small.toml"
    file.write_text(SMALL)
    return str(file)


def test_a_frame_is_written_with_its_metadata_and_labels(scenario, tmp_path, typed):
    out = tmp_path / "a.png"
    figures = typed(f"render {scenario} --epoch {EPOCHS[0]} --out {out} --json")
    assert figures["image"] == str(out)
    assert cv2.imread(str(out)).shape == (96, 96, 3)
    assert figures["metadata"]["renderer"] == "fast" and figures["metadata"]["photometry"] == "lunar-lambert"
    assert figures["labels"] and figures["data"]
    assert {"u_px", "ellipse", "visible_fraction", "lit_fraction", "sight_fraction"} <= figures["labels"][0].keys()


def test_law_and_renderer_are_chosen_on_the_command_line_pointing_and_depth_by_the_scenario(scenario, tmp_path, typed):
    out = tmp_path / "b.png"
    turned = SMALL + "tilt_deg = 4.0\nyaw_deg = 90.0\n[sensor]\nbits = 12\n"
    (tmp_path / "small.toml").write_text(turned)
    words = "--photometry hapke --renderer raymarch --json"
    metadata = typed(f"render {scenario} --epoch {EPOCHS[0]} --out {out} {words}")["metadata"]
    assert (metadata["photometry"], metadata["tilt_deg"], metadata["azimuth_deg"]) == ("hapke", 4.0, 90.0)
    assert metadata["camera"]["bits"] == 12 and metadata["renderer"] == "raymarch"
    assert cv2.imread(str(out), cv2.IMREAD_UNCHANGED).dtype == "uint16"


def test_labels_are_drawn_in_the_colours_of_their_classes(scenario, tmp_path, typed):
    out = tmp_path / "c.png"
    figures = typed(f"render {scenario} --epoch {EPOCHS[0]} --out {out} --draw-labels --json")
    drawn = cv2.imread(str(out))[..., ::-1].astype(int)
    # Cyan, lime and yellow are the only saturated colours on the Moon.
    saturated = drawn.max(axis=2) - drawn.min(axis=2) > 120
    assert saturated.any() == any(label["class"] in (0, 1, 2) and label["inside"] for label in figures["labels"])


def test_a_sheet_holds_the_epochs_named(scenario, tmp_path, typed):
    out = tmp_path / "d.png"
    figures = typed(f"render {scenario} --epoch {EPOCHS[0]} --epoch {EPOCHS[1]} --out {out} --sheet --json")
    assert [view["epoch"][:16] for view in figures["views"]] == [epoch[:16] for epoch in EPOCHS]
    assert len(figures["instances"]) == 3
    assert cv2.imread(str(out)).shape[1] > 2 * 96


def test_cycles_without_blender_is_one_line(scenario, tmp_path, typed, monkeypatch):
    (tmp_path / "bpy.py").write_text("raise ImportError('none')\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    out = tmp_path / "f.png"
    line = typed(f"render {scenario} --epoch {EPOCHS[0]} --out {out} --renderer cycles", 2)
    assert "expected Blender as a module (bpy)" in line and "LINNA_BLENDER_PYTHON" in line
    assert not out.exists()


@mark.parametrize(
    "words, message",
    [
        (f"x.jpg --epoch {EPOCHS[0]}", "expected a .png file, found x.jpg"),
        (f"nowhere/x.png --epoch {EPOCHS[0]}", "expected an existing folder"),
        ("x.png", "expected one for one frame, found 0"),
        ("x.png --epoch yesterday", "yesterday"),
        ("x.png --epoch 2029-08-06T00:00:00Z", "at or after the scenario's 2029-08-07"),
        (f"x.png --epoch {EPOCHS[0]} --views 0", "--views: expected a number from 1 and up to 60, found '0'"),
        (f"x.png --epoch {EPOCHS[0]} --terrain raster", "height rasters"),
        (f"x.png --epoch {EPOCHS[0]} --renderer magic", "'fast', 'raymarch', 'cycles'"),
    ],
)
def test_what_cannot_be_rendered_is_one_line(scenario, tmp_path, monkeypatch, typed, words, message):
    monkeypatch.chdir(tmp_path)
    assert message in typed(f"render {scenario} --out {words}", 2)
    assert not (tmp_path / "x.png").exists()


def test_an_ephemeris_below_the_terrain_and_epochs_outside_it_are_one_line(scenario, tmp_path, typed):
    oem = tmp_path / "low.oem"
    angle = np.sqrt(GM_MOON_M3_S2 / 1.73e6**3) * 60.0 * np.arange(30)
    c, s, speed = np.cos(angle), np.sin(angle), np.sqrt(GM_MOON_M3_S2 / 1.73e6) / 1e3
    states = "\n".join(
        f"2029-08-07T00:{k:02d}:00.000 {1730.0 * c[k]} {1730.0 * s[k]} 0.0 {-speed * s[k]} {speed * c[k]} 0.0"
        for k in range(30)
    )
    oem.write_text(
        "CCSDS_OEM_VERS = 2.0\nCREATION_DATE = 2029-01-01T00:00:00\nORIGINATOR = T\nMETA_START\nOBJECT_NAME = A\n"
        "OBJECT_ID = A\nCENTER_NAME = MOON\nREF_FRAME = ICRF\nTIME_SYSTEM = UTC\nSTART_TIME = 2029-08-07T00:00:00\n"
        "STOP_TIME = 2029-08-07T00:29:00\nMETA_STOP\n" + states + "\n"
    )
    file = tmp_path / "low.toml"
    file.write_text(SMALL + f'[orbit]\noem = "{oem}"\n')
    out = str(tmp_path / "x.png")
    assert "below" in typed(f"render {file} --epoch {EPOCHS[0]} --out {out}", 2)
    assert "2029-08-07T00:29:00" in typed(f"render {file} --epoch 2029-08-08T00:00:00Z --out {out}", 2)
