"""Add the missions that users and tokens are limited to.

Revision: 1.3, after 1.2
"""

import sqlalchemy as sa
from alembic import op

revision = "1.3"
down_revision = "1.2"
branch_labels = None
depends_on = None


def upgrade() -> None:
    for table in ("users", "tokens"):
        op.add_column(table, sa.Column("missions", sa.JSON(), nullable=True))
