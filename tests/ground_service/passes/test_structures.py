"""Housekeeping structures without a table of their own: live values, series, limits and drawing from packets."""

import pytest

from ground_service.client.local import local_client
from ground_service.evaluation import inputs
from ground_service.ground import Ground
from lunar.timescales import format_utc, utc_ns_from_ticks
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus

TICKS = 900_000_000 * 65_536
HOT_C = 61.25


def test_a_parameter_of_a_further_structure_has_a_series_a_live_value_an_alarm_and_a_drawing(
    ground: Ground, monkeypatch: pytest.MonkeyPatch
) -> None:
    zeros = {field.name: 0 for field in DICTIONARY.packet("performance").fields} | {"structure_id": 2}
    values = [10.0, HOT_C, 20.0]
    packets = [
        DICTIONARY.pack(
            "performance",
            zeros | {"camera_temperature_c": value},
            ticks=TICKS + (second << 16),
            sequence_count=second,
        )
        for second, value in enumerate(values)
    ]
    with local_client(ground, "ann") as client:
        client.ingest_file(encode_cadus(packets[::-1], spacecraft_id=76))
        start, stop = (format_utc(int(utc_ns_from_ticks(TICKS + (s << 16)))) for s in (-60, 60))
        pass_id = client.define_pass("pass", start, stop, 76).id
        listed = {one.name: one for one in client.list_parameters(pass_id).parameters}
        assert (listed["camera_temperature_c"].packet, listed["camera_temperature_c"].unit) == (
            "performance",
            "degC",
        )
        series = client.get_parameter(pass_id, "camera_temperature_c")
        assert [bucket.mean for bucket in series.buckets] == values
        live = {one.name: one for one in client.list_live_parameters(76)}["camera_temperature_c"]
        assert (live.value, live.limit_state) == (20.0, "within")
        [alarm] = client.list_alarms()
        assert (alarm.name, alarm.severity, alarm.value, alarm.active) == (
            "camera_temperature_c",
            "alarm",
            HOT_C,
            False,
        )
        monkeypatch.setattr(inputs, "DRAWN", ("camera_temperature_c",))
        [drawn] = inputs.load_pass_inputs(ground, pass_id).housekeeping
        assert (drawn.name, drawn.unit, drawn.values.tolist()) == ("camera_temperature_c", "°C", values)
