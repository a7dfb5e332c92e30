"""Colours and type of all figures.

A figure is drawn in the light colours. In HTML each light colour is then replaced by the CSS variable of its role,
so that one drawing serves light, dark and print; no two roles may share a light colour for that reason. The hues are
those of Okabe and Ito (2008), which stay apart under the common colour-vision deficiencies; lines differ in dash as
well.
"""

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from threading import RLock
from typing import Any

LIGHT = {
    "ink": "#1a2330",
    "muted": "#5a6574",
    "faint": "#aab2bc",
    "grid": "#e3e7ec",
    "paper": "#fefefe",
    "sunlit": "#fdf4da",
    "blue": "#0072b2",
    "vermillion": "#d55e00",
    "green": "#009e73",
    "purple": "#a14f8c",
    "orange": "#e69f00",
    "sky": "#56b4e9",
    "gray1": "#3d4856",
    "gray2": "#6b7786",
    "gray3": "#8792a0",
    "silver": "#c9cfd7",
}
DARK = {
    "ink": "#e8ecf1",
    "muted": "#a9b3c0",
    "faint": "#5b6673",
    "grid": "#2c343e",
    "paper": "#14181e",
    "sunlit": "#2b2717",
    "blue": "#58aef0",
    "vermillion": "#ff8742",
    "green": "#37c99c",
    "purple": "#d98bc6",
    "orange": "#f2b73d",
    "sky": "#9cd6f7",
    "gray1": "#cfd6de",
    "gray2": "#97a2b0",
    "gray3": "#7d8896",
    "silver": "#4a5561",
}

OUTCOMES = {
    "anchored": ("Anchored match", "gray1"),
    "multi": ("Multi-pair match", "blue"),
    "single": ("Singleton match", "sky"),
    "predicted": ("Prediction only", "orange"),
    "missed": ("Missed", "vermillion"),
    "rejected": ("Rejected", "purple"),
    "fixed": ("Fixed on the catalogue", "green"),
    "coasted": ("Coasted", "orange"),
    "refused": ("Fix refused", "purple"),
    "no_image": ("No image", "silver"),
}
TRIGGERS = {
    "initialization": "initialization",
    "time_gap": "time gap",
    "manual_step": "manual step",
    "safety_timeout": "safety timeout",
}

REFERENCE = "ink"
"""Role of the colour of the reference; no estimate or baseline uses this colour."""

_KNOWN_SERIES = {"paper": "vermillion", "spherical": "purple", "anchored": "blue"}
_OTHER_SERIES = ("green", "orange", "sky", "gray1")
_BASELINE_STYLES: tuple[tuple[str, tuple[float, ...]], ...] = (
    ("gray1", (5.0, 2.0)),
    ("gray2", (1.2, 1.6)),
    ("gray3", (6.0, 1.6, 1.2, 1.6)),
    ("gray1", (2.4, 1.4)),
    ("gray2", (9.0, 2.0)),
)
_LOCK = RLock()

LineStyle = tuple[str, str | tuple[int, tuple[float, ...]]]
"""Colour of a line, and its dashes as matplotlib takes them."""
Styles = Mapping[str, LineStyle]


def color(role: str) -> str:
    """Light colour of a role."""
    return LIGHT[role]


def series_styles(names_and_kinds: list[tuple[str, str]]) -> dict[str, LineStyle]:
    """Return the style of the line of every estimate and baseline, the same in every figure."""
    styles: dict[str, LineStyle] = {}
    others = baselines = 0
    for name, kind in names_and_kinds:
        if kind == "baseline":
            role, dashes = _BASELINE_STYLES[baselines % len(_BASELINE_STYLES)]
            styles[name] = (color(role), (0, dashes))
            baselines += 1
        elif name in _KNOWN_SERIES:
            styles[name] = (color(_KNOWN_SERIES[name]), "-")
        else:
            styles[name] = (color(_OTHER_SERIES[others % len(_OTHER_SERIES)]), "-")
            others += 1
    return styles


@contextmanager
def drawing(more: Mapping[str, Any] | None = None) -> Iterator[None]:
    """Matplotlib set up for one drawing; drawings of one process take turns."""
    import matplotlib

    with _LOCK, matplotlib.rc_context({**_settings(), **(more or {})}), warnings.catch_warnings():
        # A name in letters that the type does not have is still text on the page.
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        yield


def _settings() -> dict[str, Any]:
    return {
        "font.family": ["DejaVu Sans"],
        "font.size": 9.5,
        "axes.titlesize": 9.5,
        "axes.labelsize": 9.0,
        "xtick.labelsize": 8.5,
        "ytick.labelsize": 8.5,
        "legend.fontsize": 8.5,
        "axes.titleweight": "bold",
        "axes.titlelocation": "left",
        "axes.titlepad": 6.0,
        "axes.titley": 1.0,
        "axes.labelpad": 4.0,
        "axes.linewidth": 0.7,
        "axes.edgecolor": LIGHT["faint"],
        "axes.facecolor": "none",
        "axes.labelcolor": LIGHT["muted"],
        "axes.titlecolor": LIGHT["ink"],
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.axisbelow": True,
        "axes.grid": True,
        "axes.grid.axis": "y",
        "axes.unicode_minus": True,
        "grid.color": LIGHT["grid"],
        "grid.linewidth": 0.7,
        "figure.facecolor": "none",
        "text.color": LIGHT["ink"],
        "xtick.color": LIGHT["faint"],
        "ytick.color": LIGHT["faint"],
        "xtick.labelcolor": LIGHT["muted"],
        "ytick.labelcolor": LIGHT["muted"],
        "xtick.major.size": 3.0,
        "ytick.major.size": 0.0,
        "xtick.major.width": 0.7,
        "xtick.major.pad": 3.0,
        "ytick.major.pad": 4.0,
        "lines.linewidth": 1.4,
        "lines.markersize": 4.0,
        "lines.solid_capstyle": "round",
        "lines.solid_joinstyle": "round",
        "patch.linewidth": 0.0,
        "legend.frameon": False,
        "legend.handlelength": 2.0,
        "path.simplify": True,
        "path.simplify_threshold": 0.25,
        "image.composite_image": False,
        "svg.fonttype": "none",
        "pdf.fonttype": 42,
        "figure.dpi": 72.0,
        "savefig.dpi": 72.0,
    }
