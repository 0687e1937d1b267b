import pytest
import torch

from benchmarks.false_edges import false_edges

H, W, REACH = 36, 48, 3


def wall() -> torch.Tensor:
    """Even, with a quiet ramp of light."""
    return 0.4 + 0.1 * torch.linspace(0, 1, W).expand(H, W)[..., None].repeat(1, 1, 3)


def test_one_map_for_all_is_no_cut() -> None:
    plain = wall()
    for styled in (plain, 1 - plain, plain * 1.8, plain * torch.tensor([0.9, 0.2, 0.1]) + 0.1):
        assert false_edges(plain, styled) == 0


def test_a_style_that_ends_on_a_wall_cuts_the_pairs_across() -> None:
    plain, styled = wall(), wall()
    styled[:, : W // 2, 0] += 0.5
    pairs = H * (W - REACH) + (H - REACH) * W
    # Both pictures are blurred by a pixel, so that pairs which only touch the border count as well.
    assert false_edges(plain, styled) == pytest.approx(H * (REACH + 1) / pairs, rel=0.3)
