"""Choice of the crater catalogue of a command: a file, a public catalogue or a synthetic one."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lunar.catalogue import CraterCatalogue

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
    from linna.data import data_folder
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
