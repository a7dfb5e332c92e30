"""A packet dictionary as JSON text, so that an archive can carry the definitions that its packets were made with."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from tmtc.dictionary.fields import Field
from tmtc.dictionary.schema import Dictionary, Group, PacketDefinition
from tmtc.errors import MalformedPacket


def format_dictionary(dictionary: Dictionary) -> str:
    """JSON text that `parse_dictionary` makes an equal dictionary of."""
    content = {
        "version": dictionary.version,
        "hash": dictionary.hash,
        "telemetry": [asdict(definition) for definition in dictionary.telemetry],
        "telecommands": [asdict(definition) for definition in dictionary.telecommands],
    }
    return json.dumps(content, indent=1) + "\n"


def parse_dictionary(text: str, source: str = "dictionary") -> Dictionary:
    """The dictionary in JSON text, checked against the hash that stands in it.

    Raises
    ------
    MalformedPacket
        If the text is no dictionary, or is not the one that was written.
    """
    try:
        content = json.loads(text)
        dictionary = Dictionary(
            int(content["version"]),
            tuple(_definition(item) for item in content["telemetry"]),
            tuple(_definition(item) for item in content["telecommands"]),
        )
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise MalformedPacket(f"{source}: expected a packet dictionary, found something else ({error})") from None
    if dictionary.hash != content.get("hash"):
        raise MalformedPacket(
            f"{source}: expected a dictionary with hash {str(content.get('hash'))[:16]}…, "
            f"found one with {dictionary.hash[:16]}…"
        )
    return dictionary


def _definition(given: Mapping[str, Any]) -> PacketDefinition:
    group = given["group"]
    values = {
        **given,
        "fields": tuple(_field(item) for item in given["fields"]),
        "group": None if group is None else Group(**{**group, "fields": tuple(map(_field, group["fields"]))}),
    }
    return PacketDefinition(**values)


def _field(given: Mapping[str, Any]) -> Field:
    def pair(value: Any) -> Any:
        return None if value is None else tuple(value)

    values = {
        **given,
        "labels": tuple((int(code), str(name)) for code, name in given["labels"]),
        "warning": pair(given["warning"]),
        "alarm": pair(given["alarm"]),
    }
    return Field(**values)
