"""`linna detector make`: from a recipe to the shipped model in one command."""

from __future__ import annotations

from typing import Any


def configure(verbs: Any) -> None:
    """Add the verb."""
