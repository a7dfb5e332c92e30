"""Figures of mission runs that do not depend on processes, the wall clock or the numbers that a database gives."""

OF_PROCESSES = {"alarms", "form", "interventions_list", "kills", "monthly_reports", "starts", "wall_s"}
SKIPPED = {"pass_id", "report_id", "limit"}


def figures_of(value, name=""):
    """Return the numbers of a closing report by their paths; other values are part of the path."""
    if isinstance(value, dict) and value:
        left = SKIPPED | (OF_PROCESSES if not name else set())
        parts = [(f"{name}.{key}", one) for key, one in value.items() if key not in left]
    elif isinstance(value, list) and value:
        parts = [(f"{name}[{k}]", one) for k, one in enumerate(value)]
    else:
        return {name: value} if isinstance(value, int | float) else {f"{name}: {value}": 0}
    return {path: one for path, part in parts for path, one in figures_of(part, path).items()}
