"""Teachers, their ensemble, the views and streets that semantics are distilled from."""

import pytest
import torch
from photo_folder import teacher_files

from benchmarks.town.surface import CLASSES
from tools.distil.semantic import (
    LOOKS,
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
)


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


def test_targets_are_half_way_to_the_mean_of_their_class(ensemble: Ensemble, streets: Streets) -> None:
    found = street_targets(ensemble, streets, CELL)
    said = torch.cat([taught(ensemble, view[:1].float() / 255, CELL) for view in streets.images]).double()
    share = streets.classes.double()
    total = share.sum((0, 2, 3))
    means = torch.stack([(share[:, k, None] * said).sum((0, 2, 3)) / total[k].clamp_min(1e-30) for k in range(len(CLASSES))])
    for v, i, j in ((0, 0, 0), (1, 3, 2), (4, 1, 1)):
        wanted = 0.5 * said[v, :, i, j] + 0.5 * share[v, :, i, j] @ means
        assert torch.allclose(found[v, :, i, j].double(), wanted, atol=1e-4)


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
