"""One number of a packet: how it is stored and what it means. Tables of names need no numerical library."""

from dataclasses import dataclass

from tmtc.dictionary.codes import CLOCK_STATES, IMAGE_QUALITIES, MODES


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


HOUSEKEEPING_FIELDS = (
    Field("structure_id", "u16", "Housekeeping structure, always 1", minimum=1, maximum=1),
    Field("boot_count", "u16", "Boots since manufacture"),
    Field("mode", "u8", "Mode of the payload", labels=MODES),
    Field("frames_processed", "u32", "Frames handed to the detector since boot"),
    Field("frames_bad", "u32", "Frames refused for their image quality since boot"),
    Field("detections_total", "u32", "Craters detected since boot"),
    Field("packets_sent", "u32", "Telemetry packets made since boot"),
    Field("anchor_reads", "u32", "Reads of the anchor ephemeris since boot, all estimators"),
    Field("events_sent", "u32", "Event packets made since boot"),
    Field("telecommands_accepted", "u16", "Telecommands accepted since boot"),
    Field("telecommands_rejected", "u16", "Telecommands rejected since boot"),
    Field("last_image_quality", "u8", "Verdict on the last image", labels=IMAGE_QUALITIES),
    Field(
        "temperature_c", "i16", "Temperature of the processor board", "degC", scale=0.01,
        saturate=True, warning=(-20.0, 60.0), alarm=(-40.0, 85.0),
    ),
    Field(
        "bus_voltage_v", "u16", "Voltage of the supply bus", "V", scale=0.001, saturate=True,
        warning=(11.0, 13.0), alarm=(10.0, 14.0),
    ),
    Field(
        "power_w", "u16", "Power drawn by the payload", "W", scale=0.01, saturate=True,
        warning=(0.0, 15.0), alarm=(0.0, 20.0),
    ),
    Field("memory_used_kib", "u32", "Memory in use", "KiB"),
    Field("queue_depth", "u16", "Telemetry packets waiting for downlink"),
    Field(
        "storage_used_permille", "u16", "Packet store in use", "1/1000", maximum=1000,
        warning=(0.0, 800.0), alarm=(0.0, 950.0),
    ),
    Field("model_hash", "u32", "First 32 bits of the SHA-256 of the detector model"),
    Field("parameters_hash", "u32", "First 32 bits of the SHA-256 of the parameter table"),
    Field("catalogue_hash", "u32", "First 32 bits of the SHA-256 of the catalogue table"),
    Field("anchor_table_hash", "u32", "First 32 bits of the SHA-256 of the anchor ephemeris"),
    Field("clock_status", "u8", "State of the on-board clock", labels=CLOCK_STATES),
    Field("watchdog_resets", "u16", "Resets by the watchdog since manufacture"),
)  # fmt: skip
