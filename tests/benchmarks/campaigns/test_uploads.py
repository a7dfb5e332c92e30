"""Short campaign of simultaneous uploads: a real server with few upload slots, many clients, and a stop."""

from pathlib import Path

import pytest

from benchmarks.campaigns.uploads import campaign, verdict


@pytest.mark.campaign
def test_uploads_half_sent_requests_and_a_stop(tmp_path: Path) -> None:
    figures = campaign(
        tmp_path, uploads=16, half=8, sockets=6, postgres=False, packets=2, watched_s=0.5,
        LINNA_UPLOADS_AT_ONCE="4", LINNA_REQUEST_TIMEOUT_S="5", LINNA_SOCKETS_PER_USER="4",
    )  # fmt: skip
    assert figures["answers"]["accepted"] == 16
    assert figures["half_sent_ended_with"] == {"408": 8}
    assert figures["honest_uploads_accepted"] == figures["honest_uploads"]
    assert figures["health_errors"] == figures["health_half_sent_errors"] == {}
    assert figures["sockets_answered_with"] == {"101": 4, "429": 2}
    assert figures["reads_with_sockets_errors"] == {}
    assert (figures["stopped"], figures["files_left"]) == (True, 0)
    # Times depend on the machine that runs the tests; the campaign itself judges them.
    assert all("s, expected" in fault for fault in verdict(figures))


def test_the_verdict_names_what_went_wrong() -> None:
    good = {
        "uploads": 2, "answers": {"202": 2, "accepted": 2}, "honest_uploads": 1, "honest_uploads_accepted": 1,
        "health_errors": {}, "health_max_ms": 20.0, "peak_rss_mib": 300, "stopped": True, "stop_s": 5.1,
        "files_left": 0,
    }  # fmt: skip
    assert verdict(good) == []
    for change, words in (
        ({"answers": {"accepted": 1}}, "1 uploads were not accepted"),
        (
            {"answers": {"accepted": 2, "no answer: ConnectionResetError": 3}},
            "no answer: ConnectionResetError: 3",
        ),
        ({"honest_uploads_accepted": 0}, "held up by half-sent"),
        ({"health_errors": {"503": 1}}, "health: {'503': 1}"),
        ({"health_max_ms": 101.0}, "101.0 ms"),
        ({"peak_rss_mib": 1025}, "1025 MiB"),
        ({"stopped": False}, "did not stop"),
        ({"stop_s": 30.1}, "stopped after 30.1 s"),
        ({"files_left": 1}, "1 temporary files"),
    ):
        (fault,) = verdict({**good, **change})
        assert words in fault
