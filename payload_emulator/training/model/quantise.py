"""The network in 8-bit integers: smaller, and on processors with integer units quicker; kept only where it wins."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from payload_emulator.errors import DatasetError
from payload_emulator.flight.vision.detector import INPUT_NAME, OnnxDetector
from payload_emulator.flight.vision.preprocess import prepare_image, sun_up_turns
from payload_emulator.training.data.dataset import Dataset
from payload_emulator.training.evaluate.evaluate import refuse_other_camera
from payload_emulator.training.model.fit_calibration import plain_model


def quantise(model_octets: bytes, datasets: Sequence[Dataset], frames: int = 48) -> bytes:
    """Octets of the network with 8-bit weights (per channel) and activations; its head stays in floating point.

    Ranges are taken from frames of the validation split. The metadata are kept, so the thresholds are too, but for a
    calibration, which is of the given network only.

    Raises
    ------
    DatasetError
        There are no validation frames, or the frames are of another camera than the detector's.
    """
    import onnx
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
    from onnxruntime.quantization.shape_inference import quant_pre_process

    model_octets = plain_model(model_octets)
    detector = OnnxDetector(model_octets)
    for dataset in datasets:
        refuse_other_camera(detector, dataset)
    every = [(d, f) for d in datasets for f in d.frames("val")]
    if not every:
        raise DatasetError("quantisation: expected frames of the split 'val', found none")
    chosen = [every[k] for k in np.unique(np.linspace(0, len(every) - 1, frames).astype(int))]

    class Reader(CalibrationDataReader):  # type: ignore[misc]  # onnxruntime has no types
        def __init__(self) -> None:
            self.left = iter(chosen)

        def get_next(self) -> dict[str, Any] | None:
            item = next(self.left, None)
            if item is None:
                return None
            gray = prepare_image(item[0].image(item[1])).gray
            tile = np.ascontiguousarray(np.rot90(gray, sun_up_turns(item[1].sun_camera)))
            return {INPUT_NAME: tile[None, None]}

    with tempfile.TemporaryDirectory() as folder:
        source, prepared, result = (Path(folder) / name for name in ("a.onnx", "b.onnx", "c.onnx"))
        source.write_bytes(model_octets)
        quant_pre_process(str(source), str(prepared), skip_symbolic_shape=True)
        model = onnx.load(str(prepared))
        convolutions = [node for node in model.graph.node if node.op_type == "Conv"]
        quantize_static(
            str(prepared),
            str(result),
            Reader(),
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            nodes_to_exclude=[convolutions[-1].name],
        )
        quantised = onnx.load(str(result))
    metadata = {item.key: item.value for item in onnx.load_from_string(model_octets).metadata_props}
    onnx.helper.set_model_props(quantised, metadata | {"quantised": "8-bit, per channel, head in float32"})
    octets: bytes = quantised.SerializeToString()
    return octets
