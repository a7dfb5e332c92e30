"""Links and resources of a mission description: valid ones, and one clear line for each fault."""

from __future__ import annotations

import pytest

from ground_service.errors import InvalidInput
from ground_service.ground import Ground
from ground_service.missions.model import format_mission, parse_mission
from ground_service.missions.service import add_mission

HEAD = 'name = "selenita"\n[spacecraft]\nid = {id}\n'
LINK = """
[[links]]
name = "lab"
kind = "tcp"
downlink = "127.0.0.1:10015"
uplink = "127.0.0.1:10025"
"""


def text(*parts: str, number: int = 76) -> str:
    return HEAD.format(id=number) + "\n".join(parts)


def test_links_are_read_with_their_defaults_and_written_again() -> None:
    mission = parse_mission(text(LINK))
    assert mission.links is not None
    link = mission.links[0]
    assert (link.send, link.format, link.reconnect, link.silence_s) == ("automatic", "cltu", True, 60.0)
    again = parse_mission(format_mission(mission))
    assert again == mission and again.revision == mission.revision


def test_a_description_without_links_keeps_its_revision() -> None:
    plain = parse_mission(text())
    assert plain.links is None
    assert plain.revision == parse_mission(text("[resources]")).revision


@pytest.mark.parametrize(
    ("parts", "place", "expected"),
    [
        ((LINK.replace("10015", "99999"),), "links.0", "downlink as HOST:PORT, found '127.0.0.1:99999'"),
        ((LINK.replace("downlink", "downlnk"),), "links.0.downlnk", "'downlink'"),
        ((LINK, LINK), "", "each name of links once, found 'lab' again"),
        (('[[links]]\nname = "a"\nkind = "file"\ndownlink = "in"',), "links.0", "absolute path of a folder"),
        (
            ('[[links]]\nname = "a"\nkind = "file"\ndownlink = "/x"\nuplink = "/x"',),
            "links.0",
            "different folders",
        ),
        (('[[links]]\nname = "a"\nkind = "tcp"',), "links.0", "downlink, uplink or both, found neither"),
        ((LINK.replace('"lab"', '"../lab"'),), "links.0.name", "pattern"),
        (("[resources]\nobserve_hours_per_day = 25.0",), "resources.observe_hours_per_day", "24"),
    ],
)
def test_a_fault_is_one_line_with_its_place(parts: tuple[str, ...], place: str, expected: str) -> None:
    with pytest.raises(InvalidInput) as refused:
        parse_mission(text(*parts), "mission.toml")
    message = str(refused.value)
    assert place in message and expected in message and "\n" not in message


def test_links_need_a_spacecraft() -> None:
    with pytest.raises(InvalidInput, match="a spacecraft id with links, found none"):
        parse_mission('name = "x"\n' + LINK)


def test_two_spacecraft_cannot_use_the_same_link_name(ground: Ground) -> None:
    add_mission(ground, text(LINK).encode())
    with pytest.raises(InvalidInput, match="'lab' of spacecraft 76"):
        add_mission(ground, text(LINK, number=77).encode())
    add_mission(ground, text(LINK, "[resources]\nbattery_wh = 60.0").encode())
    add_mission(ground, text(LINK.replace("lab", "other"), number=77).encode())
