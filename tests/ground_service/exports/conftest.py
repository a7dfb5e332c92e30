"""The synthetic pass with attitudes, images, identifications and states of the filter."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from pytest import MonkeyPatch, fixture

from ground_service.ground import open_ground
from ground_service.missions import frames as declared
from ground_service.passes.archive_import import import_archive
from lunar.camera import PinholeCamera, nadir_camera_from_mcmf
from lunar.catalogue import load_catalogue
from lunar.datafolder import DataFolder
from lunar.frames import IauOrientation, quaternion_from_matrix, rtn_from_inertial
from lunar.timescales import tdb_s_from_utc_ns, ticks_from_utc_ns
from tests.ground_service.conftest import (
    FILTER_ERROR_RTN_M,
    PIXEL_OFFSET,
    Downlink,
    circular_states,
    encode_downlink,
    write_manifest,
)
from tests.ground_service.evaluation.still import TurnedOrientation
from tmtc.dictionary.payload import DICTIONARY

FRAMES = 12
COVARIANCE = np.diag([100.0, 400.0, 900.0, 1e-4, 2e-4, 3e-4, 1e-12, 1e-12, 1e-12])


@dataclass(frozen=True)
class RichPass:
    """Archive of the pass, positions (n, 3) and attitudes of its frames, and the craters of its identifications.

    The inertial axes of the payload are turned against ICRF (n, 3, 3).
    """

    folder: Path
    utc_ns: np.ndarray
    onboard_from_icrf: np.ndarray
    position_mcmf_m: np.ndarray
    camera_from_icrf: np.ndarray
    craters: list[list[int]]


@fixture(scope="session")
def rich_pass(make_pass):
    made = make_pass(frames=FRAMES, filter_nis=2.0)
    folder = made.folder
    position, velocity = circular_states(made.utc_ns)
    tdb_s = np.asarray(tdb_s_from_utc_ns(made.utc_ns))
    mcmf_from_icrf = IauOrientation().mcmf_from_icrf(tdb_s)
    onboard_from_icrf = np.swapaxes(TurnedOrientation().mcmf_from_icrf(tdb_s), 1, 2) @ mcmf_from_icrf
    error = np.einsum("nji,j->ni", rtn_from_inertial(position, velocity), FILTER_ERROR_RTN_M)
    position_mcmf = np.einsum("nij,nj->ni", mcmf_from_icrf, position)
    camera_from_mcmf = nadir_camera_from_mcmf(position_mcmf)
    camera_from_icrf = camera_from_mcmf @ mcmf_from_icrf
    ticks = ticks_from_utc_ns(made.utc_ns)
    rows = [
        ",".join([str(tick), *(repr(value) for value in q)])
        for tick, q in zip(ticks.tolist(), quaternion_from_matrix(camera_from_icrf).tolist(), strict=True)
    ]
    (folder / "attitude.csv").write_text("\n".join(["image_ticks,q_w,q_x,q_y,q_z", *rows]) + "\n")
    (folder / "frames").mkdir()
    for k in range(0, FRAMES, 4):
        Image.fromarray(np.full((16, 16), 10 * k, np.uint8)).save(folder / "frames" / f"{k:06d}.png")
    catalogue = load_catalogue(folder / "catalogue.csv")
    sent, craters = Downlink(), []
    for k, tick in enumerate(ticks.tolist()):
        uv = _detections(made.packets, tick)
        projected = PinholeCamera().project((catalogue.position_mcmf_m - position_mcmf[k]) @ camera_from_mcmf[k].T)
        distance = np.linalg.norm(projected[None] + PIXEL_OFFSET - uv[:-1, None], axis=2)
        nearest = np.nanargmin(distance, axis=1)
        craters.append(catalogue.ids[nearest].tolist())
        items = {"detection": np.arange(len(nearest)), "crater_id": catalogue.ids[nearest]}
        sent.send("identifications", {"frame_number": k, "image_ticks": tick, "items": items}, tick + 600)
        sent.send(
            "filter_state",
            {
                "frame_number": k, "image_ticks": tick,
                "position_icrf_m": onboard_from_icrf[k] @ (position[k] + error[k]),
                "velocity_icrf_m_s": onboard_from_icrf[k] @ velocity[k], "acceleration_rtn_m_s2": np.zeros(3),
                "covariance": COVARIANCE[np.tril_indices(9)],
            },
            tick + 700,
        )  # fmt: skip
    (folder / "downlink.cadu").write_bytes(encode_downlink([*made.packets, *sent.packets]))
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["gravity"]["filter_orientation"] = TurnedOrientation().name
    write_manifest(folder, manifest)
    return RichPass(folder, made.utc_ns, onboard_from_icrf, position_mcmf, camera_from_icrf, craters)


def _detections(packets, tick):
    """Pixels (n, 2) of the detections of the image taken at an on-board time."""
    from tmtc.packets.stream import cut_packets

    octets = b"".join(packets)
    table = DICTIONARY.unpack_many(octets, cut_packets(octets))["detections"]
    row = int(np.flatnonzero(table.columns["image_ticks"] == tick)[0])
    mine = table.item_owner == row
    return np.column_stack([table.items["u_px"][mine], table.items["v_px"][mine]]).astype(float)


@fixture(scope="module")
def rich_ground(rich_pass, tmp_path_factory):
    """A service with the pass as pass 1, and with the orientation of the payload; not to be altered."""
    data = DataFolder(orientation_bpc=Path("turned.bpc"))
    with MonkeyPatch.context() as patch, open_ground(tmp_path_factory.mktemp("exports") / "home", data) as ground:
        patch.setattr(declared, "_kernel", lambda data: TurnedOrientation())
        assert import_archive(ground, rich_pass.folder) == 1
        yield ground
