"""Replace the octets that wait for others by fragments of packets; list the pieces that wait without a position.

Revision: 1.2, after 1.1
"""

import json
import logging

import sqlalchemy as sa
from alembic import op

revision = "1.2"
down_revision = "1.1"
branch_labels = None
depends_on = None

OPENER, MIDDLE = 0, 1
log = logging.getLogger("ground_service.store.upgrade")

EDGES = sa.table(
    "stream_edges",
    *(
        sa.column(name)
        for name in (
            "id", "domain", "identity", "role", "open", "count", "next_count", "fit", "file_sha256", "start",
            "length", "octets",
        )
    ),
)  # fmt: skip


def upgrade() -> None:
    op.create_table(
        "fragments",
        sa.Column("id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("vehicle_id", sa.Integer(), nullable=False),
        sa.Column("channel", sa.String(length=24), nullable=False),
        sa.Column("begins", sa.SmallInteger(), nullable=False),
        sa.Column("ends", sa.SmallInteger(), nullable=False),
        sa.Column("count", sa.SmallInteger(), nullable=False),
        sa.Column("next_count", sa.SmallInteger(), nullable=False),
        sa.Column("first", sa.BigInteger(), nullable=False),
        sa.Column("last", sa.BigInteger(), nullable=False),
        sa.Column("stream", sa.String(length=200), nullable=False),
        sa.Column("fit", sa.Integer(), nullable=False),
        sa.Column("digest", sa.LargeBinary(length=16), nullable=False),
        sa.Column("octets", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(["vehicle_id"], ["vehicles.id"], name=op.f("fk_fragments_vehicle_id_vehicles")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_fragments")),
        sa.UniqueConstraint("vehicle_id", "channel", "digest", name=op.f("uq_fragments_vehicle_id_channel_digest")),
    )
    op.create_index("ix_fragments_first", "fragments", ["vehicle_id", "channel", "count", "fit"])
    op.create_index("ix_fragments_last", "fragments", ["vehicle_id", "channel", "next_count", "fit"])
    _keep_fragments()
    _list_waiting()
    op.drop_table("stream_edges")
    op.drop_table("known_links")
    op.drop_index("ix_pieces_unread", "pieces")
    op.alter_column("pieces", "links_tried", new_column_name="waits")
    op.create_index("ix_pieces_waiting", "pieces", ["scope", "waits"])
    op.execute("UPDATE pieces SET waits = CASE WHEN waits IS NULL OR stream = '' THEN NULL ELSE 1 END")


def _keep_fragments() -> None:
    """Copy the octets that wait in virtual channels."""
    bind = op.get_bind()
    names = (
        "vehicle_id", "channel", "begins", "ends", "count", "next_count", "first", "last", "stream", "fit", "digest",
        "octets",
    )  # fmt: skip
    fragments = sa.table("fragments", *(sa.column(name) for name in names))
    waiting = sa.select(EDGES).where(EDGES.c.domain.like("channel %"), EDGES.c.open == 1)
    for row in bind.execute(waiting).mappings().all():
        _, vehicle, channel = row["domain"].split(" ", 2)
        begins = row["role"] == OPENER
        values = {
            "vehicle_id": int(vehicle),
            "channel": channel,
            "begins": int(begins),
            "ends": int(row["role"] not in (OPENER, MIDDLE)),
            "count": -1 if begins else row["count"],
            "next_count": row["next_count"],
            "first": 0,
            "last": 0,
            "stream": "",
            "fit": row["fit"],
            "digest": row["identity"],
            "octets": row["octets"],
        }
        bind.execute(sa.insert(fragments).values(values))


def _list_waiting() -> None:
    """State the octets that wait in the accounting of their ingests, and log the pieces without a position."""
    bind = op.get_bind()
    ingests = sa.table("ingests", sa.column("id"), sa.column("file_sha256"), sa.column("accounting", sa.JSON()))
    pieces = sa.table("pieces", sa.column("ingest_id"), sa.column("stream"))
    query = (
        sa.select(EDGES.c.file_sha256, EDGES.c.domain, sa.func.sum(EDGES.c.length))
        .where(EDGES.c.domain.not_like("channel %"), EDGES.c.open == 1, EDGES.c.file_sha256.is_not(None))
        .group_by(EDGES.c.file_sha256, EDGES.c.domain)
    )
    waiting: dict[str, int] = {}
    for sha256, _, octets in bind.execute(query):
        waiting[sha256] = min(int(octets), waiting.get(sha256, int(octets)))
    found = sa.select(ingests, pieces.c.stream).join(pieces, pieces.c.ingest_id == ingests.c.id)
    for row in bind.execute(found.order_by(ingests.c.id)).mappings().all():
        accounting = row["accounting"] if isinstance(row["accounting"], dict) else json.loads(row["accounting"])
        octets = waiting.get(row["file_sha256"], 0)
        if "octets_pending" in accounting and accounting["octets_pending"] != octets:
            changed = {**accounting, "octets_pending": octets}
            bind.execute(sa.update(ingests).where(ingests.c.id == row["id"]).values(accounting=changed))
        if octets and not row["stream"]:
            log.warning(
                "ingest %d, file %s: %d octets wait for others without a position; ingest the files of its recording "
                "again with 'linna ingest --recording NAME FILE...'",
                row["id"],
                row["file_sha256"],
                octets,
            )
