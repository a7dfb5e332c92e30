"""The public data products this project can use: where they lie, how large they are, what is known of their integrity.

What is not known is left empty and said to be unknown; nothing here is guessed.  Addresses, sizes and checksums were
gathered in November 2026 without opening the archives: each says where it comes from.
"""

import fnmatch
from dataclasses import dataclass
from typing import Literal

_NAIF = "https://naif.jpl.nasa.gov/pub/naif/generic_kernels"
_GEOSCIENCES = "https://pds-geosciences.wustl.edu"
_IMBRIUM = "https://imbrium.mit.edu/DATA/SLDEM2015/TILES/FLOAT_IMG"
_LROC = "https://pds.lroc.im-ldi.com/data/LRO-L-LROC-5-RDR-V1.0/LROLRC_2001/DATA"

_PDS4_LABEL = "MD5 of the PDS4 label, quoted by its users"
_BUNDLE = "MD5 of the archive's bundle_checksums.txt, quoted by its users"
_SHTOOLS = "SHA-256 kept by SHTOOLS (pyshtools.datasets)"
_OUR_COPY = "SHA-256 of the copy that this project was tested with"

Origin = Literal["published", "copy", "unknown"]


@dataclass(frozen=True, slots=True)
class ProductFile:
    """One file of a product.

    Attributes
    ----------
    path
        Where it lies in the data folder.
    url
        Official address; empty where none is known.
    octets
        Size of the file at that address; 0 unknown.
    md5, sha256
        Checksum of the file as it lies in the data folder, of whichever kind is known; empty unknown.
    origin, checksum_source
        "published": kept by the archive or by others who distribute it, a file that differs is refused. "copy": of the
        copy that this project was tested with, a file that differs is kept and said to differ.
    member
        The address gives a ZIP file, of which the member with this name is the product.
    """

    path: str
    url: str = ""
    octets: int = 0
    md5: str = ""
    sha256: str = ""
    origin: Origin = "unknown"
    checksum_source: str = ""
    member: str = ""


@dataclass(frozen=True, slots=True)
class Product:
    """A data product.

    Attributes
    ----------
    basic
        Small and used by everything: fetched where no product is named.
    patterns
        Files of this product that no address gives but that may lie in a data folder (cuts of originals).
    """

    name: str
    title: str
    licence: str
    citation: str
    files: tuple[ProductFile, ...] = ()
    basic: bool = False
    note: str = ""
    patterns: tuple[str, ...] = ()

    @property
    def octets(self) -> int:
        """Size of all files; 0 where one is unknown."""
        sizes = [file.octets for file in self.files]
        return sum(sizes) if all(sizes) else 0

    def claims(self, path: str) -> bool:
        """Return whether a path of the data folder belongs to the product."""
        return any(path == file.path for file in self.files) or any(
            fnmatch.fnmatch(path, pattern) for pattern in self.patterns
        )


_NASA = "works of NASA centres, free to use with credit (NAIF and PDS); no licence text"
_LROC_LICENCE = "NASA PDS archive, credit NASA/GSFC/Arizona State University; no licence text known"


def _copy(path: str, url: str, octets: int, sha256: str) -> ProductFile:
    return ProductFile(path, url, octets, sha256=sha256, origin="copy", checksum_source=_OUR_COPY)


def _sldem() -> tuple[ProductFile, ...]:
    """Six tiles of 60 x 120 deg: 15360 lines of 30720 samples of 4 octets, and their labels."""
    files = []
    for latitude in ("0N_60N", "60S_0S"):
        for longitude in ("000_120", "120_240", "240_360"):
            name = f"SLDEM2015_256_{latitude}_{longitude}_FLOAT"
            files.append(ProductFile(f"dem/{name}.LBL", f"{_IMBRIUM}/{name}.LBL"))
            files.append(ProductFile(f"dem/{name}.IMG", f"{_IMBRIUM}/{name}.IMG", 15_360 * 30_720 * 4))
    return tuple(files)


def _lroc(folder: str, stem: str, ending: str, octets: int, place: str) -> tuple[ProductFile, ...]:
    """Eight tiles of 60 x 90 deg between 60 deg south and north, labels attached."""
    known = {
        "WAC_EMP_643NM_E300N0450_064P": "37e0144f3fa52cf91f9cb0aa605d9200",
        "WAC_EMP_643NM_E300S0450_064P": "53eb43347e3a96bc8fdb17c1f3207546",
    }
    files = []
    for half in "NS":
        for longitude in ("0450", "1350", "2250", "3150"):
            name = f"{stem}_E300{half}{longitude}_{ending}"
            md5 = known.get(name, "")
            files.append(
                ProductFile(
                    f"{place}/{name}.IMG",
                    f"{_LROC}/{folder}/{name}.IMG",
                    octets,
                    md5=md5,
                    origin="published" if md5 else "unknown",
                    checksum_source=_PDS4_LABEL if md5 else "",
                )
            )
    return tuple(files)


PRODUCTS: tuple[Product, ...] = (
    Product(
        "orientation",
        "lunar orientation DE421 (principal axes) and its frame kernel",
        _NASA,
        "JPL, NAIF generic kernels",
        (
            _copy(
                "kernels/moon_pa_de421_1900-2050.bpc",
                f"{_NAIF}/pck/moon_pa_de421_1900-2050.bpc",
                1_770_496,
                "656f90616403d75a75f0cd6c8830fc5b44f8cb4facb5ccb8915e752b397520cf",
            ),
            _copy(
                "kernels/moon_080317.tf",
                f"{_NAIF}/fk/satellites/moon_080317.tf",
                21_437,
                "78732477b96f9863e7b0d65bcee3c22b8707ca5ed0db56d1173319cb2e8c7993",
            ),
        ),
        basic=True,
    ),
    Product(
        "constants",
        "rotation constants of the IAU and GMs, as text kernels (cross-checks with SPICE)",
        _NASA,
        "JPL, NAIF generic kernels",
        (
            _copy(
                "kernels/pck00010.tpc",
                f"{_NAIF}/pck/pck00010.tpc",
                126_143,
                "59468328349aa730d18bf1f8d7e86efe6e40b75dfb921908f99321b3a7a701d2",
            ),
            _copy(
                "kernels/gm_de431.tpc",
                f"{_NAIF}/pck/gm_de431.tpc",
                6_291,
                "15756c162151853f329d473fa00c38d35e62d83c3e25ddceece6516bbd98738b",
            ),
        ),
    ),
    Product(
        "grgm660prim",
        "GRAIL gravity GRGM660PRIM to degree 660, principal axes of DE421",
        "US public domain (data.gov entry of the data set)",
        "Lemoine et al. 2013, doi 10.1002/jgre.20118; NASA GSFC",
        (
            ProductFile(
                "gravity/gggrx_0660pm_sha.tab",
                f"{_GEOSCIENCES}/grail/grail-l-lgrs-5-rdr-v1/grail_1001/shadr/gggrx_0660pm_sha.tab",
            ),
        ),
        basic=True,
        patterns=("gravity/GRGM660PRIM*.gfc",),
    ),
    Product(
        "grgm1200a",
        "GRAIL gravity GRGM1200A to degree 1200, principal axes of DE430",
        "US public domain (data.gov entry of the data set)",
        "Goossens et al. 2016; NASA GSFC",
        (
            ProductFile(
                "gravity/gggrx_1200a_sha.tab",
                f"{_GEOSCIENCES}/grail/grail-l-lgrs-5-rdr-v1/grail_1001/shadr/gggrx_1200a_sha.tab",
            ),
        ),
        note="not needed for degree 100",
    ),
    Product(
        "lp165p",
        "Lunar Prospector gravity LP165P to degree 165: the filter's own, poorer field",
        _NASA,
        "Konopliv et al. 2001, doi 10.1006/icar.2000.6573; JPL",
        (
            ProductFile(
                "gravity/jgl165p1.sha",
                f"{_GEOSCIENCES}/lunar/lp-l-rss-5-gravity-v1/lp_1001/sha/jgl165p1.sha",
                sha256="b75a40be56f9b58bd00536a65c7773db3b6ed17de78fba26b945837fd0d049ee",
                origin="published",
                checksum_source=_SHTOOLS,
            ),
        ),
        basic=True,
        patterns=("gravity/LP165P.cof",),
    ),
    Product(
        "robbins2018",
        "crater catalogue of Robbins, 1,296,796 craters from 1 km up, whole Moon",
        "work of the US Government (USGS); no restriction on the page",
        "Robbins 2019, doi 10.1029/2018JE005592; USGS Astrogeology",
        (
            ProductFile(
                "craters/lunar_crater_database_robbins_2018.csv",
                "https://astrogeology.usgs.gov/ckan/dataset/f89f5478-b69a-486c-b9b5-30d7b0c5ad2b/resource/"
                "c4f25cc2-4f8a-4207-a845-5e176da3ac5a/download/lunar_crater_database_robbins_2018",
                96_227_201,
                md5="13f2f9df2e71d7049e966ee405c7f014",
                origin="published",
                checksum_source=_BUNDLE,
                member="lunar_crater_database_robbins_2018.csv",
            ),
        ),
        basic=True,
        note="the MD5 in the bundle's own PDS4 label is wrong; the address gives a ZIP file",
        patterns=("craters/lunar_craters_ge20km.csv",),
    ),
    Product(
        "lu1319381",
        "crater catalogue LU1319381 with depths, 1,319,381 craters from 1 km up",
        "unknown",
        "Wang, Wu et al. 2022, doi 10.1029/2022GL100886",
        note="address of the file unknown; put the CSV where the path says",
        patterns=("craters/lu1319381*.csv", "craters/lu1319381*.csv.gz", "craters/composite*.csv*"),
    ),
    Product(
        "sldem2015",
        "height model SLDEM2015 (LOLA and Kaguya), 256 px/deg, kilometres, 60 S to 60 N",
        _NASA,
        "Barker et al. 2016, doi 10.1016/j.icarus.2015.07.039",
        _sldem(),
        note="what the paper used; preferred to GLD100 where its labels lie in dem/",
    ),
    Product(
        "gld100",
        "height model LROC WAC GLD100, 256 px/deg, metres, 60 S to 60 N",
        _LROC_LICENCE,
        "Scholten et al. 2012, doi 10.1029/2011JE003926; DLR and Arizona State University",
        # 15360 lines of 23040 samples of 2 octets behind a label of one line.
        _lroc("SDP/WAC_GLD100", "WAC_GLD100", "256P", 15_361 * 23_040 * 2, "dem"),
        patterns=("dem/gld100_*ppd_*.jp2", "dem/gld100_*ppd_*.tif"),
    ),
    Product(
        "wac-mosaic",
        "reflectance, LROC WAC empirically normalised mosaic at 643 nm, 64 px/deg, 60 S to 60 N",
        _LROC_LICENCE,
        "Boyd et al. 2012; NASA, Arizona State University",
        _lroc("MDR/WAC_EMP", "WAC_EMP_643NM", "064P", 88_496_640, "albedo"),
        patterns=("albedo/moon_albedo*.jpg",),
    ),
)


def find_product(name: str) -> Product | None:
    return next((product for product in PRODUCTS if product.name == name), None)
