"""Teachers, their ensemble, the views and streets that semantics are distilled from."""

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from network_files import mobilenet_tensors
from photo_folder import photo_folder, teacher_files
from safetensors.torch import save_file
from torch import Tensor

from fprf.plugins.encoders.config import BundledSemanticConfig
from fprf.plugins.encoders.mobilenet import CLASSIFIER
from fprf.town.palettes import PALETTES
from fprf.town.surface import CLASSES
from tools.distil.config import SemanticDistilConfig
from tools.distil.semantic import (
    LOOKS,
    STRIDE,
    VIEWS,
    Ensemble,
    MobileNetTeacher,
    Streets,
    load_teacher,
    look,
    pretrain_semantic,
    relations,
    render_streets,
    semantic_ensemble,
    street_targets,
    taught,
    view,
)


@settings(max_examples=30, deadline=None)
@given(cells=st.integers(2, 12), seed=st.integers(0, 999))
def test_a_view_and_its_target_show_the_same_place(cells: int, seed: int) -> None:
    """Targets are the mean position of their cell, images the position itself: the light changes, the order does not."""
    position = torch.arange(cells * STRIDE).float()
    image = (40 + 150 * position / len(position)).byte().expand(3, len(position), -1)
    target = torch.arange(cells).float().expand(2, cells, -1).contiguous()
    generator = torch.Generator().manual_seed(seed)
    seen, wanted = view(image, target, generator)
    side = wanted.shape[-1]
    assert seen.shape == (3, side * STRIDE, side * STRIDE)
    assert wanted.shape == (2, side, side)
    ramp = torch.nn.functional.avg_pool2d(seen[None], STRIDE)[0].mean((0, 1))
    if side > 1 and ramp.std() > 0.02:
        assert torch.corrcoef(torch.stack([ramp, wanted[0, 0]]))[0, 1] > 0.5


def test_relations_compare_cosines_about_the_mean() -> None:
    """Turning, scaling and shifting all of a side changes nothing; another arrangement does. Against a plain loop."""
    generator = torch.Generator().manual_seed(0)
    wanted = torch.randn(2, 5, 4, 4, generator=generator).double()
    turn = torch.linalg.qr(torch.randn(5, 5, generator=generator).double()).Q
    moved = 3 * torch.einsum("ij,bjhw->bihw", turn, wanted)
    assert relations(moved, wanted, 4096, torch.Generator().manual_seed(1)) < 1e-20
    other = torch.randn(2, 5, 4, 4, generator=generator).double()
    found = relations(other, wanted, 6, torch.Generator().manual_seed(1))
    index = torch.randint(0, 32, (6,), generator=torch.Generator().manual_seed(1)).tolist()
    sides = []
    for side in (other, wanted):
        cells = [side[i // 16, :, i % 16 // 4, i % 4] for i in index]
        mean = sum(cells) / 6
        sides.append([(cell - mean) / (cell - mean).norm() for cell in cells])
    total = sum(float(sides[0][i] @ sides[0][j] - sides[1][i] @ sides[1][j]) ** 2 for i in range(6) for j in range(6)) / 36
    assert float(found) == pytest.approx(total, rel=1e-12)


def test_a_short_run_from_photographs_and_streets(tmp_path: Path) -> None:
    """Written, of the ensemble's width, measured."""
    photos = photo_folder(tmp_path / "photos", 5)
    config = SemanticDistilConfig(images=(photos,), teachers=teacher_files(tmp_path), size=32, towns=1, steps=2, batch=2)
    said: list[str] = []
    report = pretrain_semantic(config, tmp_path / "s.safetensors", said.append)
    assert "29 crops prepared" in said  # four photographs and five views in five palettes
    assert BundledSemanticConfig(weights=tmp_path / "s.safetensors").build().channels == 26 + 25
    assert report["steps"] == 2
    assert 0 < float(report["relative_l2"]) < 20


CROP, CELL = 32, 8


@pytest.fixture(scope="module")
def streets() -> Streets:
    return render_streets(1, CROP, CELL)


@pytest.fixture(scope="module")
def teachers(tmp_path_factory: pytest.TempPathFactory) -> list[MobileNetTeacher]:
    return [load_teacher(path) for path in teacher_files(tmp_path_factory.mktemp("teachers"))]


@pytest.fixture(scope="module")
def ensemble(teachers: list[MobileNetTeacher]) -> Ensemble:
    return semantic_ensemble(teachers, list(torch.rand(4, 3, 32, 32, generator=torch.Generator().manual_seed(0))), CELL)


def test_every_view_in_every_palette_and_shares_of_its_classes(streets: Streets) -> None:
    assert streets.images.shape == (VIEWS, len(PALETTES), 3, CROP, CROP)
    day, night = list(PALETTES).index("day"), list(PALETTES).index("night")
    brightness = streets.images.float().mean((2, 3, 4))
    assert (brightness[:, night] < brightness[:, day]).all()
    assert streets.classes.shape == (VIEWS, len(CLASSES), CROP // CELL, CROP // CELL)
    assert torch.allclose(streets.classes.sum(1), torch.ones(VIEWS, 4, 4), atol=1e-6)


def test_targets_are_half_way_to_the_mean_of_their_class(ensemble: Ensemble, streets: Streets) -> None:
    """Plain loops over cells as the oracle."""
    found = street_targets(ensemble, streets, CELL)
    said = torch.cat([taught(ensemble, view[:1].float() / 255, CELL) for view in streets.images]).double()
    share = streets.classes.double()
    means = {}
    for k in range(len(CLASSES)):
        total, weight = torch.zeros(said.shape[1], dtype=torch.float64), 0.0
        for v in range(VIEWS):
            for i in range(4):
                for j in range(4):
                    total += share[v, k, i, j] * said[v, :, i, j]
                    weight += float(share[v, k, i, j])
        means[k] = total / weight if weight > 0 else total
    for v, i, j in ((0, 0, 0), (1, 3, 2), (4, 1, 1)):
        mean = sum(share[v, k, i, j] * means[k] for k in means)
        wanted = 0.5 * said[v, :, i, j] + 0.5 * mean
        assert torch.allclose(found[v, :, i, j].double(), wanted, atol=1e-4)


def test_mirrored_images_give_mirrored_features(teachers: list[MobileNetTeacher]) -> None:
    image = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    for teacher in teachers:
        found, mirrored = look(teacher, image, 8), look(teacher, image.flip(-1), 8)
        # The two sums hold the same terms; only resampling rounds differently.
        assert torch.allclose(found, mirrored.flip(-1), atol=1e-4 * float(found.abs().max()))


def test_a_look_is_the_mean_over_scales_and_mirror_images(teachers: list[MobileNetTeacher]) -> None:
    """Against a plain loop, on an image that no scale has to resize by parts of a pixel."""
    image = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(1)).double()
    teacher = teachers[0]
    wanted = torch.zeros(1, 26, 8, 8)
    for scale in LOOKS:
        side = round(64 * scale)
        seen = torch.nn.functional.interpolate(image, (side, side), mode="bilinear", antialias=scale < 1).float()
        for flip in (False, True):
            features = teacher(seen.flip(-1) if flip else seen)
            features = features.flip(-1) if flip else features
            wanted += torch.nn.functional.interpolate(features, (8, 8), mode="bilinear") / 4
    assert torch.allclose(look(teacher, image.float(), 8), wanted, atol=1e-4 * float(wanted.abs().max()))


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
        stride, y, at = CLASSIFIER.strides[block - 1], x, 0
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
def test_one_feature_per_sixteen_pixels(teachers: list[MobileNetTeacher], height: int, width: int) -> None:
    for teacher in teachers:
        features = teacher(torch.rand(1, 3, height, width))
        assert features.shape[2:] == (-(-height // 16), -(-width // 16))
        assert torch.isfinite(features).all()
