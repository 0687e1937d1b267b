"""Regions compete for pixels: what they must win, what must not change, and a window that covers all against the textbook."""

import pytest
import torch
from torch import Tensor

from fprf.ops.local_mixture import explained

NOISE = torch.tensor([0.03, 0.03, 0.03])


def two_halves(seed: int = 0) -> tuple[Tensor, Tensor]:
    """A picture of two colours with grain, [40 60 3], and its true left part, [40 60]: the edge is a zigzag."""
    left = torch.arange(60)[None] < 30 + 4 * ((torch.arange(40)[:, None] // 5) % 2)
    colour = torch.where(left[..., None], torch.tensor([0.7, 0.75, 0.9]), torch.tensor([0.2, 0.25, 0.1]))
    grain = 0.03 * torch.randn(colour.shape, generator=torch.Generator().manual_seed(seed))
    return colour + grain, left


def blurred_shares() -> Tensor:
    """Memberships that pass from one region to the other over 20 pixels, [40 60 2]."""
    first = ((42 - torch.arange(60).float()) / 20).clamp(0, 1).expand(40, 60)
    return torch.stack([first, 1 - first], -1)


def test_a_blurred_border_goes_where_colours_have_it() -> None:
    guide, left = two_halves()
    before, solid = blurred_shares(), torch.ones(40, 60, dtype=torch.bool)
    after = explained(before, guide, solid, radius=12.0, noise=NOISE)
    wrong_before, wrong = ((x[..., 0] - left.float()).abs() for x in (before, after))
    assert float(wrong_before.max()) > 0.5
    assert float(wrong.max()) < 0.05


def test_shares_sum_to_what_they_did_and_holes_stay() -> None:
    guide, _ = two_halves()
    before, solid = blurred_shares() * 0.8, torch.ones(40, 60, dtype=torch.bool)
    solid[10:20, 20:40] = False
    after = explained(before, torch.where(solid[..., None], guide, torch.nan), solid, radius=12.0, noise=NOISE)
    assert torch.equal(after[~solid], before[~solid])
    assert torch.allclose(after.sum(-1), before.sum(-1), atol=1e-6)
    assert not torch.allclose(after[solid], before[solid], atol=0.1)


def test_emptiness_around_decides_nothing() -> None:
    guide, _ = two_halves()
    before, solid = blurred_shares(), torch.ones(40, 60, dtype=torch.bool)
    around = (0, 0, 30, 7, 3, 50)
    padded = torch.nn.functional.pad(guide, around, value=torch.nan), torch.nn.functional.pad(solid, around[2:])
    after = explained(torch.nn.functional.pad(before, around, value=0.5), *padded, radius=12.0, noise=NOISE)
    assert torch.equal(after[3:43, 30:90], explained(before, guide, solid, radius=12.0, noise=NOISE))
    assert bool((after[:3] == 0.5).all()) and bool((after[:, :30] == 0.5).all())


@pytest.mark.parametrize("scale", [0.0, 1.0])
def test_regions_of_one_look_keep_their_pixels(scale: float) -> None:
    """Where colour tells nothing apart, everything stays near the mean of the pixel's own share and the window's."""
    guide = 0.5 + scale * 0.03 * torch.randn(40, 60, 3, generator=torch.Generator().manual_seed(1))
    before, solid = blurred_shares(), torch.ones(40, 60, dtype=torch.bool)
    after = explained(before, guide, solid, radius=6.0, noise=NOISE, own=1.0)
    assert float((after - before).abs().mean()) < 0.02


def test_one_step_in_a_window_over_everything_is_the_textbooks() -> None:
    generator = torch.Generator().manual_seed(2)
    guide = torch.rand(8, 9, 3, generator=generator)
    before = torch.softmax(2 * torch.randn(8, 9, 3, generator=generator), -1)
    after = explained(before, guide, torch.ones(8, 9, dtype=torch.bool), radius=100.0, noise=NOISE, own=0.3, steps=1)
    x, s = guide.flatten(0, 1).double(), before.flatten(0, 1).double()
    odds = torch.empty(72, 3, dtype=torch.float64)
    for k in range(3):
        mean = s[:, k] @ x / s[:, k].sum()
        covariance = (x - mean).T @ ((x - mean) * s[:, k : k + 1]) / s[:, k].sum() + torch.diag(NOISE.double() ** 2)
        density = torch.distributions.MultivariateNormal(mean, covariance).log_prob(x).exp()
        odds[:, k] = (0.3 * s[:, k] + 0.7 * s[:, k].mean()) * density
    assert torch.allclose(after.flatten(0, 1).double(), odds / odds.sum(1, keepdim=True), atol=1e-4)
