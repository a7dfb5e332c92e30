"""Add the printed text of replays that failed.

Revision: 1.5, after 1.4
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "1.5"
down_revision = "1.4"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("replays", sa.Column("printed", sa.Text(), nullable=True))
