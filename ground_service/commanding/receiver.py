"""The state of a spacecraft's telecommand receiver, by the command link control words of its newest telemetry."""

from __future__ import annotations

from sqlalchemy import select

from ground_service.commanding.model import UplinkChannel, UplinkState
from ground_service.errors import NotFound
from ground_service.ground import Ground
from ground_service.store import repository

INGESTS_LOOKED_AT = 200
"""So many ingests back a channel is looked for: receptions without frames of it may have come in between."""


def uplink_state(ground: Ground, spacecraft_id: int, instance: str) -> UplinkState:
    """Each telecommand channel of a spacecraft as the ingest that was entered last tells it.

    Telemetry that is ingested late is the newest to the ground all the same: `received` says when it came.

    Raises
    ------
    NotFound
        If there is no such spacecraft.
    """
    ingests, vehicles = repository.INGESTS, repository.VEHICLES
    with ground.database.reading() as connection:
        if repository.find(connection, vehicles, ccsds_id=spacecraft_id, instance=instance) is None:
            raise NotFound("spacecraft", f"{spacecraft_id} ({instance})")
        # A file of several spacecraft is entered under one of them.
        rows = connection.execute(
            select(ingests.c.id, ingests.c.received_utc_ns, ingests.c.accounting)
            .join(vehicles, vehicles.c.id == ingests.c.vehicle_id)
            .where(vehicles.c.instance == instance, ingests.c.state == "done")
            .order_by(ingests.c.id.desc())
            .limit(INGESTS_LOOKED_AT)
        )
        newest: dict[int, UplinkChannel] = {}
        for ingest_id, received_utc_ns, accounting in rows:
            for seen in accounting.get("uplink", ()):
                if seen["spacecraft_id"] == spacecraft_id:
                    channel = UplinkChannel.of(seen, ingest_id=ingest_id, received=received_utc_ns)
                    newest.setdefault(channel.virtual_channel, channel)
    return UplinkState(
        spacecraft_id=spacecraft_id, instance=instance, channels=[newest[one] for one in sorted(newest)]
    )
