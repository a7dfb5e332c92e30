"""Gravity fields of the Moon: coefficient files, a small built-in field, acceleration and its gradient.

Positions and accelerations are in the **principal-axis** frame that the coefficients refer to (for GRAIL and Lunar
Prospector fields that of a JPL ephemeris), never in the mean-Earth frame of the maps.  The central term is included.

    V = GM/r sum_nm (R/r)^n Pbar_nm(sin lat) (Cbar_nm cos m lon + Sbar_nm sin m lon)

with coefficients normalised so that the mean square of every harmonic over the sphere is 1 (4 pi normalisation, no
Condon-Shortley phase).

References
----------
Montenbruck and Gill, Satellite Orbits (2000), section 3.2.
File formats: ICGEM (Barthelmes and Foerste 2011), GMAT ``.cof``, PDS SHADR (ASCII tables of the PDS Geosciences Node),
text of pyshtools (Wieczorek and Meschede 2018), which states radius and GM in m or km and no normalisation.
Degree 2, order 0 of the Moon: -9.088e-5 fully normalised, -2.032e-4 not (Lemoine et al. 2014, GRGM900C).
"""

from __future__ import annotations

import math
import re
import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from lunar.arrays import FloatArray
from lunar.constants import GM_MOON_M3_S2, MOON_RADIUS_M
from lunar.errors import DataFileError, OrbitError
from lunar.plausible import GRAVITY_ALIKE, GRAVITY_ALIKE_DEGREE, GRAVITY_TERM

GM_TOLERANCE, RADIUS_TOLERANCE, C20_TOLERANCE = 1e-3, 1e-2, 0.05
"""Relative deviations from the Moon of a field: its GM, the radius that it refers to, and its flattening."""

C20_MOON = -9.088e-5

Record = tuple[int, int, int, float, float]
"""Line number, degree, order, C, S."""


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class GravityField:
    """Fully normalised coefficients [n, m], zero above the diagonal; ``c_bar[0, 0]`` is 1."""

    name: str
    gm_m3_s2: float
    radius_m: float
    c_bar: FloatArray = field(repr=False)
    s_bar: FloatArray = field(repr=False)

    @property
    def degree(self) -> int:
        return len(self.c_bar) - 1

    @property
    def words(self) -> str:
        """Return name, degree, GM and radius, as printed with figures of the field."""
        return (
            f"{self.name} to degree {self.degree}, GM {self.gm_m3_s2 / 1e9:.10g} km3/s2, radius "
            f"{self.radius_m / 1e3:.10g} km"
        )

    def truncated(self, degree: int) -> GravityField:
        """Return the field without its terms above ``degree``."""
        if not 0 <= degree <= self.degree:
            raise OrbitError(f"gravity field {self.name}: expected a degree from 0 to {self.degree}, found {degree}")
        if degree == self.degree:
            return self
        keep = slice(0, degree + 1)
        return GravityField(self.name, self.gm_m3_s2, self.radius_m, self.c_bar[keep, keep], self.s_bar[keep, keep])


def acceleration(gravity: GravityField, position_pa_m: ArrayLike, degree: int | None = None) -> FloatArray:
    """Return the acceleration in m/s^2, shape ``(..., 3)``, at positions ``(..., 3)`` outside the body."""
    from lunar import _gravity_kernel as kernel

    positions = np.asarray(position_pa_m, dtype=np.float64)
    flat = np.ascontiguousarray(positions.reshape(-1, 3))
    return np.asarray(kernel.accelerations(packed(gravity, degree), flat)).reshape(positions.shape)


def gradient(gravity: GravityField, position_pa_m: ArrayLike, degree: int | None = None) -> FloatArray:
    """Return the derivative of the acceleration by position, 1/s^2, shape ``(..., 3, 3)``: symmetric, no trace."""
    from lunar import _gravity_kernel as kernel

    positions = np.asarray(position_pa_m, dtype=np.float64)
    flat = np.ascontiguousarray(positions.reshape(-1, 3))
    return np.asarray(kernel.gradients(packed_gradient(gravity, degree), flat)).reshape(*positions.shape, 3)


_PACKED: weakref.WeakKeyDictionary[GravityField, dict[tuple[str, int], FloatArray]] = weakref.WeakKeyDictionary()


def packed(gravity: GravityField, degree: int | None = None) -> FloatArray:
    """Return the field, cut at ``degree``, as the array that the compiled acceleration reads; kept with the field."""
    from lunar import _gravity_kernel as kernel

    return _kept(gravity, "acceleration", gravity.degree if degree is None else degree, kernel.pack)


def packed_gradient(gravity: GravityField, degree: int | None = None) -> FloatArray:
    """Return the field, cut at ``degree``, as the array that the compiled gradient reads; kept with the field."""
    from lunar import _gravity_kernel as kernel

    return _kept(gravity, "gradient", gravity.degree if degree is None else degree, kernel.pack_gradient)


def load_gravity(path: Path | str, max_degree: int | None = None) -> GravityField:
    """Return the field of an ICGEM ``.gfc``, GMAT ``.cof``, PDS SHADR or pyshtools file, recognised by its content.

    Raises
    ------
    DataFileError
        Where the file is missing, is none of these, is cut short, lacks coefficients, holds them in another
        normalisation than the full one, or is that of another body.
    """
    file = Path(path)
    try:
        lines = file.read_text(encoding="latin-1").splitlines()
    except OSError as error:
        raise DataFileError(file, "", "a gravity field file", error.strerror or str(error)) from None
    if any(line.strip().startswith("end_of_head") for line in lines):
        name, gm, radius, degree, records = _parse_icgem(file, lines)
    elif any(line.startswith("POTFIELD") for line in lines):
        name, gm, radius, degree, records = _parse_cof(file, lines)
    elif lines and lines[0].count(",") >= 5:
        name, gm, radius, degree, records = _parse_shadr(file, lines)
    elif (head := _shtools_header(lines)) is not None:
        name, gm, radius, degree, records = _parse_shtools(file, lines, head)
    else:
        raise DataFileError(
            file, "", "an ICGEM, GMAT .cof, PDS SHADR or pyshtools gravity field", "none of their headers"
        )
    if abs(gm / GM_MOON_M3_S2 - 1) > GM_TOLERANCE or abs(radius / MOON_RADIUS_M - 1) > RADIUS_TOLERANCE:
        moon = f"the Moon's GM of {GM_MOON_M3_S2:.6g} m3/s2 and radius of {MOON_RADIUS_M:.6g} m"
        raise DataFileError(file, "header", moon, f"{gm:.6g} m3/s2 and {radius:.6g} m")
    return _assembled(file, name, gm, radius, degree, records, max_degree)


def builtin_gravity() -> GravityField:
    """Return the built-in field to degree 12, for machines without data files.

    See `lunar._builtin_gravity` for its source.  At 30 km altitude the terms left out amount to some 5e-4 m/s^2.
    """
    from lunar import _builtin_gravity as table

    shape = (table.DEGREE + 1, table.DEGREE + 1)
    c_bar, s_bar = np.zeros(shape), np.zeros(shape)
    c_bar[0, 0] = 1.0
    for line in table.COEFFICIENTS.split("\n"):
        if line:
            n, m, c, s = line.split()
            c_bar[int(n), int(m)], s_bar[int(n), int(m)] = 1e-6 * float(c), 1e-6 * float(s)
    return GravityField(table.NAME, table.GM_M3_S2, table.RADIUS_M, c_bar, s_bar)


def _kept(
    gravity: GravityField, purpose: str, degree: int, pack: Callable[[FloatArray, FloatArray, float, float], FloatArray]
) -> FloatArray:
    kept = _PACKED.setdefault(gravity, {})
    key = (purpose, degree)
    if key not in kept:
        cut = gravity.truncated(degree)
        kept[key] = pack(cut.c_bar, cut.s_bar, cut.gm_m3_s2, cut.radius_m)
    return kept[key]


Parsed = tuple[str, float, float, int, Iterator[Record]]


def _parse_icgem(file: Path, lines: list[str]) -> Parsed:
    header: dict[str, str] = {}
    start = 0
    for number, line in enumerate(lines):
        words = line.split()
        if not words:
            continue
        if words[0] == "end_of_head":
            start = number + 1
            break
        if len(words) > 1:
            header[words[0]] = words[1]
    normalisation = header.get("norm", "fully_normalized")
    if normalisation != "fully_normalized":
        raise DataFileError(file, "header, norm", "fully_normalized", normalisation)
    gm = _real(file, "header, gravity_constant", header.get("gravity_constant", header.get("earth_gravity_constant")))
    radius = _real(file, "header, radius", header.get("radius"))
    degree = int(_real(file, "header, max_degree", header.get("max_degree")))

    def records() -> Iterator[Record]:
        for number, line in enumerate(lines[start:], start=start + 1):
            words = line.split()
            if not words or words[0] == "key":
                continue
            if words[0] not in ("gfc", "gfct"):
                raise DataFileError(file, f"line {number}", "a line that begins with gfc", repr(line.strip()[:40]))
            yield _record(file, number, words[1:5])

    return header.get("modelname", file.stem), gm, radius, degree, records()


def _parse_cof(file: Path, lines: list[str]) -> Parsed:
    at = next(number for number, line in enumerate(lines) if line.startswith("POTFIELD"))
    head = lines[at]
    words = head[15:].split()
    if not head[8:14].strip().replace(" ", "").isdigit() or len(words) < 3:
        raise DataFileError(file, f"line {at + 1}", "POTFIELD with degree, order, GM and radius", repr(head[:60]))
    degree = int(head[8:11])
    gm, radius = (_real(file, f"line {at + 1}", word) for word in words[1:3])
    if len(words) > 3 and _real(file, f"line {at + 1}", words[3]) != 1.0:
        raise DataFileError(file, f"line {at + 1}", "normalised coefficients (flag 1.0)", words[3])
    name = file.stem
    for line in lines[:at]:
        match = re.search(r"\]\s*(\S+)\s+C*\s*$", line)
        if match:
            name = match.group(1)
    ended = any(line.strip() == "END" for line in lines[at:])

    def records() -> Iterator[Record]:
        for number, line in enumerate(lines[at + 1 :], start=at + 2):
            if line.strip() == "END":
                return
            if not line.startswith("RECOEF"):
                if line.strip():
                    raise DataFileError(file, f"line {number}", "RECOEF", repr(line.strip()[:40]))
                continue
            # Columns run into each other where a number is negative.
            numbers = [line[8:11], line[11:14], line[17:38], line[38:59].strip() or "0"]
            yield _record(file, number, numbers)
        if not ended:
            raise DataFileError(file, "end of file", "END", "no such line")

    return name, gm, radius, degree, records()


def _parse_shadr(file: Path, lines: list[str]) -> Parsed:
    head = lines[0].split(",")
    radius_km, gm_km = (_real(file, "line 1", word) for word in head[:2])
    degree = int(_real(file, "line 1", head[3]))
    if int(_real(file, "line 1", head[5])) != 1:
        raise DataFileError(file, "line 1, normalisation state", "1 (fully normalised)", head[5].strip())

    def records() -> Iterator[Record]:
        for number, line in enumerate(lines[1:], start=2):
            if line.strip():
                yield _record(file, number, line.split(",")[:4])

    return file.stem, gm_km * 1e9, radius_km * 1e3, degree, records()


def _shtools_header(lines: list[str]) -> int | None:
    """Return the index of the line with radius, GM, rotation and degree, which one header line may precede."""
    head = [k for k, line in enumerate(lines) if line.strip() and not line.startswith("#")][:2]
    for k in head:
        words = lines[k].split(",")
        if len(words) in (4, 5) and all(re.fullmatch(r"\s*[-+.\dEeDd]+\s*", word) for word in words):
            return k
    return None


def _parse_shtools(file: Path, lines: list[str], head: int) -> Parsed:
    radius, gm, _, degree = (_real(file, f"line {head + 1}", word) for word in lines[head].split(",")[:4])
    unit_m = 1e3 if radius < 1e5 else 1.0

    def records() -> Iterator[Record]:
        for number, line in enumerate(lines[head + 1 :], start=head + 2):
            if line.strip() and not line.startswith("#"):
                yield _record(file, number, line.split(",")[:4])

    return file.stem, gm * unit_m**3, radius * unit_m, int(degree), records()


def _record(file: Path, number: int, words: list[str]) -> Record:
    try:
        n, m, c, s = words
        return (
            number,
            int(n),
            int(m),
            float(c.replace("D", "E").replace("d", "e")),
            float(s.replace("D", "E").replace("d", "e")),
        )
    except ValueError:
        found = repr(" ".join(words))
        raise DataFileError(file, f"line {number}", "degree, order and two coefficients", found) from None


def _real(file: Path, where: str, text: str | None) -> float:
    try:
        return float((text or "").replace("D", "E").replace("d", "e"))
    except ValueError:
        raise DataFileError(file, where, "a number", repr(text or "")) from None


def _assembled(
    file: Path, name: str, gm: float, radius: float, degree: int, records: Iterator[Record], max_degree: int | None
) -> GravityField:
    wanted = degree if max_degree is None else min(degree, max_degree)
    c_bar = np.zeros((wanted + 1, wanted + 1))
    s_bar = np.zeros_like(c_bar)
    seen = np.zeros_like(c_bar, dtype=bool)
    for number, n, m, c, s in records:
        if not (0 <= m <= n <= degree):
            raise DataFileError(file, f"line {number}", f"order <= degree <= {degree}", f"degree {n}, order {m}")
        if n > wanted:
            continue
        if seen[n, m]:
            raise DataFileError(file, f"line {number}", "every coefficient once", f"degree {n}, order {m} again")
        if not (math.isfinite(c) and math.isfinite(s)):
            raise DataFileError(file, f"line {number}", "finite coefficients", f"{c:g} {s:g}")
        c_bar[n, m], s_bar[n, m], seen[n, m] = c, s, True
    missing = np.argwhere(np.tril(~seen))
    missing = missing[missing[:, 0] >= 2]
    if len(missing):
        n, m = missing[0]
        raise DataFileError(
            file,
            f"degree {n}, order {m}",
            f"all coefficients to degree {wanted}",
            f"{len(missing)} missing, this one first",
        )
    if seen[0, 0] and abs(c_bar[0, 0] - 1.0) > 1e-12:
        raise DataFileError(file, "degree 0, order 0", "1", f"{c_bar[0, 0]!r}")
    c_bar[0, 0] = 1.0
    if wanted >= 2 and abs(c_bar[2, 0] / C20_MOON - 1.0) > C20_TOLERANCE:
        expected = f"the normalised flattening term {C20_MOON:g} of the Moon"
        raise DataFileError(file, "degree 2, order 0", expected, f"{float(c_bar[2, 0]):g}")
    _require_moon(file, radius, c_bar, s_bar)
    c_bar.flags.writeable = s_bar.flags.writeable = False
    return GravityField(name, gm, radius, c_bar, s_bar)


def _require_moon(file: Path, radius: float, c_bar: FloatArray, s_bar: FloatArray) -> None:
    """Refuse terms of a low degree unlike those of the Moon, and a term greater than any of its degree."""
    known = builtin_gravity()
    for n in range(2, min(len(c_bar) - 1, GRAVITY_ALIKE_DEGREE) + 1):
        there = np.concatenate([known.c_bar[n, : n + 1], known.s_bar[n, : n + 1]])
        here = np.concatenate([c_bar[n, : n + 1], s_bar[n, : n + 1]]) * (radius / known.radius_m) ** n
        off = float(np.linalg.norm(here - there) / np.linalg.norm(there))
        if off > GRAVITY_ALIKE:
            expected = f"terms within {GRAVITY_ALIKE:.0%} of those of the Moon in its principal axes"
            found = f"{off:.0%}: another scale, sign, order, meridian or normalisation?"
            raise DataFileError(file, f"degree {n}", expected, found)
    degree = np.arange(len(c_bar), dtype=np.float64)[:, None]
    size = np.maximum(np.abs(c_bar), np.abs(s_bar)) * degree**2
    size[:2] = 0.0
    if size.max() > GRAVITY_TERM:
        n, m = map(int, np.unravel_index(int(np.argmax(size)), size.shape))
        found = f"{float(max(abs(c_bar[n, m]), abs(s_bar[n, m]))):.3g}"
        raise DataFileError(file, f"degree {n}, order {m}", f"at most {GRAVITY_TERM / n**2:.3g}", found)
