"""Downlink streams of ground stations: `tm check` and `ingest` find the same packets, all that can be found."""

from pytest import mark

from benchmarks.downlink import STREAMS, checked, ingested, noise_found, weak_everywhere, weak_start

SLOW = {"clean", "weak-100", "weak-220", "weak-400", "weak-middle", "noise-3000000"}
"""Streams of 2,000 frames or 3 MB: the weak start of 60 frames below and `noise-79000` test the same."""


@mark.parametrize("name", [name for name in STREAMS if name not in SLOW])
def test_every_packet_that_can_be_found_is_found_by_check_and_by_ingest(name):
    stream = STREAMS[name]()
    size = sum(len(octets) for octets in stream.files)
    found, stored = checked(stream), ingested(stream)
    assert (found.packets, found.false, found.octets) == (stream.true, 0, size)
    assert (stored.packets, stored.false, stored.octets) == (stream.true, 0, size)


@mark.parametrize("seed", range(6))
def test_check_and_ingest_agree_where_few_frames_can_be_repaired(seed):
    weak = weak_start(30, frames=60) if seed == 0 else weak_everywhere(6e-3 + 8e-4 * seed, seed)
    assert checked(weak).packets == ingested(weak).packets == weak.true


def test_no_noise_is_a_packet_or_a_good_frame():
    assert noise_found(20) == {"files": 20, "with_packets": 0, "with_good_frames": 0}
