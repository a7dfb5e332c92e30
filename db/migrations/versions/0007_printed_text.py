"""Add the printed text of replays that failed.

Revision: 1.6, after 1.5
"""

import sqlalchemy as sa
from alembic import op

revision = "1.6"
down_revision = "1.5"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("replays", sa.Column("printed", sa.Text(), nullable=True))
