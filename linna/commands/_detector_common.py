"""Common parts of the verbs of `linna detector`: the model option and torch."""

import argparse
from pathlib import Path

from linna.errors import UsageError
from linna.parser import option


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
