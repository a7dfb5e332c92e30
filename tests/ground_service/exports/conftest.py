"""The synthetic pass with attitudes, images, identifications and states of the filter."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from ground_service.ground import Ground, open_ground
from ground_service.passes.archive_import import import_archive
from lunar.camera import PinholeCamera, nadir_camera_from_mcmf
from lunar.catalogue import load_catalogue
from lunar.frames import IauOrientation, quaternion_from_matrix
from lunar.timescales import tdb_s_from_utc_ns, ticks_from_utc_ns
from tests.ground_service.conftest import (
    PIXEL_OFFSET,
    SyntheticPass,
    circular_states,
    encode_downlink,
    write_manifest,
)
from tmtc.dictionary import DICTIONARY
from tmtc.packets import PacketSequencer

FRAMES = 12
FILTER_OFFSET_M = np.array([10.0, -20.0, 5.0])


@dataclass(frozen=True)
class RichPass:
    """Archive of the pass, positions (n, 3) and attitudes of its frames, and the craters of its identifications."""

    folder: Path
    utc_ns: np.ndarray
    position_mcmf_m: np.ndarray
    camera_from_icrf: np.ndarray
    craters: list[list[int]]


@pytest.fixture(scope="session")
def rich_pass(make_pass: Callable[..., SyntheticPass]) -> RichPass:
    made = make_pass(frames=FRAMES, filter_nis=2.0)
    folder = made.folder
    position, velocity = circular_states(made.utc_ns)
    mcmf_from_icrf = IauOrientation().mcmf_from_icrf(np.asarray(tdb_s_from_utc_ns(made.utc_ns)))
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
    sequencer = PacketSequencer()
    packets, craters = list(made.packets), []

    def send(name: str, values: dict[str, Any], at: int) -> None:
        apid = DICTIONARY.packet(name).apid
        packets.append(DICTIONARY.pack(name, values, ticks=at, sequence_count=sequencer.next(apid)))

    for k, tick in enumerate(ticks.tolist()):
        uv = _detections(made.packets, tick)
        projected = PinholeCamera().project(
            (catalogue.position_mcmf_m - position_mcmf[k]) @ camera_from_mcmf[k].T
        )
        distance = np.linalg.norm(projected[None] + PIXEL_OFFSET - uv[:-1, None], axis=2)
        nearest = np.nanargmin(distance, axis=1)
        craters.append(catalogue.ids[nearest].tolist())
        items = {"detection": np.arange(len(nearest)), "crater_id": catalogue.ids[nearest]}
        send("identifications", {"frame_number": k, "image_ticks": tick, "items": items}, tick + 600)
        send(
            "filter_state",
            {
                "frame_number": k,
                "image_ticks": tick,
                "position_icrf_m": position[k] + FILTER_OFFSET_M,
                "velocity_icrf_m_s": velocity[k],
                "acceleration_rtn_m_s2": np.zeros(3),
                "covariance": np.diag([100.0] * 3 + [1e-4] * 3 + [1e-12] * 3)[np.tril_indices(9)],
            },
            tick + 700,
        )
    (folder / "downlink.cadu").write_bytes(encode_downlink(packets))
    manifest = json.loads((folder / "manifest.json").read_text())
    del manifest["files"]
    write_manifest(folder, manifest)
    return RichPass(folder, made.utc_ns, position_mcmf, camera_from_icrf, craters)


def _detections(packets: list[bytes], tick: int) -> np.ndarray:
    """Pixels (n, 2) of the detections of the image taken at an on-board time."""
    from tmtc.stream import cut_packets

    octets = b"".join(packets)
    table = DICTIONARY.unpack_many(octets, cut_packets(octets), only=("detections",))["detections"]
    row = int(np.flatnonzero(table.columns["image_ticks"] == tick)[0])
    mine = table.item_owner == row
    return np.column_stack([table.items["u_px"][mine], table.items["v_px"][mine]]).astype(float)


@pytest.fixture(scope="module")
def rich_ground(rich_pass: RichPass, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ground]:
    """A service with the pass as pass 1; not to be altered."""
    with open_ground(tmp_path_factory.mktemp("exports") / "home") as ground:
        assert import_archive(ground, rich_pass.folder) == 1
        yield ground
