"""Create the schema of version 1.0 from its frozen snapshot.

Revision: 1.0, the first
"""

from pathlib import Path

from alembic import op

from ground_service.store.roles import create_schema

revision = "1.0"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    create_schema(op.get_bind(), Path(__file__).parents[1] / "schema_1.0.json")
    op.execute(f"INSERT INTO audit_head (id, number, sha256) VALUES (1, 0, '{'0' * 64}')")
