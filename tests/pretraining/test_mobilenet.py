"""MobileNetV2 and DeepLab's backbone, the teachers: features of fixed weights.

The features are those of transcriptions of the networks in float64, layer by layer, which these tests held up to 53d6c6a.
"""

import pytest
import torch
from network_files import mobilenet_tensors

from tools.distil.mobilenet import CLASSIFIER, DEEPLAB, MobileNetV2, fold

FEATURES = {
    ("features", 0): (0.33216, 0.57769, -0.03302),
    ("features", 6): (0.01341, 0.24443, -0.01075),
    ("backbone", 1): (0.34478, 0.91846, 0.04636),
    ("backbone", 6): (0.13524, 0.34826, 0.05486),
    ("backbone", 17): (-1.64253, 4.34031, 1.5178),
}
"""Mean, deviation, and the mean weighted by a ramp from -1 to 1 over all values."""


@pytest.mark.parametrize(("network", "last"), FEATURES)
def test_features_of_fixed_weights(network: str, last: int) -> None:
    backbone = network == "backbone"
    folded = fold(mobilenet_tensors(folded=backbone), f"{network}.")
    encoder = MobileNetV2(folded, layout=DEEPLAB if backbone else CLASSIFIER, last=last)
    y, x = torch.meshgrid(torch.linspace(0, 1, 48), torch.linspace(0, 1, 80), indexing="ij")
    image = torch.stack([(6 * x).sin(), (9 * y).cos(), (12 * x * y).sin()])[None] / 2 + 0.5
    with torch.no_grad():
        found = encoder(image).double()
    ramp = torch.linspace(-1, 1, found.numel()).double().view(found.shape)
    measured = float(found.mean()), float(found.std()), float((found * ramp).mean())
    assert measured == pytest.approx(FEATURES[network, last], rel=1e-4, abs=1e-4)
