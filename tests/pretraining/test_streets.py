"""Rendered streets: one place in every light, one answer, drawn towards its class."""

import pytest
import torch
from photo_folder import teacher_files

from fprf.town.palettes import PALETTES
from fprf.town.surface import CLASSES
from tools.distil.semantic import (
    FIRST_SEED,
    VIEWS,
    Ensemble,
    Streets,
    load_teacher,
    render_streets,
    semantic_ensemble,
    street_targets,
    taught,
)

SIZE, STRIDE = 32, 8


@pytest.fixture(scope="module")
def streets() -> Streets:
    return render_streets(1, SIZE, STRIDE)


@pytest.fixture(scope="module")
def ensemble(tmp_path_factory: pytest.TempPathFactory) -> Ensemble:
    teachers = [load_teacher(path) for path in teacher_files(tmp_path_factory.mktemp("teachers"))]
    return semantic_ensemble(teachers, list(torch.rand(4, 3, 32, 32, generator=torch.Generator().manual_seed(0))), STRIDE)


def test_every_view_in_every_palette(streets: Streets) -> None:
    assert streets.images.shape == (VIEWS, len(PALETTES), 3, SIZE, SIZE)
    assert streets.images.dtype == torch.uint8
    day, night = list(PALETTES).index("day"), list(PALETTES).index("night")
    brightness = streets.images.float().mean((2, 3, 4))
    assert (brightness[:, night] < brightness[:, day]).all()


def test_shares_of_classes_sum_to_one(streets: Streets) -> None:
    assert streets.classes.shape == (VIEWS, len(CLASSES), SIZE // STRIDE, SIZE // STRIDE)
    assert torch.allclose(streets.classes.sum(1), torch.ones(VIEWS, 4, 4), atol=1e-6)


def test_streets_are_the_same_every_time_and_nobody_elses(streets: Streets) -> None:
    again = render_streets(1, SIZE, STRIDE)
    assert torch.equal(streets.images, again.images)
    assert FIRST_SEED > 1000, "seeds that users and tests take are small"


def test_targets_are_half_way_to_the_mean_of_their_class(ensemble: Ensemble, streets: Streets) -> None:
    """Plain loops over cells as the oracle."""
    found = street_targets(ensemble, streets, STRIDE)
    said = torch.cat([taught(ensemble, view[:1].float() / 255, STRIDE) for view in streets.images]).double()
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


def test_a_pure_cell_moves_towards_its_class(ensemble: Ensemble, streets: Streets) -> None:
    """Within a class targets lie closer together than what the teachers said."""
    said = torch.cat([taught(ensemble, view[:1].float() / 255, STRIDE) for view in streets.images])
    found = street_targets(ensemble, streets, STRIDE)
    pure = streets.classes.amax(1) > 0.99
    label = streets.classes.argmax(1)
    common = int(label[pure].mode().values)
    inside = pure & (label == common)
    before, after = (x.permute(0, 2, 3, 1)[inside] for x in (said, found))
    assert (after - after.mean(0)).square().sum() < 0.5 * (before - before.mean(0)).square().sum()


def test_no_class_is_no_harm(ensemble: Ensemble, streets: Streets) -> None:
    """Classes that no view shows divide nothing by zero."""
    classes = streets.classes.clone()
    classes[:, 0] += classes[:, -1]
    classes[:, -1] = 0
    assert torch.isfinite(street_targets(ensemble, streets._replace(classes=classes), STRIDE)).all()
