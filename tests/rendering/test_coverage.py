from dataclasses import replace

import pytest
import torch

from fprf.rendering.coverage import coverage, well_covered
from fprf.rendering.paths import look_at, pinhole
from fprf.rendering.space import Space

SPACE = Space("contraction", (0, 0, 0), ((1, 0, 0), (0, 1, 0), (0, 0, 1)), 0.5, 0.05, 100.0)


@pytest.mark.parametrize("kind", ["contraction", "ndc"])
def test_the_middle_of_a_row_is_covered_better_than_its_ends_and_strays_least(kind: str) -> None:
    x = torch.cat([torch.linspace(-2, 2, 21), torch.zeros(2)]).double()
    place = torch.stack([x, torch.zeros_like(x), torch.full_like(x, 2.0)], 1)
    target = place - torch.tensor([0.0, 0.0, 2.0])
    target[21:] = torch.tensor([[0.0, 0.0, 9.0], [0.0, 9.0, 2.1]])  # these look elsewhere
    cameras = pinhole(look_at(place, target, torch.tensor([0.0, 1.0, 0.0]).double()), width=40, height=30, fov=50.0)
    space = replace(SPACE, kind=kind, near=1.0)  # type: ignore[arg-type]
    score = coverage(cameras, range(23), space)
    assert float(score.min()) >= 0 and float(score.max()) < 1
    assert bool((score[21:] < score[:21].min()).all()) and bool((score[[0, 20]] < score[6:15].min()).all())
    shown = well_covered(cameras, range(23), space, 4)
    assert len(shown) == 4 and shown == sorted(set(shown)) and set(shown) <= set(range(3, 18)), "strays and ends are left out"
    assert max(shown) - min(shown) >= 6, "and they are spread"
    assert bool((coverage(cameras, range(0, 23, 5), space) <= score).all()), "fewer cameras cover less"
