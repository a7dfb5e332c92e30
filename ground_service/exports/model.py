"""Entities and formats of exports."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, WithJsonSchema

from ground_service.http.model import Entity, RequestModel


@dataclass(frozen=True, slots=True)
class Format:
    """Format of an export.

    Attributes
    ----------
    ending
        Ending of the file; `zip` for formats of several files.
    library, extra
        Optional library that writes it, and the extra that installs it; empty if none is needed.
    states
        The format contains the states of the reference or of one estimator, as the request chooses.
    """

    name: str
    ending: str
    description: str
    library: str = ""
    extra: str = ""
    states: bool = False

    @property
    def several_files(self) -> bool:
        """Return whether an export has several files."""
        return self.ending == "zip"


_ALL = (
    Format("oem", "oem", "CCSDS OEM 2.0 (text) of the reference or of the navigation filter", states=True),
    Format("oem-xml", "xml", "CCSDS OEM 2.0 in XML", states=True),
    Format("aem", "aem", "CCSDS AEM 2.0 (or 1.0): attitude of the camera in each frame"),
    Format("spk", "bsp", "SPICE SPK: orbit", "spiceypy", "spice", states=True),
    Format("ck", "bc", "SPICE CK: attitude of the camera", "spiceypy", "spice"),
    Format(
        "spice",
        "zip",
        "SPICE kernels of all kinds, leap seconds, the Moon and a meta-kernel",
        "spiceypy",
        "spice",
        states=True,
    ),
    Format("sclk", "tsc", "SPICE SCLK: on-board clock with the time correlations"),
    Format("fk", "tf", "SPICE FK: names and camera frame"),
    Format("ik", "ti", "SPICE IK: field of view of the camera"),
    Format("geojson", "geojson", "tracks, footprints, detections, landmarks and craters as GeoJSON", states=True),
    Format("gpkg", "gpkg", "the same as GeoPackage, a layer each, for QGIS and GDAL", "pyogrio", "geo", states=True),
    Format("czml", "czml", "tracks, attitude, footprints and points over time for Cesium", states=True),
    Format("parquet", "zip", "decoded packets: one Parquet file for each packet type", "pyarrow", "parquet"),
    Format("netcdf", "nc", "all tables as groups of one netCDF-4 file", "xarray", "netcdf"),
    Format("csv", "zip", "all tables as CSV files of samples, with units in csv-metadata.json"),
    Format("tum", "zip", "navigation solutions and reference as TUM trajectories"),
    Format("images", "zip", "archived images of the pass as PNG files"),
)

FORMATS = {one.name: one for one in _ALL}
"""Formats by name."""

REFERENCE = "reference"
"""Name of the states of the reference ephemeris in requests."""


def _known(name: str) -> str:
    if name not in FORMATS:
        raise ValueError(f"expected one of {', '.join(FORMATS)}, found {name!r}")
    return name


FormatName = Annotated[str, AfterValidator(_known), WithJsonSchema({"type": "string", "enum": list(FORMATS)})]


class ExportRequest(RequestModel):
    """A pass, and the format of its export."""

    pass_id: int = Field(ge=1, le=2**31 - 1, examples=[1])
    format: FormatName = Field(examples=["geojson"])
    states: str = Field(
        default="reference",
        min_length=1,
        max_length=40,
        examples=["reference"],
        description="States of orbits and maps: `reference`, or the name of an estimator",
    )
    version: Literal["1.0", "2.0"] = Field(default="2.0", description="Version of a CCSDS AEM")


class ExportFormatInfo(Entity):
    """A format of exports."""

    name: str = Field(examples=["geojson"])
    description: str
    ending: str = Field(examples=["geojson"], description="Ending of the file; zip: several files")
    states: bool = Field(description="The request chooses the states")
    extra: str = Field(description="Extra of the installation that the format needs; empty: none", examples=["geo"])
    available: bool = Field(description="The library of the extra is installed")
