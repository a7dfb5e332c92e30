"""CCSDS AEM and OEM in XML; ephemerides of Horizons, in compressed files, and as CSV and TUM text."""

import csv
import gzip
import io
import zipfile
from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from lxml import etree
from numpy import cos, sin
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pytest import mark, raises
from scipy.spatial.transform import Rotation

from lunar.constants import NS
from lunar.datafolder import read_expanded
from lunar.ephemeris import Covariance, Ephemeris, EphemerisSegment, ephemeris_from_states
from lunar.errors import DataFileError, EphemerisError, TimeFormatError, UnknownFrameError
from lunar.frames import IauOrientation, continuous_quaternions, matrix_from_quaternion, rtn_from_inertial
from lunar.messages.aem import AttitudeSegment, format_aem, parse_aem
from lunar.messages.ephemeris_files import load_ephemeris
from lunar.messages.oem import format_oem
from lunar.messages.oem_xml import format_oem_xml, parse_oem_xml
from lunar.messages.stk import format_csv, format_tum
from lunar.timescales import from_tai_ns, parse_tai, parse_utc, utc_ns_from_tai_ns

START = parse_utc("2029-08-07T00:00:00")


def rows_of(table):
    """Rows of a table of texts with columns between bars."""
    return [row.split(" | ") for row in table.strip().splitlines()]


def ephemeris():
    rng = default_rng(1)
    matrix = rng.normal(size=(6, 6))
    covariances = [Covariance(START + k * 60 * NS, "RTN", (k + 1) * matrix @ matrix.T) for k in (0, 1)]

    def segment(first, shift_ns=0, **fields):
        position, velocity = rng.normal(size=(5, 3)) * 1e6, rng.normal(size=(5, 3)) * 1e3
        return EphemerisSegment(START + np.arange(first, first + 5) * 60 * NS + shift_ns, position, velocity, **fields)

    first = segment(0, comments=("before the burn & after <start>",), covariances=tuple(covariances))
    second = segment(
        4, 123_456_789, time_system="TDB", interpolation="LAGRANGE", degree=5,
        useable_start_utc_ns=START + 300 * NS,
    )  # fmt: skip
    return Ephemeris((first, second), "TEST", ("two arcs",))


def assert_same(found, expected):
    assert (found.originator, found.comments) == (expected.originator, expected.comments)
    assert len(found.segments) == len(expected.segments)
    for one, other in zip(found.segments, expected.segments, strict=True):
        assert np.abs(one.utc_ns - other.utc_ns).max() <= 1
        assert_allclose(one.position_m, other.position_m, rtol=0, atol=1e-6)
        assert_allclose(one.velocity_m_s, other.velocity_m_s, rtol=0, atol=1e-9)
        for name in [
            "centre",
            "frame",
            "object_name",
            "object_id",
            "time_system",
            "interpolation",
            "degree",
            "comments",
        ]:
            assert getattr(one, name) == getattr(other, name), name
        for mine, theirs in zip(one.covariances, other.covariances, strict=True):
            assert (mine.utc_ns, mine.frame) == (theirs.utc_ns, theirs.frame)
            assert_allclose(mine.matrix, theirs.matrix, rtol=1e-12)


# OEM in XML


def test_oem_in_xml_is_read_as_it_was_written():
    assert_same(parse_oem_xml(format_oem_xml(ephemeris()).encode()), ephemeris())


@mark.filterwarnings("ignore:ERFA function")
def test_another_reader_gives_the_same_states_from_xml(tmp_path):
    import oem as independent

    path = tmp_path / "orbit.xml"
    expected = ephemeris()
    path.write_text(format_oem_xml(Ephemeris(expected.segments[:1])))
    segment = next(iter(independent.OrbitEphemerisMessage.open(path)))
    assert_allclose([one.position for one in segment.states], expected.segments[0].position_m / 1e3)
    assert_allclose([one.velocity for one in segment.states], expected.segments[0].velocity_m_s / 1e3)
    covariances = list(segment.covariances)
    assert len(covariances) == 2
    assert_allclose(covariances[1].matrix, expected.segments[0].covariances[1].matrix / 1e6)


@mark.filterwarnings("ignore:ERFA function")
def test_oem_of_another_writer_in_xml_is_read(tmp_path):
    import oem as independent

    source, path = tmp_path / "orbit.oem", tmp_path / "orbit.xml"
    expected = Ephemeris(ephemeris().segments[:1])
    source.write_text(format_oem(expected))
    independent.OrbitEphemerisMessage.convert(source, path, "xml")
    found = load_ephemeris(path)
    assert_allclose(found.segments[0].position_m, expected.segments[0].position_m, atol=1e-3)
    assert_array_equal(found.segments[0].utc_ns, expected.segments[0].utc_ns)


def test_a_wrapped_message_with_a_name_space_is_read():
    plain = format_oem_xml(ephemeris()).partition("\n")[2]
    wrapped = f'<ndm:ndm xmlns:ndm="urn:ccsds:schema:ndmxml">{plain}</ndm:ndm>'
    assert_same(parse_oem_xml(wrapped.encode()), ephemeris())


def test_elements_are_in_the_order_of_the_standard():
    tree = etree.fromstring(format_oem_xml(ephemeris()).encode())
    assert (tree.tag, tree.get("id"), tree.get("version")) == ("oem", "CCSDS_OEM_VERS", "2.0")
    for path, tags in (
        (".", "header body"), ("body/segment", "metadata data"),
        ("body/segment/data/stateVector", "EPOCH X Y Z X_DOT Y_DOT Z_DOT"),
        ("body/segment/metadata", "OBJECT_NAME OBJECT_ID CENTER_NAME REF_FRAME TIME_SYSTEM START_TIME STOP_TIME "
         "INTERPOLATION INTERPOLATION_DEGREE"),
        ("body/segment/data/covarianceMatrix", "EPOCH COV_REF_FRAME CX_X CY_X CY_Y CZ_X"),
    ):  # fmt: skip
        found = " ".join(one.tag for one in tree.find(path) if one.tag != "COMMENT")
        assert found.startswith(tags) if "CX_X" in tags else found == tags


LAUGHS = """<?xml version="1.0"?>
<!DOCTYPE oem [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>
<oem id="CCSDS_OEM_VERS" version="2.0"><header><ORIGINATOR>&b;</ORIGINATOR></header></oem>"""


XML_FAULTS = r"""
units="km" | units="m" | line \d+: expected units='km' of X, found 'm'
<ORIGINATOR>TEST</ORIGINATOR> |  | expected ORIGINATOR in the header
version="2.0" | version="9" | line 2: expected an OEM version .*found '9'
Z_DOT | Z_TOD | expected <Z_DOT> with one value
"""


def test_faults_of_xml_are_named_with_their_line():
    whole = format_oem_xml(ephemeris())
    for text, message in (
        *((whole.replace(old, new), message) for old, new, message in rows_of(XML_FAULTS)),
        (LAUGHS, r"line 2: expected XML without a document type, found <!DOCTYPE oem>"),
        (whole[:700], r"line \d+: expected well-formed XML, found"), ("<a>" * 20 + "</a>" * 20, "expected"),
        ('<?xml version="1.0" encoding="foo"?><oem/>', "expected XML in UTF-8"),
        ('<?xml version="1.0" encoding="big5"?><oem/>', "expected XML in UTF-8"),
    ):  # fmt: skip
        assert text != whole
        with raises(DataFileError, match=message):
            parse_oem_xml(text.encode(), "orbit.xml")


def test_an_error_in_a_state_names_the_line_of_the_xml():
    lines = format_oem_xml(ephemeris()).splitlines()
    where = next(k for k, line in enumerate(lines) if line.startswith("<stateVector>"))
    lines[where + 1] = lines[where + 1].replace("T00:01", "T00:61")
    with raises(DataFileError, match=f"line {where + 2}: expected an epoch"):
        parse_oem_xml("\n".join(lines).encode())


# Compressed files


def zipped(*contents):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for number, content in enumerate(contents):
            archive.writestr(f"{number}.oem", content)
    return buffer.getvalue()


@mark.parametrize("compress", [gzip.compress, zipped])
def test_compressed_oem_is_read(tmp_path, compress):
    path = tmp_path / "orbit"
    for text in (format_oem(ephemeris()), format_oem_xml(ephemeris())):
        path.write_bytes(compress(text.encode()))
        assert_allclose(load_ephemeris(path).segments[0].position_m, ephemeris().segments[0].position_m, atol=1e-6)


def test_two_gzip_members_are_one_file(tmp_path):
    path = tmp_path / "two"
    path.write_bytes(gzip.compress(b"one ") + gzip.compress(b"two"))
    assert read_expanded(path, "text") == b"one two"


@mark.parametrize(
    "octets, message",
    [
        (gzip.compress(bytes(5 << 20)), "expected at most 1 MiB when expanded, found more"),
        (gzip.compress(bytes(900_000)) * 2, "expected at most 1 MiB when expanded, found more"),
        (zipped(bytes(5 << 20)), "expected at most 1 MiB when expanded, found more"),
        (gzip.compress(bytes(1000))[:-12], "expected a complete gzip file, found one that is cut short"),
        (b"\x1f\x8bnonsense", "expected a gzip file, found damaged data"),
        (zipped(b"a", b"b"), "expected a zip archive of one file, found 2 files"),
        (zipped(b"hello")[:-30], "expected a zip archive, found damaged data"),
    ],
    # The octets contain the time, and would differ between the processes of a parallel run.
    ids=["large gzip", "two large members", "large zip", "cut gzip", "no gzip", "two files", "cut zip"],
)
def test_faults_of_compressed_files_are_named(tmp_path, octets, message):
    path = tmp_path / "orbit.gz"
    path.write_bytes(octets)
    with raises(DataFileError, match=rf"orbit\.gz: {message}"):
        read_expanded(path, "an ephemeris", 1 << 20)


def test_many_gzip_members_take_linear_time(tmp_path):
    path = tmp_path / "many.gz"
    path.write_bytes(gzip.compress(b"") * 200_000)  # 4 MB; minutes if each member copies the rest
    assert read_expanded(path, "text") == b""


@mark.parametrize("year", ["9999", "1500"])
def test_years_outside_64_bits_of_nanoseconds_are_refused(year):
    with raises(TimeFormatError):
        parse_utc(f"{year}-01-01T00:00:00Z")


# AEM


def attitudes(count=6):
    q = default_rng(4).normal(size=(count, 4))
    return AttitudeSegment(
        START + np.arange(count) * 15 * NS,
        continuous_quaternions(q / np.linalg.norm(q, axis=1, keepdims=True)),
        comments=("star tracker",),
    )


def standard_matrix(q1, q2, q3, qc):
    """The direction cosine matrix from frame A to frame B of the annex of CCSDS 504.0-B."""
    vector, cross = np.array([q1, q2, q3]), np.array([[0, -q3, q2], [q3, 0, -q1], [-q2, q1, 0]])
    return (qc**2 - vector @ vector) * np.eye(3) + 2 * (np.outer(vector, vector) - qc * cross)


def test_quaternions_of_an_aem_are_those_of_the_standard():
    rows = format_aem((attitudes(),)).partition("DATA_START\n")[2].partition("\nDATA_STOP")[0].splitlines()
    for row, q_wxyz in zip(rows, attitudes().q_wxyz, strict=True):
        numbers = [float(token) for token in row.split()[1:]]
        assert_allclose(standard_matrix(*numbers), matrix_from_quaternion(q_wxyz), atol=1e-11)


@given(count=st.integers(1, 20), second=st.integers(0, 10**9))
def test_an_aem_is_read_as_it_was_written(count, second):
    one = attitudes(count)
    one = AttitudeSegment(one.utc_ns + second, one.q_wxyz, object_name="A", object_id="2029-001A")
    (found,) = parse_aem(format_aem((one,)))
    assert_array_equal(found.utc_ns, one.utc_ns)
    assert_allclose(found.q_wxyz, one.q_wxyz, atol=1e-11)
    assert (found.frame_a, found.frame_b, found.object_id) == ("ICRF", "INSTRUMENT_1", "2029-001A")


def test_order_and_direction_of_quaternions_are_as_stated():
    text = format_aem((attitudes(),), "1.0")
    lines = []
    for line in text.splitlines():
        fields = line.split()
        if len(fields) == 5 and fields[0][0].isdigit():
            epoch, a, b, c, w = fields
            line = f"{epoch} {w} {-float(a)} {-float(b)} {-float(c)}"
        lines.append(line.replace("LAST", "FIRST").replace("A2B", "B2A"))
    (found,) = parse_aem("\n".join(lines))
    assert_allclose(found.q_wxyz, attitudes().q_wxyz, atol=1e-11)


def test_an_aem_is_written_as_version_2_or_in_the_old_form_with_continuous_signs():
    angle = np.linspace(0.0, 2.0 * np.pi, 6)
    q_wxyz = np.stack([cos(angle), sin(angle), 0 * angle, 0 * angle], axis=1)
    flipped = AttitudeSegment(attitudes().utc_ns, q_wxyz * np.array([1, -1, -1, 1, -1, 1])[:, None])
    texts = {version: format_aem((flipped,), version) for version in ("1.0", "2.0")}
    assert format_aem((flipped,)) == texts["2.0"]
    assert "CCSDS_AEM_VERS = 2.0\n" in texts["2.0"] and "CCSDS_AEM_VERS = 1.0\n" in texts["1.0"]
    for keyword in ("ATTITUDE_DIR", "QUATERNION_TYPE"):
        assert keyword in texts["1.0"] and keyword not in texts["2.0"]
    for text in texts.values():
        assert_allclose(parse_aem(text)[0].q_wxyz, q_wxyz, atol=1e-11)


AEM_XML = """<?xml version="1.0" encoding="UTF-8"?>
<aem id="CCSDS_AEM_VERS" version="2.0"><header><CREATION_DATE>2029-08-07T00:00:00</CREATION_DATE>
<ORIGINATOR>TEST</ORIGINATOR></header><body><segment><metadata><OBJECT_NAME>A</OBJECT_NAME><OBJECT_ID>B</OBJECT_ID>
<REF_FRAME_A>ICRF</REF_FRAME_A><REF_FRAME_B>INSTRUMENT_1</REF_FRAME_B><TIME_SYSTEM>UTC</TIME_SYSTEM>
<START_TIME>2029-08-07T00:00:00</START_TIME><STOP_TIME>2029-08-07T00:00:15</STOP_TIME>
<ATTITUDE_TYPE>QUATERNION</ATTITUDE_TYPE><QUATERNION_TYPE>FIRST</QUATERNION_TYPE></metadata><data><attitudeState>
<quaternionEphemeris><EPOCH>2029-08-07T00:00:00</EPOCH>
<quaternion><QC>0.6</QC><Q1>0.0</Q1><Q2>0.8</Q2><Q3>0.0</Q3></quaternion></quaternionEphemeris></attitudeState>
<attitudeState><quaternionState><EPOCH>2029-08-07T00:00:15</EPOCH>
<quaternion><Q1>0.0</Q1><Q2>0.0</Q2><Q3>1.0</Q3><QC>0.0</QC></quaternion></quaternionState></attitudeState>
</data></segment></body></aem>"""


def test_an_aem_in_xml_is_read_by_its_elements_and_a_missing_scalar_is_named_with_its_line():
    (segment,) = parse_aem(AEM_XML)
    assert_array_equal(segment.utc_ns, START + np.array([0, 15]) * NS)
    assert_allclose(segment.q_wxyz, [[0.6, 0, -0.8, 0], [0, 0, 0, -1.0]], atol=1e-15)
    with raises(DataFileError, match=r"line 8: expected <QC> with one value, found 'none'"):
        parse_aem(AEM_XML.replace("<QC>0.6</QC>", ""))


AEM_FAULTS = """
CCSDS_AEM_VERS = 2.0 | CCSDS_OEM_VERS = 2.0 | line 1: expected CCSDS_AEM_VERS
CCSDS_AEM_VERS = 2.0 | CCSDS_AEM_VERS = 7.0 | expected an AEM version out of 1.0, 2.0, found '7.0'
ATTITUDE_TYPE = QUATERNION | ATTITUDE_TYPE = EULER_ANGLE | expected ATTITUDE_TYPE = QUATERNION
DATA_STOP |  | expected more lines, found the end of the file
REF_FRAME_B = INSTRUMENT_1¶ |  | expected REF_FRAME_B before META_STOP, found none
T00:00:15.000  | T00:00:15.000 7  | line 20: expected an epoch and a quaternion of 4 numbers
T00:00:30.000  | T00:00:15.000  | line 21: expected an epoch after 2029-08-07T00:00:15
T00:00:15.000  | T00:00:15.000 9 | line 20: expected a quaternion of unit length
"""


@mark.parametrize("old, new, message", rows_of(AEM_FAULTS))
def test_faults_of_an_aem_are_named_with_their_line(old, new, message):
    text, old = format_aem((attitudes(),)), old.replace("¶", "\n")
    assert old in text
    with raises(DataFileError, match=message):
        parse_aem(text.replace(old, new))


def test_an_empty_attitude_segment_is_refused():
    with raises(EphemerisError, match="expected at least one attitude, found none"):
        AttitudeSegment(np.zeros(0, dtype=np.int64), np.zeros((0, 4)))


# Horizons

HORIZONS = """*******************************************************************************
 Revised: Jan 26, 2022             Lunar Reconnaissance Orbiter              -85
*******************************************************************************
Target body name: LRO (spacecraft) (-85)          {source: LRO_merged}
Center body name: Moon (301)                      {source: DE441}
Center-site name: BODY CENTER
*******************************************************************************
Output units    : KM-S
Output type     : GEOMETRIC cartesian states
Reference frame : ICRF
*******************************************************************************
            JDTDB,            Calendar Date (TDB),      X,      Y,      Z,     VX,     VY,     VZ,
*******************************************************************************
$$SOE
2462355.500000000, A.D. 2029-Aug-07 00:00:00.0000,  1.768000000000000E+03, 0.0E+00,-1.5E+01, 1.0E-01, 1.6E+00, 2.0E-01,
2462355.500694444, A.D. 2029-Aug-07 00:01:00.0000,  1.765000000000000E+03, 9.0E+01,-1.6E+01, 1.1E-01, 1.5E+00, 2.1E-01,
$$EOE
*******************************************************************************
"""


def test_a_horizons_table_is_read(tmp_path):
    path = tmp_path / "lro.csv"
    path.write_text(HORIZONS)
    segment = load_ephemeris(path).segments[0]
    assert segment.object_name == "LRO"
    # TDB is 69.184 s ahead of UTC, but for the 1.7 ms of its periodic part.
    assert np.abs(from_tai_ns(segment.tai_ns, "TDB") - (START + np.array([0, 60]) * NS)).max() <= 1
    assert_allclose(segment.position_m[0], [1.768e6, 0.0, -15e3])
    assert_allclose(segment.velocity_m_s[1], [110.0, 1500.0, 210.0])


HORIZONS_FAULTS = r"""
Moon (301)  | Earth (399)  | Center body name: expected Moon \(301\), found Earth \(399\)
KM-S | AU-D | line 8: expected Output units of KM-S, M-S, KM-D, found 'AU-D'
: ICRF | : Ecliptic of J2000.0 | line 10: expected a reference frame out of ICRF
$$EOE |  | expected a table between \$\$SOE and \$\$EOE, found 1 of the marks
00:01:00 | 00:00:00 | line 16: expected an epoch after 2029-08-06T23:58:50
9.0E+01 | nan | line 16: expected finite numbers
9.0E+01 | ninety | line 16: expected a date like .* and six numbers
 VZ, |  LT, | columns: expected a column VZ, found none
Calendar Date (TDB) | Date | columns: expected columns with Calendar Date \(TDB\)
"""


@mark.parametrize("old, new, message", rows_of(HORIZONS_FAULTS))
def test_faults_of_a_horizons_table_are_named(tmp_path, old, new, message):
    path = tmp_path / "lro.csv"
    assert old in HORIZONS
    path.write_text(HORIZONS.replace(old, new))
    with raises(UnknownFrameError if "frame" in message else DataFileError, match=message):
        load_ephemeris(path)


def test_a_horizons_table_with_steps_of_a_second_across_a_leap_second_is_read(tmp_path):
    head, _, _ = HORIZONS.partition("$$SOE\n")
    row = "2457754.5, A.D. 2017-Jan-01 00:01:{:02d}.0000, 1.8E+03, 0.0E+00, {}E+00, 0.0E+00, 0.0E+00, 1.6E+00,"
    path = tmp_path / "leap.csv"
    path.write_text(head + "\n".join(["$$SOE", *(row.format(5 + k, k) for k in range(6)), "$$EOE"]))
    segment = load_ephemeris(path).segments[0]
    # TDB is 68.184 s ahead of UTC before and 69.184 s after the leap second.
    assert np.abs(np.diff(segment.tai_ns) - NS).max() <= 1
    assert abs(segment.tai_ns[4] - parse_tai("2016-12-31T23:59:60.816")) < 2_000_000


def test_an_attitude_within_a_leap_second_is_refused_with_that_reason():
    for system, clock in (("UTC", "2016-12-31T23:59:60.000"), ("TT", "2017-01-01T00:01:08.184")):
        text = format_aem((attitudes(1),)).replace("TIME_SYSTEM = UTC", f"TIME_SYSTEM = {system}")
        with raises(DataFileError, match=f"epoch outside of a leap second, .* found '{clock}' {system}"):
            parse_aem(text.replace("2029-08-07T00:00:00.000 ", f"{clock} "))


def test_an_spk_is_referred_to_the_converter(tmp_path):
    path = tmp_path / "orbit.bsp"
    path.write_bytes(b"DAF/SPK " + bytes(100))
    with raises(DataFileError, match="found a SPICE kernel; convert it with 'linna orbit convert'"):
        load_ephemeris(path)


ANGLE = np.arange(20)[:, None] * 0.3
POSITION_M = 1_768_180.0 * np.concatenate([cos(ANGLE), 0.6 * sin(ANGLE), 0.8 * sin(ANGLE)], 1)
VELOCITY_M_S = 1665.0 * np.concatenate([-sin(ANGLE), 0.6 * cos(ANGLE), 0.8 * cos(ANGLE)], 1)
EPHEMERIS = ephemeris_from_states(START + np.arange(20) * 300 * NS + 1, POSITION_M, VELOCITY_M_S)


def test_csv_holds_states_and_places_with_their_units():
    rows = list(csv.DictReader(io.StringIO(format_csv(EPHEMERIS, IauOrientation()))))
    assert len(rows) == 20
    assert rows[1]["utc"] == "2029-08-07T00:05:00.000000001Z"
    assert abs(float(rows[7]["y_km"]) * 1e3 - POSITION_M[7, 1]) < 1e-6
    assert all(0.0 <= float(row["longitude_deg"]) < 360.0 for row in rows)
    assert abs(float(rows[0]["altitude_km"]) - 30.78) < 1e-6


def test_tum_has_no_place_for_a_state_within_a_leap_second():
    (one,) = EPHEMERIS.segments
    moved = one.tai_ns - one.tai_ns[3] + parse_tai("2016-12-31T23:59:60.5")
    leap = replace(one, tai_ns=moved, utc_ns=utc_ns_from_tai_ns(moved))
    with raises(EphemerisError, match=r"outside of leap seconds, found 2016-12-31T23:59:60\.500Z"):
        format_tum(Ephemeris((leap,)))


def test_tum_holds_metres_and_the_attitude_of_the_rtn_axes_scalar_last():
    table = np.loadtxt(io.StringIO(format_tum(EPHEMERIS)))
    assert table.shape == (20, 8)
    assert table[3, 0] == START // NS + 900
    assert np.allclose(table[:, 1:4], POSITION_M, atol=1e-6, rtol=0)
    # SciPy keeps quaternions scalar last too; its matrix takes body axes to the world.
    theirs = Rotation.from_quat(table[:, 4:]).as_matrix()
    assert np.allclose(theirs, np.swapaxes(rtn_from_inertial(POSITION_M, VELOCITY_M_S), 1, 2), atol=1e-10)
