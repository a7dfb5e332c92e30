"""Options and inputs that several commands share: catalogues, regions, networks, training."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from linna.data import data_folder
from linna.errors import UsageError
from linna.parser import option

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


def add_model(parser: argparse.ArgumentParser) -> None:
    from payload_emulator.flight.models import NETWORKS

    option(
        parser,
        "--model M.onnx",
        Path,
        f"ONNX file or the name of a shipped network ({', '.join(NETWORKS)}); default: the first",
        default=None,
    )


def model_octets(path: Path | None) -> bytes:
    """The network of a file, a shipped one by its name, or the default one."""
    from payload_emulator.flight.models import DEFAULT_NETWORK, NETWORKS, load_shipped_model

    name = DEFAULT_NETWORK if path is None else str(path)
    if name in NETWORKS:
        return load_shipped_model(name)
    if not Path(name).is_file():
        raise UsageError(f"--model: expected a file or {' or '.join(NETWORKS)}, found {name!r}")
    return Path(name).read_bytes()


def need_torch() -> None:
    """Refuse in clear words where torch is missing.

    Raises
    ------
    UsageError
        There is no torch.
    """
    import importlib.util

    from payload_emulator.errors import install_hint

    if importlib.util.find_spec("torch") is None:
        raise UsageError(f"training needs torch: {install_hint('train')}")


def restart_for_training() -> None:
    """Start this process once more with the allocator and thread settings of training, where it lacks them."""
    import os
    import sys

    from payload_emulator.training.model.train import ENVIRONMENT, set_environment

    if (
        any(os.environ.get(name) is None for name in ENVIRONMENT)
        and sys.argv
        and os.environ.get("LINNA_TRAIN_CHILD") is None
    ):
        # The allocator reads its settings when the process starts, so start once more with them.
        os.execve(
            sys.executable,
            [sys.executable, "-m", "linna", *sys.argv[1:]],
            set_environment() | {"LINNA_TRAIN_CHILD": "1"},
        )
