"""Shared by all tests: where the real data are, and what is skipped without them."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "0")
os.environ.setdefault("NUMBA_SLP_VECTORIZE", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

# Properties are tried on the same examples everywhere, and a busy machine is no failure.
settings.register_profile("linna", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("linna")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Tests of real data run whenever LINNA_DATA is set; only a machine without the products leaves them out."""
    if os.environ.get("LINNA_DATA"):
        return
    skip = pytest.mark.skip(reason="LINNA_DATA is not set: no real data on this machine")
    for item in items:
        if "real_data" in item.keywords:
            item.add_marker(skip)


@pytest.fixture(scope="session")
def data_path() -> Path:
    """The folder of real data products (only for tests marked real_data)."""
    return Path(os.environ["LINNA_DATA"])
