"""Teachers averaged: where they look, what mirroring does, how their components weigh."""

import pytest
import torch
from photo_folder import teacher_files

from tools.distil.semantic import (
    COMPONENTS,
    LOOKS,
    Ensemble,
    MobileNetTeacher,
    load_teacher,
    look,
    semantic_ensemble,
    taught,
)


@pytest.fixture(scope="module")
def teachers(tmp_path_factory: pytest.TempPathFactory) -> list[MobileNetTeacher]:
    return [load_teacher(path) for path in teacher_files(tmp_path_factory.mktemp("teachers"))]


@pytest.fixture(scope="module")
def ensemble(teachers: list[MobileNetTeacher]) -> Ensemble:
    return semantic_ensemble(teachers, list(torch.rand(4, 3, 64, 96, generator=torch.Generator().manual_seed(2))), 8)


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


def test_every_teacher_weighs_the_same(ensemble: Ensemble) -> None:
    images = torch.rand(4, 3, 64, 96, generator=torch.Generator().manual_seed(2))
    said = taught(ensemble, images, 8)
    widths = [min(COMPONENTS, len(basis.mean)) for _, basis in ensemble]
    assert said.shape == (4, sum(widths), 8, 12)
    for part in said.split(widths, 1):
        assert part.mean((0, 2, 3)).abs().max() < 1e-3
        assert part.square().mean() == pytest.approx(1.0, rel=1e-3)
