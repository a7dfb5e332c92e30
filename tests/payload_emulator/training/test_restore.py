"""An exported network made trainable again: the same outputs, and a normalisation that fits the data."""

import numpy as np
import pytest

from payload_emulator.errors import ModelError
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.flight.vision.detector import OnnxDetector, decode
from payload_emulator.training.model.export import keep_blocked, onnx_model
from tests.lazy import Lazy

torch = Lazy("torch")
networks = Lazy("payload_emulator.training.model.model")
restoring = Lazy("payload_emulator.training.model.restore")


class Crops:
    """Stands in for the feeder: seeded images of another brightness than unit deviation."""

    def batch(self, first: int, count: int) -> dict[str, np.ndarray]:
        rng = np.random.default_rng(first)
        return {"image": 1.7 * rng.standard_normal((count, 1, 64, 64)).astype(np.float32) + 0.4}


@pytest.fixture()
def shipped(tmp_path):
    path = tmp_path / "m.onnx"
    path.write_bytes(load_shipped_model())
    return path


def outputs(network, image):
    with torch.no_grad():
        heat, geometry = network(torch.from_numpy(image))
    return torch.sigmoid(heat).numpy(), geometry.numpy()


def test_the_restored_network_gives_what_the_exported_one_gives(shipped) -> None:
    network, document = restoring.network_from_onnx(shipped)
    image = np.random.default_rng(1).standard_normal((1, 1, 512, 512)).astype(np.float32)
    heat, geometry = outputs(network, image)
    expected = OnnxDetector(shipped.read_bytes()).run_network(image)
    # Single precision through 67 layers: the limit that the export itself holds to.
    np.testing.assert_allclose(heat, expected[0], atol=2e-4)
    np.testing.assert_allclose(geometry, expected[1], atol=2e-4)
    assert document["progress"]["step"] == 5095  # in the metadata of the shipped network


def test_counted_statistics_leave_outputs_and_make_training_mode_agree(shipped) -> None:
    network, _ = restoring.network_from_onnx(shipped)
    average, _ = restoring.network_from_onnx(shipped)
    image = Crops().batch(1, 16)["image"]
    before = outputs(network, image)
    restoring.count_statistics(network, Crops(), average, crops=32)
    after = outputs(network, image)
    np.testing.assert_allclose(after[0], before[0], atol=2e-4)
    np.testing.assert_allclose(after[1], before[1], atol=2e-3)
    np.testing.assert_allclose(outputs(average, image)[0], after[0], atol=1e-6)
    first = network.stem[1]
    with torch.no_grad():
        seen = network.stem[0](
            torch.from_numpy(np.concatenate([Crops().batch(k, 1)["image"] for k in range(32)]))
        )
    np.testing.assert_allclose(first.running_mean.numpy(), seen.mean((0, 2, 3)).numpy(), atol=1e-4)
    np.testing.assert_allclose(
        first.running_var.numpy(), seen.var((0, 2, 3), unbiased=False).numpy(), rtol=1e-3
    )


def test_what_is_no_exported_network_is_refused(tmp_path) -> None:
    with pytest.raises(ModelError, match="expected an exported network, found no file"):
        restoring.network_from_onnx(tmp_path / "none.onnx")
    (tmp_path / "text.onnx").write_text("no model")
    with pytest.raises(ModelError, match="expected an exported network"):
        restoring.network_from_onnx(tmp_path / "text.onnx")


def test_an_enlarging_network_gives_maps_of_half_the_stride_and_flies() -> None:
    network = networks.CraterNet(networks.ModelConfig(16, depth=True, enlarge=2)).eval()
    assert network.config.cell_px == 2
    import onnx

    model = keep_blocked(onnx_model(networks.ExportedCraterNet(network).eval()))
    detector = OnnxDetector(model.SerializeToString())
    assert onnx.checker.check_model(model) is None
    assert detector.stride_px == 2
    image = np.random.default_rng(2).standard_normal((1, 1, 512, 512)).astype(np.float32)
    heat, geometry = detector.run_network(image)
    assert heat.shape == (1, 1, 256, 256) and geometry.shape == (1, 5, 256, 256)
    np.testing.assert_allclose(heat, outputs(network, image)[0], atol=2e-4)
    with pytest.raises(ModelError, match="expected a divisor of the stride 4, found 3"):
        networks.ModelConfig(enlarge=3)


def test_older_networks_name_the_only_backbone_and_stride() -> None:
    assert networks.parse_config({"enlarge": 2, "backbone": "small", "stride_px": 4}) == networks.ModelConfig(
        enlarge=2
    )
    with pytest.raises(ModelError, match="expected backbone small, found 'large'"):
        networks.parse_config({"backbone": "large"})
    with pytest.raises(ModelError, match="expected stride_px 4, found 2"):
        networks.parse_config({"stride_px": 2})


def test_a_peak_of_a_fine_map_lies_in_the_middle_of_its_cell() -> None:
    heat = np.zeros((256, 256), np.float32)
    heat[10, 20] = 0.9
    found = decode(heat, np.zeros((5, 256, 256), np.float32), 0.5, 2)
    # Cell 20 of two pixels covers pixels 40 and 41.
    assert (found.u_px[0], found.v_px[0]) == (pytest.approx(40.5), pytest.approx(20.5))


def test_an_enlarging_copy_sees_the_enlarged_image_and_tells_pixels_of_the_image(shipped) -> None:
    network, _ = restoring.network_from_onnx(shipped)
    image = np.random.default_rng(5).standard_normal((1, 1, 128, 128)).astype(np.float32)
    large = torch.nn.functional.interpolate(
        torch.from_numpy(image), scale_factor=2.0, mode="bilinear", align_corners=False
    ).numpy()
    heat, geometry = outputs(restoring.enlarging(network, 2), image)
    expected_heat, expected = outputs(network, large)
    np.testing.assert_allclose(heat, expected_heat, atol=1e-5)
    np.testing.assert_allclose(geometry[:, 2], expected[:, 2] - np.log(2.0), atol=1e-4)
    np.testing.assert_allclose(geometry[:, 3], expected[:, 3] - np.log(2.0), atol=1e-4)
    np.testing.assert_allclose(geometry[:, :2], expected[:, :2], atol=1e-4)
