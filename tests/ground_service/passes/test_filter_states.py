"""Filter estimates of both packet versions in the archive, and their consistency in the report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import select

from ground_service.evaluation.core import evaluate_pass
from ground_service.evaluation.inputs import filter_states, load_pass_inputs
from ground_service.ground import Ground
from ground_service.ingest.packets import batch_of_cut
from ground_service.ingest.redecode import catch_up
from ground_service.ingest.service import ingest_file
from ground_service.ingest.store import store_batch
from ground_service.passes.archive_import import import_archive
from ground_service.passes.span import pass_span
from ground_service.passes.store import get_pass
from ground_service.store import repository
from ground_service.store.vehicles import vehicle_id
from tests.ground_service.conftest import SPACECRAFT, define_pass_of, enter_files
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus
from tmtc.packets.stream import cut_packets

ERROR_RTN_M = np.array([30.0, -40.0, 10.0])
SIGMA_M = np.array([20.0, 50.0, 10.0])
CORRELATION = 0.6
# Radial and transverse errors of 1.5 and -0.8 sigma, correlated by 0.6: (2.25 + 0.64 + 1.44) / 0.64, normal 1.
NEES = (1.5**2 + 0.8**2 + 2.0 * CORRELATION * 1.5 * 0.8) / (1.0 - CORRELATION**2) + 1.0
DIAGONAL = 1.5**2 + 0.8**2 + 1.0


def anchored_packets(made: Any, version: int) -> list[bytes]:
    """States and estimates of an anchored filter on the orbit of the synthetic pass, erring by `ERROR_RTN_M`."""
    from lunar.frames import IauOrientation, rtn_from_inertial, spherical_from_mcmf
    from lunar.messages.oem import load_oem
    from lunar.timescales import tdb_s_from_utc_ns, ticks_from_utc_ns

    reference = load_oem(made.folder / "reference.oem")
    packets = []
    for k, utc_ns in enumerate(made.utc_ns.tolist()):
        state = np.concatenate([np.ravel(part) for part in reference.at(np.array([utc_ns]))])
        axes = rtn_from_inertial(state[:3], state[3:])
        position = state[:3] + axes.T @ ERROR_RTN_M
        rotation = IauOrientation().mcmf_from_icrf(float(tdb_s_from_utc_ns(utc_ns)))
        latitude, longitude, altitude = (float(x) for x in spherical_from_mcmf(rotation @ position))
        along = np.diag(SIGMA_M**2)
        along[0, 1] = along[1, 0] = CORRELATION * SIGMA_M[0] * SIGMA_M[1]
        covariance = np.diag([0.0] * 3 + [1e-4] * 3 + [1e-12] * 3)
        covariance[:3, :3] = axes.T @ along @ axes
        ticks = int(ticks_from_utc_ns(utc_ns))
        frame = {"frame_number": k, "image_ticks": ticks}
        triangle = np.tril_indices(9) if version == 2 else np.triu_indices(9)
        values = {
            **frame,
            "position_icrf_m": position,
            "velocity_icrf_m_s": state[3:],
            "acceleration_rtn_m_s2": np.zeros(3),
            "covariance": covariance[triangle],
        }
        name = "filter_state" if version == 2 else "filter_estimate"
        if version != 2:
            values["innovation_degrees"] = 24
        packets.append(DICTIONARY.pack(name, values, ticks=ticks + 5, sequence_count=1_000 + 2 * k))
        state_values = {
            **frame, "estimator": 2, "outcome": "fixed", "latitude_deg": np.degrees(latitude),
            "longitude_deg": np.degrees(longitude) % 360.0, "altitude_m": altitude,
            "velocity_icrf_m_s": state[3:], "sigma_rtn_m": SIGMA_M, "nis": 12.0, "matched": 12,
        }  # fmt: skip
        packets.append(
            DICTIONARY.pack("navigation_state", state_values, ticks=ticks + 6, sequence_count=1_001 + 2 * k)
        )
    return packets


@pytest.fixture(params=[2, 3])
def flown(request: Any, tmp_path: Path, make_pass: Any) -> tuple[Path, Any, int]:
    made = make_pass(frames=8, seed=3)
    path = tmp_path / "anchored.cadu"
    path.write_bytes(encode_cadus(anchored_packets(made, request.param), spacecraft_id=SPACECRAFT))
    return path, made, request.param


def archive_with(made: Any, packets: list[bytes]) -> Path:
    """The archive of the synthetic pass with further packets in its downlink."""
    folder: Path = made.folder
    octets = encode_cadus([*made.packets, *packets], spacecraft_id=SPACECRAFT)
    (folder / "downlink.cadu").write_bytes(octets)
    enter_files(folder)
    return folder


def states_of(ground: Ground, pass_id: int) -> Any:
    with ground.database.reading() as connection:
        return filter_states(connection, pass_span(connection, get_pass(connection, pass_id)))


def test_estimates_of_either_version_are_stored_with_covariance_and_degrees(
    flown: tuple[Path, Any, int], ground: Ground
) -> None:
    path, made, version = flown
    ingest_file(ground, path)
    found = states_of(ground, define_pass_of(ground, made))
    assert len(found) == 8
    # The axes are those of the estimate, 40 m in 1,767 km (2e-5 rad) from those of the orbit.
    np.testing.assert_allclose(found.sigma_rtn_m, np.broadcast_to(SIGMA_M, (8, 3)), rtol=1e-4)
    block = found.position_covariance_rtn_m2
    np.testing.assert_allclose(block[:, 0, 1], CORRELATION * 20.0 * 50.0, rtol=2e-4)
    assert found.innovation_degrees.tolist() == [-1 if version == 2 else 24] * 8
    with ground.database.reading() as connection:
        table = repository.SAMPLES["filter_states"]
        assert set(connection.execute(select(table.c.dictionary_version)).scalars()) == {DICTIONARY.version}


def test_what_version_2_decoded_is_decoded_again_to_the_same_states(ground: Ground, make_pass: Any) -> None:
    made = make_pass(frames=8, seed=3)
    octets = b"".join(anchored_packets(made, 2))
    with ground.database.writing() as connection:
        vehicle = vehicle_id(connection, SPACECRAFT, "flight")
        batch = batch_of_cut(octets, cut_packets(octets), replace(DICTIONARY, version=2), SPACECRAFT)
        store_batch(connection, vehicle, batch)
        repository.change(connection, repository.VEHICLES, vehicle, decoded_version=2)
    pass_id = define_pass_of(ground, made)
    before = states_of(ground, pass_id)
    assert catch_up(ground, vehicle) > 0
    after = states_of(ground, pass_id)
    assert len(before) == len(after) == 8
    np.testing.assert_array_equal(before.state, after.state)
    np.testing.assert_array_equal(before.covariance, after.covariance)
    with ground.database.reading() as connection:
        table = repository.SAMPLES["filter_states"]
        versions = set(connection.execute(select(table.c.dictionary_version)).scalars())
    assert versions == {2, DICTIONARY.version}


def test_the_report_weighs_errors_with_the_whole_covariance(
    flown: tuple[Path, Any, int], ground: Ground
) -> None:
    _, made, version = flown
    folder = archive_with(made, anchored_packets(made, version))
    report = evaluate_pass(load_pass_inputs(ground, import_archive(ground, folder)))
    series = next(one for one in report.navigation if one.name == "anchored")
    # A hundredth of the error: the reference is interpolated, and places are reported on the sphere.
    np.testing.assert_allclose(series.nees, NEES, rtol=0.01)
    assert series.squared_normalised_errors is None
    assert pytest.approx(DIAGONAL, rel=0.3) != NEES
    assert series.nis_dof is not None and series.nis_dof.tolist() == [24] * 8


def test_sigmas_alone_give_a_sum_of_another_name(ground: Ground, make_pass: Any) -> None:
    made = make_pass(frames=8, seed=3)
    octets = b"".join(anchored_packets(made, 3))
    states = [
        packet
        for packet in cut_packets(octets).packets(octets)
        if DICTIONARY.unpack(packet)[0] == "navigation_state"
    ]
    folder = archive_with(made, states)
    report = evaluate_pass(load_pass_inputs(ground, import_archive(ground, folder)))
    series = next(one for one in report.navigation if one.name == "anchored")
    assert series.nees is None
    np.testing.assert_allclose(series.squared_normalised_errors, DIAGONAL, rtol=0.01)
    # Two pixel coordinates for each of twelve craters.
    assert series.nis_dof is not None and series.nis_dof.tolist() == [24] * 8
