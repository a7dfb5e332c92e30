"""A dictionary written down and read again."""

import json

import pytest

from tmtc.dictionary.definitions import format_dictionary, parse_dictionary
from tmtc.dictionary.payload import DICTIONARY
from tmtc.errors import MalformedPacket


def test_a_dictionary_survives_being_written_down() -> None:
    again = parse_dictionary(format_dictionary(DICTIONARY))
    assert (again.version, again.hash) == (DICTIONARY.version, DICTIONARY.hash)
    assert (again.telemetry, again.telecommands) == (DICTIONARY.telemetry, DICTIONARY.telecommands)


def test_a_packet_of_today_is_read_with_the_dictionary_of_the_archive() -> None:
    packet = DICTIONARY.pack("connection_report", {}, ticks=7, sequence_count=1)
    assert parse_dictionary(format_dictionary(DICTIONARY)).unpack(packet)[0] == "connection_report"


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"version": 1, "telemetry": [{}], "telecommands": []}'])
def test_something_else_is_refused(text: str) -> None:
    with pytest.raises(MalformedPacket, match="expected a packet dictionary"):
        parse_dictionary(text, "old.json")


def test_a_changed_definition_is_refused() -> None:
    content = json.loads(format_dictionary(DICTIONARY))
    content["telemetry"][0]["fields"][0]["type"] = "u32"
    with pytest.raises(MalformedPacket, match="expected a dictionary with hash"):
        parse_dictionary(json.dumps(content))
