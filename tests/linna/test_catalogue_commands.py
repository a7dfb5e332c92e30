"""Commands about catalogues, identification and link settings; the names on which scripts rely."""

import hashlib
import math

import numpy as np
from pytest import approx, fixture, mark

from linna.cli import GROUPS, run
from linna.help import example
from linna.parser import command_parser
from lunar.catalogue import make_catalogue, save_catalogue
from payload_emulator.sim.terrain.registration import parse_registration
from tests.payload_emulator.sim.rasters import write_raster
from tests.tmtc.test_downlink import make_packets
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus
from tmtc.link.cadu import ASM
from tmtc.packets.space_packets import pack_packet

METRES_PER_DEG = math.radians(1.0) * 1_737_400.0


def landmarks_packet(latitude, identity=3_000_000_000):
    one = np.ones(len(latitude))
    items = {
        "landmark_id": identity + np.arange(len(latitude)), "latitude_deg": np.array(latitude),
        "longitude_deg": 300.0 * one, "height_m": 50.0 * one, "diameter_m": 6_000.0 * one,
        "sigma_east_m": 100.0 * one, "sigma_north_m": 100.0 * one, "sigma_up_m": 100.0 * one,
        "sightings": 3 * one.astype(int), "passes": one.astype(int),
    }  # fmt: skip
    values = {"frame_number": 1, "image_ticks": 5, "items": items}
    return DICTIONARY.pack("landmarks", values, ticks=0, sequence_count=0)


def test_a_downlinked_map_is_compared_with_a_catalogue(tmp_path, typed):
    path, downlink = tmp_path / "list.csv", tmp_path / "map.bin"
    listed = make_catalogue(np.radians([10.0]), np.radians([300.0]), [6_000.0], source="one", rim_height_m=[50.0])
    save_catalogue(listed, path)
    # 0.01 degrees are 303 m on the ground; the other landmark is far from any crater.
    downlink.write_bytes(landmarks_packet([10.01, 20.0]))
    figures = typed(f"catalogue landmarks {downlink} --catalogue {path} --json")
    assert (figures["landmarks"], figures["in_catalogue"], figures["new"]) == (2, 1, 1)
    assert figures["median_horizontal_m"] == approx(303.2, abs=1.0)


def test_a_downlink_without_a_map_has_none_and_says_so(tmp_path, typed):
    path, downlink = tmp_path / "list.csv", tmp_path / "other.bin"
    save_catalogue(make_catalogue([0.1], [0.2], [6_000.0], source="one"), path)
    time_report = {"reported_ticks": 1, "rate_exponent": 0}
    downlink.write_bytes(DICTIONARY.pack("time_report", time_report, ticks=0, sequence_count=0))
    figures = typed(f"catalogue landmarks {downlink} --catalogue {path} --json", 1)
    assert (figures["landmarks"], figures["median_horizontal_m"]) == (0, None)


def test_a_list_is_registered_to_terrain(tmp_path, typed):
    latitude, longitude = (part.ravel() for part in np.meshgrid(np.arange(1.5, 9, 1.5), np.arange(301.5, 309, 1.5)))

    def bowls(lat, lon):
        height = np.zeros(np.broadcast_shapes(lat.shape, lon.shape))
        for north, east in zip(latitude, longitude, strict=True):
            level = np.cos(np.radians(north))
            # Radius 5 km, rim 200 m, depth 1,000 m.
            r = np.hypot(lat - north, (lon - east) * level) * METRES_PER_DEG / 5_000.0
            height += np.where(r < 1.0, 1_000.0 * np.minimum(r, 1.0) ** 2 - 800.0, 200.0 * np.maximum(r, 1.0) ** -4.0)
        return height

    raster = write_raster(tmp_path / "bowls.tif", 300.0, 9.0, 9.0, bowls, ppd=128)
    listed = make_catalogue(
        np.radians(latitude - 50.0 / METRES_PER_DEG), np.radians(longitude), [10_000.0] * 25, source="one"
    )
    path, out = tmp_path / "list.csv", tmp_path / "made/registration.json"
    save_catalogue(listed, path)
    figures = typed(f"catalogue register {path} --terrain {raster} --out {out} --json")
    assert (figures["rims"], figures["out"]) == (25, str(out))
    made = parse_registration(out.read_text(), "made")
    shift, sigma = made.at(np.radians([5.0]), np.radians([305.0]))
    assert shift[0] == approx([0.0, 50.0], abs=8.0) and sigma[0] < 20.0
    assert made.terrain == {"bowls.tif": hashlib.sha256(raster.read_bytes()).hexdigest()}
    assert made.catalogue == hashlib.sha256(path.read_bytes()).hexdigest()


def test_an_empty_result_is_status_1_and_no_file(tmp_path):
    listed, empty, out = tmp_path / "one.csv", tmp_path / "none.csv", tmp_path / "out.csv"
    save_catalogue(make_catalogue(np.radians([2.0]), np.radians([302.0]), [10_000.0], source="one"), listed)
    save_catalogue(make_catalogue([], [], [], source="none"), empty)
    hills = write_raster(tmp_path / "h.tif", 300.0, 4.0, 4.0, lambda lat, lon: 50.0 * np.sin(9 * lat) * np.cos(9 * lon))
    assert run(["catalogue", "stats", str(empty)]) == 1
    assert run(["catalogue", "curate", str(listed), "--terrain", str(hills), "--out", str(out)]) == 1
    assert not out.exists()


@mark.parametrize(
    "arguments, expected",
    [
        ("register", "CATALOGUE: expected a crater list"),
        ("register none.csv", "--terrain: expected height rasters"),
        ("curate none.csv --out x --region 5", "--region"),
        ("curate none.csv --out x --min-diameter 40", "--min-diameter"),
    ],
)
def test_bad_input_is_one_line_that_names_it(arguments, expected, typed, monkeypatch):
    monkeypatch.delenv("LINNA_DATA", raising=False)
    assert expected in typed(f"catalogue {arguments}", 2)


@fixture
def recording(tmp_path):
    path = tmp_path / "station.cadu"
    path.write_bytes(encode_cadus(make_packets(120), spacecraft_id=76))
    return path


def test_settings_come_with_their_evidence(recording, typed):
    found = typed(f"link check {recording} --json")
    assert not found["ambiguous"]
    assert found["settings"]["frame_length"] == 1115 and found["settings"]["randomiser"] == "legacy"
    best = found["evidence"][0]
    assert best["codewords_clean"] == best["checksums_hold"] == best["headers_regular"] == 1.0
    assert best["packets"] > 100


@mark.parametrize("randomiser, status", [("legacy", 0), ("long", 1)])
def test_a_mission_description_is_compared(recording, typed, tmp_path, randomiser, status):
    mission = tmp_path / "mission.toml"
    mission.write_text(f'name = "test"\n[link]\nframe_length = 1115\nrandomiser = "{randomiser}"\n')
    found = typed(f"link check {recording} --mission {mission} --json", status)
    expected = ["randomiser: the mission states long, the recording has legacy"] if status else []
    assert found["contradicts_mission"] == expected


def test_frames_that_nothing_proves_are_inconclusive(typed, tmp_path):
    noise = np.random.default_rng(3).integers(0, 256, (30, 700), dtype=np.uint8)
    noise[:, :4] = np.frombuffer(ASM, dtype=np.uint8)
    path = tmp_path / "noise.cadu"
    path.write_bytes(noise.tobytes())
    found = typed(f"link check {path} --json", 3)
    assert found["settings"] is None and found["distances"]["700"] == 29


def test_packets_without_frames_are_reported_and_noise_is_refused(typed, tmp_path):
    path = tmp_path / "packets.bin"
    path.write_bytes(b"".join(make_packets(20)))
    assert typed(f"link check {path} --json")["packets_without_frames"] == 42
    path.write_bytes(np.random.default_rng(1).integers(0, 256, 5000, dtype=np.uint8).tobytes())
    assert "expected CADUs or space packets, found none in its 5000 octets" in typed(f"link check {path}", 2)


@mark.parametrize("prefix", [0, 3])
def test_the_form_of_packets_without_checksum_is_proposed(typed, tmp_path, prefix):
    packets = [bytes(prefix) + pack_packet(0x200, bytes(range(60)), sequence_count=k) for k in range(30)]
    path = tmp_path / "foreign.bin"
    path.write_bytes(b"".join(packets))
    shown = typed(f"link check {path}")
    assert "30 space packets without checksum" in shown and 'packet_checksum = "none"' in shown
    assert (f"packet_prefix_octets = {prefix}" in shown) == (prefix > 0)


RELIED_ON = """
demo --out D
orbit propagate S --days 1 --step 30 --out F.oem --gravity G --degree 8 --no-maneuvers
orbit compare A B
orbit interpolate F --epochs E
catalogue stats F
catalogue curate C --terrain T --out F
camera fov-study --ephemeris F --catalogue C
render S --epoch 2029-08-07T00:00:00Z --out F.png --renderer raymarch
dataset build S --out D --frames 5 --workers 2 --renderer fast
dataset check D
dataset stats D
detector train D --out R
detector export R --out M.onnx
detector evaluate --model M --dataset D --split test
detector evaluate --model M --coco D --altitude-km 30
detector detect I.png --altitude-km 30 --fov-deg 120
detector bench --threads 2
emulate S --out D --mode anchored
replay A --build B --out D
tm decode F --format parquet --out G
tm check F
tm icd
tm xtce --out F.xml
tm yamcs --out D
serve --host 127.0.0.1 --port 1
worker
db upgrade
user add NAME --role viewer
ingest --recording R F G
pass list
pass show 1
report 1 --out D
regress run --archive A --build B --baseline C --junit J
regress suite low --out D
data verify
mission write S --out M.toml
mission check M
mission run S --days 1 --speed max
verify --rebuild
navigation survey --region 0,10,0,10 --seeds 3
export 1 --format tum --out F
paper --out D
link check F --mission M
"""


@mark.parametrize("line", RELIED_ON.strip().splitlines())
def test_a_documented_command_is_understood(line):
    words = line.split()
    command_parser(GROUPS, words[0]).parse_args(words)


def test_the_example_of_a_telecommand_is_one_of_the_dictionary():
    assert example("linna command enter").split()[3] in {one.name for one in DICTIONARY.telecommands}
