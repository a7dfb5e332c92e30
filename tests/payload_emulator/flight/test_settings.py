"""Settings that survive resets, interrupted writing and flipped bits."""

from __future__ import annotations

import numpy as np
import pytest

from payload_emulator.flight.onboard.settings import Recovery, Settings

VALUES = {"boot_count": 3, "parameters": {"scrub_interval_s": 5.0}, "schedule": [[17, "18a0"]]}


def written(*every: dict) -> np.ndarray:
    memory = np.zeros(1000, dtype=np.uint8)
    settings = Settings(memory)
    for values in every:
        assert settings.write(values)
    return memory


def test_new_memory_is_blank() -> None:
    assert Settings(np.zeros(1000, dtype=np.uint8)).read() == (Recovery.blank, {})


def test_the_newest_of_many_is_read() -> None:
    memory = written({"a": 1}, {"a": 2}, VALUES)
    settings = Settings(memory)
    assert settings.read() == (Recovery.whole, VALUES)
    assert settings.write({"a": 4})
    assert Settings(memory).read() == (Recovery.whole, {"a": 4})


@pytest.mark.parametrize("half", [0, 1])
@pytest.mark.parametrize("octet", [0, 5, 9, 13, 20, 60])
def test_a_flipped_bit_in_either_copy_costs_nothing(half: int, octet: int) -> None:
    memory = written({"a": 1}, VALUES)
    memory[500 * half + octet] ^= 0x04
    assert Settings(memory).read() == (Recovery.older, VALUES)


def test_writing_interrupted_anywhere_leaves_the_old_or_the_new() -> None:
    before, after = written(VALUES), written(VALUES, {"a": 2})
    changed = np.flatnonzero(before != after)
    # The copy with the lower generation is written first: the half that held generation 1.
    order = np.concatenate([changed[changed >= 500], changed[changed < 500]])
    for stop in range(order.size + 1):
        memory = before.copy()
        memory[order[:stop]] = after[order[:stop]]
        verdict, values = Settings(memory).read()
        assert values in (VALUES, {"a": 2}), stop
        assert verdict in (Recovery.whole, Recovery.older)


def test_two_damaged_copies_are_lost_and_what_does_not_fit_is_refused() -> None:
    memory = written(VALUES)
    memory[[20, 520]] ^= 1
    assert Settings(memory).read() == (Recovery.lost, {})
    memory = written(VALUES)
    settings = Settings(memory)
    settings.read()
    assert not settings.write({"much": "x" * 500})
    assert Settings(memory).read() == (Recovery.whole, VALUES)


def test_a_set_of_settings_knows_the_generation_that_it_wrote() -> None:
    memory = np.zeros(1000, dtype=np.uint8)
    settings = Settings(memory)
    for _ in range(3):
        assert settings.write(VALUES)
        found = Settings(memory)
        found.read()
        assert found.generation == settings.generation
