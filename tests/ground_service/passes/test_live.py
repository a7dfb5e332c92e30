"""Newest values of the parameters of a spacecraft."""

from pathlib import Path
from typing import Any

import pytest

from ground_service.clock import set_mission_clock
from ground_service.contacts.commanding.service import enter_command, reject_command
from ground_service.errors import NotFound
from ground_service.ground import Ground
from ground_service.ingest.service import ingest_file
from ground_service.missions.service import add_mission
from ground_service.passes.live import list_spacecraft, live_parameters
from lunar.timescales import utc_ns_from_ticks
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus

TICKS = 900_000_000 * 65_536


def receive(ground: Ground, tmp_path: Path, second: int, **values: float) -> None:
    zeros: dict[str, Any] = {field.name: 0 for field in DICTIONARY.packet("housekeeping").fields}
    packet = DICTIONARY.pack(
        "housekeeping",
        zeros | values | {"structure_id": 1},
        ticks=TICKS + second * 65_536,
        sequence_count=second,
    )
    file = tmp_path / f"{second}.cadu"
    file.write_bytes(encode_cadus([packet], spacecraft_id=76))
    ingest_file(ground, file)


def test_the_newest_packet_by_on_board_time_counts(either: Ground, tmp_path: Path) -> None:
    receive(either, tmp_path, 10, temperature_c=70.25, bus_voltage_v=12.0, mode=2, model_hash=0xDF7F5779)
    receive(either, tmp_path, 5, temperature_c=20.0)  # arrives later, and is older
    found = {one.name: one for one in live_parameters(either, 76, "flight")}
    temperature = found["temperature_c"]
    assert (temperature.value, temperature.text, temperature.limit_state) == (70.25, "70.25", "warning")
    assert (temperature.limits, temperature.packet) == ("-20 to 60", "housekeeping")
    assert (found["mode"].text, found["mode"].limit_state) == ("observing", "none")
    assert found["model_hash"].text == "df7f5779"
    assert temperature.time.utc_ns == int(utc_ns_from_ticks(TICKS + 10 * 65_536))
    (listed,) = list_spacecraft(either)
    assert (listed.spacecraft_id, listed.instance, listed.name) == (76, "flight", None)
    add_mission(either, b'name = "m"\n[spacecraft]\nid = 76\nname = "SelenITA"\n')
    assert list_spacecraft(either)[0].name == "SelenITA"


@pytest.mark.parametrize(("later_s", "age_s"), [(42.5, 42.5), (-1e8, 0.0)])
def test_ages_are_those_of_mission_time_and_count_from_the_newest_packet_where_that_is_later(
    ground: Ground, tmp_path: Path, later_s: float, age_s: float
) -> None:
    receive(ground, tmp_path, 0)
    now = int(utc_ns_from_ticks(TICKS)) + round(later_s * 1e9)
    set_mission_clock(lambda: now)
    try:
        assert {one.age_s for one in live_parameters(ground, 76, "flight")} == {age_s}
    finally:
        set_mission_clock(None)


def test_an_unknown_spacecraft_is_not_found(ground: Ground) -> None:
    with pytest.raises(NotFound, match="spacecraft 5"):
        live_parameters(ground, 5, "flight")


def test_a_mistyped_spacecraft_is_listed_until_its_telecommand_is_rejected(either: Ground) -> None:
    command = enter_command(either, "test_connection", {}, spacecraft_id=67, actor="ann")
    assert [one.spacecraft_id for one in list_spacecraft(either)] == [67]
    reject_command(either, command, actor="ann", reason="mistyped")
    assert list_spacecraft(either) == []
