"""The groups of the mutation tests, and which mutants they leave out."""

import pytest

from benchmarks import mutation


@pytest.mark.parametrize("name", sorted(mutation.GROUPS))
def test_a_group_names_modules_and_tests_that_exist(name: str) -> None:
    group = mutation.GROUPS[name]
    assert group.modules and group.tests
    assert [path for path in group.modules + group.tests if not (mutation.ROOT / path).exists()] == []


@pytest.mark.parametrize(
    "difference",
    [
        "-    a = np.zeros(n, dtype=np.int64)\n+    a = np.zeros(n, dtype=None)",
        "-    a = np.zeros(n, dtype=np.int64)\n+    a = np.zeros(n, )",
        "-    a = b.astype(np.int64)\n+    a = b.astype(None)",
        '-    raise Conflict("not queued")\n+    raise Conflict("XXnot queuedXX")',
    ],
)
def test_element_types_and_wording_are_left_out(difference: str) -> None:
    assert mutation.reason_left_out(difference) is not None


@pytest.mark.parametrize(
    "difference",
    [
        "-    if a > limit:\n+    if a >= limit:",
        "-    a = np.zeros(n, dtype=np.int64)\n+    a = np.zeros(None, dtype=np.int64)",
        '-    return table["a"] + 1\n+    return table["a"] + 2',
        '-    if state == "queued":\n+    if state == "XXqueuedXX":',
        "-    raise Conflict(name)\n+    raise Conflict(None)",
    ],
)
def test_what_decides_is_tested(difference: str) -> None:
    assert mutation.reason_left_out(difference) is None
