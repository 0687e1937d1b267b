"""Teachers, their ensemble, the views and streets that semantics are distilled from."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from photo_folder import teacher_files

from benchmarks.town.palettes import PALETTES
from benchmarks.town.surface import CLASSES
from tools.distil.semantic import (
    LOOKS,
    STRIDE,
    VIEWS,
    Ensemble,
    MobileNetTeacher,
    Streets,
    load_teacher,
    look,
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
    found = street_targets(ensemble, streets, CELL)
    said = torch.cat([taught(ensemble, view[:1].float() / 255, CELL) for view in streets.images]).double()
    share = streets.classes.double()
    total = share.sum((0, 2, 3))
    means = torch.stack([(share[:, k, None] * said).sum((0, 2, 3)) / total[k].clamp_min(1e-30) for k in range(len(CLASSES))])
    for v, i, j in ((0, 0, 0), (1, 3, 2), (4, 1, 1)):
        wanted = 0.5 * said[v, :, i, j] + 0.5 * share[v, :, i, j] @ means
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


@pytest.mark.parametrize(("height", "width"), [(16, 16), (17, 33), (40, 90), (5, 100)])
def test_one_feature_per_sixteen_pixels(teachers: list[MobileNetTeacher], height: int, width: int) -> None:
    for teacher in teachers:
        features = teacher(torch.rand(1, 3, height, width))
        assert features.shape[2:] == (-(-height // 16), -(-width // 16))
        assert torch.isfinite(features).all()
