"""Choices of commands: the crater catalogue (a file, a public or a synthetic one), and the region."""

from __future__ import annotations

from typing import TYPE_CHECKING

from linna.data import data_folder
from linna.errors import UsageError

if TYPE_CHECKING:
    from lunar.catalogue import CraterCatalogue
    from payload_emulator.sim.terrain.curation import Region

SYNTHETIC = ("paper-density", "paper-density-synthetic", "paper-density-uniform")
CATALOGUE_HELP = (
    "catalogue (CSV, plain or gzip), or paper-density: the paper's class counts, from the available real catalogue, "
    "with random craters in its empty tiles (paper-density-synthetic: all random, few in the maria; "
    "paper-density-uniform: all random); default: the most complete catalogue of the data folder"
)


def open_catalogue(name: str | None, seed: int) -> CraterCatalogue:
    """Return the catalogue of a file or of one of `SYNTHETIC`; without a name, the most complete available one.

    The catalogue of the paper's density is the real catalogue with random craters in its empty tiles, or entirely
    synthetic if no real catalogue is available.
    """
    from lunar.catalogue import completed_to_paper, load_catalogue, paper_density_catalogue

    if name is not None and name not in SYNTHETIC:
        return load_catalogue(name)
    data = data_folder()
    if name == SYNTHETIC[0] and data.catalogue_lu is not None:
        return completed_to_paper(load_catalogue(data.catalogue_lu), seed)
    found = data.catalogue_composite or data.catalogue_lu or data.catalogue_robbins
    if name is not None or found is None:
        return paper_density_catalogue(seed, uniform=name == SYNTHETIC[2])
    return load_catalogue(found)


def parse_region(text: str) -> Region:
    """Return the region of the option `--region`: W,E,S,N in degrees."""
    from payload_emulator.sim.terrain.curation import Region

    try:
        west, east, south, north = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"--region: expected four numbers W,E,S,N in degrees, found {text!r}") from None
    if not (-90.0 <= south < north <= 90.0 and 0.0 < east - west <= 360.0):
        raise UsageError(f"--region: expected west before east and south before north, found {text!r}")
    return Region(west, east, south, north)
