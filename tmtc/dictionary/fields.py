"""One number of a packet: how it is stored and what it means. Tables of names need no numerical library."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Field:
    """One number of a packet, or `size` numbers of one kind.

    `minimum` and `maximum` are engineering values refused on packing; `warning` and `alarm` are (low, high)
    limits for monitoring on the ground. `saturate` clips what does not fit instead of refusing it.
    `missing` is the raw code of "not known" (engineering NaN).
    """

    name: str
    type: str
    description: str
    unit: str = ""
    size: int = 1
    scale: float = 1.0
    offset: float = 0.0
    labels: tuple[tuple[int, str], ...] = ()
    minimum: float | None = None
    maximum: float | None = None
    missing: int | None = None
    saturate: bool = False
    warning: tuple[float, float] | None = None
    alarm: tuple[float, float] | None = None

    @property
    def is_float(self) -> bool:
        """Return whether it is stored as an IEEE 754 number."""
        return self.type[0] == "f"

    @property
    def is_calibrated(self) -> bool:
        """Return whether the engineering value differs from the raw one."""
        return self.scale != 1.0 or self.offset != 0.0 or self.missing is not None

    @property
    def octets(self) -> int:
        """Octets on the link."""
        return self.size * int(self.type[1:]) // 8

    @property
    def dtype(self) -> str:
        """The name of the big-endian numpy type of one element."""
        return f">{self.type[0]}{int(self.type[1:]) // 8}"

    @property
    def raw_limits(self) -> tuple[int, int]:
        """Least and greatest raw integer (integer types only)."""
        bits = int(self.type[1:])
        return (0, (1 << bits) - 1) if self.type[0] == "u" else (-(1 << bits - 1), (1 << bits - 1) - 1)

    def label(self, code: int) -> str:
        """The name of a raw code, or the number itself where it has none."""
        return dict(self.labels).get(int(code), str(int(code)))
