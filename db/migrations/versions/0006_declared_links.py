"""Remove the link settings of earlier receptions.

Revision: 1.5, after 1.4
"""

from __future__ import annotations

from alembic import op

revision = "1.5"
down_revision = "1.4"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.drop_table("good_links")
