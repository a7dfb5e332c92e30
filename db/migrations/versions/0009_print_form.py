"""Add the print form of reports, which their PDF is made of.

Revision: 1.8, after 1.7
"""

import sqlalchemy as sa
from alembic import op

revision = "1.8"
down_revision = "1.7"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("reports", sa.Column("print_sha256", sa.String(64), nullable=True))
