"""Which views see a point best, and how much light is expected from it."""

import math

import pytest
import torch
from analytic import RADIUS, globe
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.export.colours import best_views, expected_presence
from fprf.export.depth_maps import depth_gaps, ray_quantile


def sphere(count: int, seed: int) -> torch.Tensor:
    drawn = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return RADIUS * torch.nn.functional.normalize(drawn, dim=1)


@settings(max_examples=20)
@given(seed=st.integers(0, 2**31), count=st.integers(1, 5))
def test_witnesses_are_the_best_of_those_that_see_a_point(seed: int, count: int) -> None:
    """Against looking at each point and view alone."""
    maps, point = globe(6), sphere(12, seed)
    seen = best_views(maps, point, point.float(), 0.05, count)
    assert seen.view.shape == seen.weight.shape == (12, count)
    for n in range(12):
        scores = {}
        for view in range(6):
            [gap], [distance] = depth_gaps(maps, view, point[n : n + 1])
            if abs(float(gap)) <= 0.1:
                way = (maps.cameras.pose[view, :, 3] - point[n]) / distance
                scores[view] = max(1e-3, float(way @ point[n])) / float(distance) ** 2
        best = sorted(scores, key=lambda view: -scores[view])[:count]
        used = seen.weight[n] > 0
        if best:
            assert seen.view[n][used].tolist() == best
            wanted = torch.tensor([scores[view] / scores[best[0]] for view in best], dtype=torch.float64)
            assert torch.allclose(seen.weight[n][used], wanted, rtol=1e-6)
        else:
            assert used.tolist() == [True] + [False] * (count - 1), "somebody must speak for it"


@pytest.mark.parametrize("extinction", [0.5, 3.0, 200.0])
def test_expected_presence_is_the_light_of_a_uniform_medium_of_that_thickness(extinction: float) -> None:
    depth, tolerance = 4.0, 0.05
    edges = torch.linspace(0, 40 / extinction, 4001, dtype=torch.float64)
    weights = torch.exp(-extinction * edges[:-1]) - torch.exp(-extinction * edges[1:])
    first, last = (ray_quantile(weights[None], edges[None], torch.tensor([share]).double()) for share in (0.1, 0.9))
    maps, point = globe(6), sphere(20, 2)
    thick = tuple(torch.full_like(view, float(last - first) / depth) for view in maps.depth)
    seen = best_views(maps, point, point.float(), 0.05, 3)
    light = -math.expm1(-extinction * 2 * tolerance * depth)
    found = expected_presence(maps._replace(thickness=thick), point, seen, tolerance)
    assert torch.allclose(found, torch.full((20,), light), rtol=1e-3)
    assert bool((expected_presence(maps, point, seen, tolerance) == 1).all()), "sharp where nothing else is known"
