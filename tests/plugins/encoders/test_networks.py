"""MobileNetV2, DeepLab and ESPNetv2: features of fixed weights, files that do not fit, labels of a real street.

The features are those of transcriptions of the networks in float64, layer by layer, which these tests held up to 53d6c6a.
"""

from pathlib import Path

import cv2
import pytest
import torch
import torch.nn.functional as F
from network_files import deeplab_file, deeplab_tensors, espnet_file, mobilenet_file, mobilenet_tensors
from safetensors.torch import save_file

from fprf.errors import WeightsError
from fprf.plugins.encoders.config import DeepLabConfig, EspNetConfig, MobileNetV2Config

FEATURES = {
    ("espnet", "level1"): (0.62065, 1.29685, 0.08099),
    ("espnet", "level2"): (0.83834, 1.82526, -0.04971),
    ("espnet", "level3"): (2.93303, 4.37912, 0.18621),
    ("espnet", "level4"): (9.50932, 16.94964, -0.3072),
    ("espnet", "logits"): (0.03212, 2.13619, 0.56356),
    ("keras", "features.0"): (0.33216, 0.57769, -0.03302),
    ("keras", "features.6"): (0.01341, 0.24443, -0.01075),
    ("keras", "features.18"): (0.31645, 0.3891, -0.04634),
    ("torchvision", "features.0"): (0.87139, 1.41164, 0.00218),
    ("torchvision", "features.6"): (0.33592, 0.85445, 0.10303),
    ("torchvision", "features.18"): (1.27188, 1.12297, -0.1532),
    ("deeplab", "backbone.1"): (0.34478, 0.91846, 0.04636),
    ("deeplab", "backbone.6"): (0.13524, 0.34826, 0.05486),
    ("deeplab", "backbone.17"): (-1.64253, 4.34031, 1.5178),
    ("deeplab", "logits"): (0.55768, 7.07256, 3.22318),
}
"""Mean, deviation, and the mean weighted by a ramp from -1 to 1 over all values."""


@pytest.mark.parametrize(("network", "layer"), FEATURES)
def test_features_of_fixed_weights(tmp_path: Path, network: str, layer: str) -> None:
    encoder = {
        "espnet": lambda: EspNetConfig(layer=layer, weights=espnet_file(tmp_path)),
        "deeplab": lambda: DeepLabConfig(layer=layer, weights=deeplab_file(tmp_path)),
        "keras": lambda: MobileNetV2Config(layer=layer, weights=mobilenet_file(tmp_path, tensorflow=True)),
        "torchvision": lambda: MobileNetV2Config(layer=layer, weights=mobilenet_file(tmp_path, tensorflow=False)),
    }[network]().build()
    y, x = torch.meshgrid(torch.linspace(0, 1, 48), torch.linspace(0, 1, 80), indexing="ij")
    image = torch.stack([(6 * x).sin(), (9 * y).cos(), (12 * x * y).sin()])[None] / 2 + 0.5
    found = encoder(image).double()
    ramp = torch.linspace(-1, 1, found.numel()).double().view(found.shape)
    assert found.shape[1] == encoder.channels
    assert (float(found.mean()), float(found.std()), float((found * ramp).mean())) == pytest.approx(
        FEATURES[network, layer], rel=1e-4, abs=1e-4
    )


def test_files_that_do_not_fit(tmp_path: Path) -> None:
    tensors = mobilenet_tensors(folded=False)
    short = {name: value for name, value in tensors.items() if not name.startswith("features.14")}
    save_file(short, tmp_path / "short.safetensors")
    assert MobileNetV2Config(weights=tmp_path / "short.safetensors").build().channels == 4
    with pytest.raises(WeightsError, match=r"does not hold MobileNetV2 features\.14 \(14\.conv.*is missing.*--semantic\.enc"):
        MobileNetV2Config(layer="features.14", weights=tmp_path / "short.safetensors").build()
    save_file(tensors, tmp_path / "eps.safetensors", {"bn_eps": "small"})
    with pytest.raises(WeightsError, match="bn_eps' is 'small'"):
        MobileNetV2Config(weights=tmp_path / "eps.safetensors").build()
    with pytest.raises(WeightsError, match=r"does not hold DeepLabv3 backbone\.17"):
        DeepLabConfig(weights=tmp_path / "short.safetensors").build()
    tensors["features.3.conv.0.0.weight"] = torch.zeros(8, 9, 1, 1)
    save_file(tensors, tmp_path / "wide.safetensors")
    with pytest.raises(WeightsError, match=r"does not hold MobileNetV2 features\.13"):
        MobileNetV2Config(weights=tmp_path / "wide.safetensors").build()
    backbone = {name: value for name, value in deeplab_tensors().items() if name.startswith("backbone")}
    save_file(backbone, tmp_path / "headless.safetensors")
    with pytest.raises(WeightsError, match=r"DeepLabv3 logits \(image_pooling\.weight is missing"):
        DeepLabConfig(layer="logits", weights=tmp_path / "headless.safetensors").build()


@pytest.mark.slow
def test_labels_of_a_street(shared: Path) -> None:
    """`labels_city` were made by the published network at another size."""
    from fprf.pretraining.photos import load_photo

    scene = shared / "data/scenes/street_lund"
    encoder = EspNetConfig(layer="logits", weights=shared / "weights/espnetv2_s2.0_city.safetensors").build()
    for name in ("04", "16"):
        image = load_photo(scene / f"images/{name}.jpg").permute(2, 0, 1)[None]
        scores = F.interpolate(encoder(image), image.shape[2:], mode="bilinear", align_corners=True)
        labels = torch.from_numpy(cv2.imread(str(scene / f"labels_city/{name}.png"), cv2.IMREAD_UNCHANGED))
        assert float((scores[0].argmax(0) == labels).float().mean()) > 0.8
