"""MobileNetV2s: norms folded exactly, padding as TensorFlow's, cells in their places."""

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from photo_folder import STRIDES, mobilenet_tensors, teacher_files
from safetensors.torch import save_file
from torch import Tensor

from fprf.errors import WeightsError
from fprf.pretraining.photos import load_photo
from tools.distil.examples import crop
from tools.distil.semantic import load_teacher


def unfolded(tensors: dict[str, Tensor], image: Tensor) -> Tensor:
    """MobileNetV2 in float64, layer by layer as torchvision's modules, with SAME padding of a stride 2 on even sizes."""
    values = {name: value.double() for name, value in tensors.items()}

    def layer(x: Tensor, conv: str, norm: str, stride: int = 1, groups: int = 1) -> Tensor:
        weight = values[f"features.{conv}.weight"]
        if weight.shape[-1] == 3:
            x = F.pad(x, (0, 1, 0, 1) if stride == 2 else (1, 1, 1, 1))
        x = F.conv2d(x, weight, stride=stride, groups=groups)
        parts = [values[f"features.{norm}.{part}"] for part in ("running_mean", "running_var", "weight", "bias")]
        return F.batch_norm(x, *parts, eps=1e-3)

    x = layer(2 * image.double() - 1, "0.0", "0.1", 2).clamp(0, 6)
    for block in range(1, 14):
        stride, y, at = STRIDES[block - 1], x, 0
        if block > 1:
            y, at = layer(x, f"{block}.conv.0.0", f"{block}.conv.0.1").clamp(0, 6), 1
        y = layer(y, f"{block}.conv.{at}.0", f"{block}.conv.{at}.1", stride, y.shape[1]).clamp(0, 6)
        y = layer(y, f"{block}.conv.{at + 1}", f"{block}.conv.{at + 2}")
        x = x + y if stride == 1 and x.shape == y.shape else y
    return x


def test_folding_changes_nothing(tmp_path: Path) -> None:
    tensors = mobilenet_tensors(folded=False)
    save_file(tensors, tmp_path / "m.safetensors")
    image = torch.rand(2, 3, 64, 96)
    found = load_teacher(tmp_path / "m.safetensors")(image)
    assert found.shape == (2, 4, 4, 6)
    torch.testing.assert_close(found.double(), unfolded(tensors, image), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("height", "width"), [(16, 16), (17, 33), (40, 90), (5, 100)])
def test_one_feature_per_sixteen_pixels(tmp_path: Path, height: int, width: int) -> None:
    for path in teacher_files(tmp_path):
        features = load_teacher(path)(torch.rand(1, 3, height, width))
        assert features.shape[2:] == (-(-height // 16), -(-width // 16))
        assert torch.isfinite(features).all()


def test_other_files_are_refused(tmp_path: Path) -> None:
    save_file({"features.0.weight": torch.zeros(1)}, tmp_path / "vgg.safetensors")
    with pytest.raises(WeightsError, match="neither MobileNetV2"):
        load_teacher(tmp_path / "vgg.safetensors")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mobilenet_v2_imagenet", "deeplabv3_mobilenetv2_pascal"])
def test_cells_lie_where_they_look(shared: Path, name: str) -> None:
    """The features of a mirrored photograph, mirrored back, agree best where they are."""
    teacher = load_teacher(shared / f"weights/{name}.safetensors")
    photos = sorted((shared / "data/pretrain/bsds500").glob("*.jpg"))[:4]
    images = torch.stack([crop(load_photo(path), 384, (1.5, 1.5), torch.Generator().manual_seed(0)) for path in photos])
    found, mirrored = teacher(images), teacher(images.flip(-1)).flip(-1)
    mean = found.mean(dim=(0, 2, 3), keepdim=True)
    agree = {
        shift: float(F.cosine_similarity((found - mean)[..., 1 + shift : 23 + shift], (mirrored - mean)[..., 1:23]).mean())
        for shift in (-1, 0, 1)
    }
    assert max(agree, key=agree.__getitem__) == 0
