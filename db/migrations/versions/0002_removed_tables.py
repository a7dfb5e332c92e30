"""Remove the digests of rows with their triggers.

Revision: 1.1, after 1.0
"""

from alembic import op

revision = "1.1"
down_revision = "1.0"
branch_labels = None
depends_on = None

REMOVED_TABLES = ("row_digests",)
FUNCTIONS = (
    "SELECT proname FROM pg_proc "
    "WHERE starts_with(proname, 'linna_digest_') AND pronamespace = current_schema()::regnamespace"
)


def upgrade() -> None:
    bind = op.get_bind()
    if bind.dialect.name == "postgresql":
        for function in bind.exec_driver_sql(FUNCTIONS).scalars().all():
            op.execute(f'DROP FUNCTION "{function}" CASCADE')
    for table in REMOVED_TABLES:
        op.drop_table(table)
