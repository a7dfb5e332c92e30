"""HTTP operations on links and contacts."""

from typing import Annotated

from fastapi import Path, Query

from ground_service.access.security import Operator, Viewer
from ground_service.clock import mission_now_ns
from ground_service.contacts.links import service
from ground_service.contacts.links.model import Contacts, LinkStatus
from ground_service.http.common import GroundOf
from ground_service.http.model import PageOf, RequestTime
from ground_service.http.requests import operations, problems
from lunar.constants import DAY_NS

links = operations("links")

LinkName = Annotated[str, Path(max_length=64, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", examples=["lab"])]


@links.get("/links")
def list_links(ground: GroundOf, caller: Viewer) -> PageOf[LinkStatus]:
    """List the links of the mission descriptions in force with their state."""
    return PageOf.all_of(caller.own(service.list_links(ground)))


@links.get("/links/{name}")
def get_link(ground: GroundOf, _: Viewer, name: LinkName) -> LinkStatus:
    """Show a link with its state."""
    return service.get_link(ground, name)


@links.post("/links/{name}/send", responses=problems(409))
def send_link(ground: GroundOf, caller: Operator, name: LinkName) -> LinkStatus:
    """Send the released telecommands now, in a contact or not."""
    return service.request_send(ground, name, actor=caller.name)


@links.get("/contacts")
def list_contacts(
    ground: GroundOf,
    caller: Viewer,
    since: Annotated[RequestTime | None, Query(description="Default: a day before mission time")] = None,
    until: Annotated[RequestTime | None, Query(description="Default: two days after `since`")] = None,
    link: Annotated[str | None, Query(max_length=64, description="Contacts of this link only")] = None,
) -> Contacts:
    """List contacts that took place, were missed or are predicted from the geometry of the stations."""
    start = mission_now_ns() - DAY_NS if since is None else since.utc_ns
    stop = start + 2 * DAY_NS if until is None else until.utc_ns
    return service.list_contacts(ground, start, stop, link, may_use=caller.may_use)
