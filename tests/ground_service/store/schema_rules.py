"""Rule of upgrades without interruption: what a migration may change while the version before it runs."""

RULE = "an expansion only adds tables, indexes that are not unique, and columns that are nullable or have a default"


def breaking_changes(before, after):
    """Return the differences between two reflected schemas that break a program written for the first one."""
    found = []
    for name, old in before.tables.items():
        new = after.tables.get(name)
        if new is None:
            found.append(f"{name}: removed")
            continue
        found += [f"{name}.{column}: {what}" for column, what in _changed_columns(old, new)]
        kept = {str(sorted(one.columns.keys())) for one in old.indexes if one.unique}
        found += [
            f"{name}: new unique index {one.name}"
            for one in new.indexes
            if one.unique and str(sorted(one.columns.keys())) not in kept
        ]
        found += [
            f"{name}: {len(new.constraints)} constraints in place of {len(old.constraints)}"
            for _ in [0]
            if len(new.constraints) > len(old.constraints)
        ]
    return found


def _changed_columns(old, new):
    changes = []
    for column in old.columns:
        other = new.columns.get(column.name)
        if other is None:
            changes.append((column.name, "removed"))
        elif str(other.type) != str(column.type):
            changes.append((column.name, f"{column.type} changed to {other.type}"))
        elif column.nullable and not other.nullable:
            changes.append((column.name, "no longer nullable"))
    for column in new.columns:
        if column.name not in old.columns and not column.nullable and column.server_default is None:
            changes.append((column.name, "neither nullable nor with a default"))
    return changes
