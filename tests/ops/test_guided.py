"""The guided filter against a plain float64 loop, and against what it must do whatever the numbers are."""

import math

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from fprf.errors import DataError
from fprf.ops import guided

UNIT = 2.0**-24


def oracle(features: Tensor, guide: Tensor, radius: int, eps: float) -> Tensor:
    """Textbook filter, one window at a time, in float64: [H W C]."""
    size = guide.shape[:2]
    p = F.interpolate(features[None].double(), size, mode="bilinear", align_corners=False)[0].permute(1, 2, 0)
    guide = guide.double()

    def windows(row: int, column: int) -> tuple[slice, slice]:
        return (
            slice(max(row - radius, 0), row + radius + 1),
            slice(max(column - radius, 0), column + radius + 1),
        )

    slope = torch.empty(*size, 3, p.shape[-1], dtype=torch.float64)
    offset = torch.empty(*size, p.shape[-1], dtype=torch.float64)
    for row in range(size[0]):
        for column in range(size[1]):
            window = windows(row, column)
            colours = guide[window].flatten(0, 1)
            values = p[window].flatten(0, 1)
            centred = colours - colours.mean(0)
            left = centred.T @ centred / len(centred) + eps * torch.eye(3, dtype=torch.float64)
            slope[row, column] = torch.linalg.solve(
                left, centred.T @ (values - values.mean(0)) / len(centred)
            )
            offset[row, column] = values.mean(0) - colours.mean(0) @ slope[row, column]
    result = torch.empty_like(p)
    for row in range(size[0]):
        for column in range(size[1]):
            window = windows(row, column)
            a = slope[window].flatten(0, 1).mean(0)
            b = offset[window].flatten(0, 1).mean(0)
            result[row, column] = guide[row, column] @ a + b
    return result


def exact(features: Tensor, guide: Tensor, radius: int, eps: float) -> Tensor:
    """The same from our coefficients, at full resolution."""
    coefs = guided.coefficients(features, guide, radius=radius, eps=eps, stride=1, fineness=math.inf)
    return torch.einsum("hwcl,hwl->hwc", coefs, torch.cat([guide, torch.ones_like(guide[..., :1])], -1))


def bound(features: Tensor, eps: float) -> float:
    """A covariance is wrong by some units of round-off of |I||p| (|I| <= 1 once centred); the ridge turns
    that into at most its 1 / (2 sqrt(eps)) per colour. Matrix products of n terms grow as sqrt(n) at most 32
    here.
    """
    spread = (features - features.mean((1, 2), keepdim=True)).abs().max().item()
    return 32 * UNIT * (features.abs().max().item() + spread * (1 + 3 / (2 * math.sqrt(eps))))


def photo(height: int, width: int, seed: int = 0) -> Tensor:
    """Smooth shading, hard edges, grain: [H W 3] in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    smooth = F.interpolate(torch.rand(1, 3, 4, 5, generator=generator), (height, width), mode="bicubic")[0]
    patches = F.interpolate(torch.rand(1, 3, 5, 6, generator=generator), (height, width), mode="nearest")[0]
    grain = 0.05 * torch.randn(3, height, width, generator=generator)
    return (0.5 * smooth + 0.5 * patches + grain).clamp(0, 1).permute(1, 2, 0).contiguous()


@pytest.mark.parametrize("eps", [1e-6, 1e-3, 1.0])
@pytest.mark.parametrize("shape", [(4, 5), (14, 19), (30, 40), (1, 1)])
def test_agrees_with_the_plain_loop(shape: tuple[int, int], eps: float) -> None:
    guide = photo(14, 19)
    features = torch.randn(3, *shape)
    found = exact(features, guide, 3, eps)
    assert (found - oracle(features, guide, 3, eps)).abs().max() <= bound(features, eps)


@settings(max_examples=25, deadline=None)
@given(
    size=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    cells=st.tuples(st.integers(1, 50), st.integers(1, 12)),
    radius=st.integers(0, 60),
    stride=st.integers(1, 50),
    fineness=st.sampled_from([1.0, 4.0, 16.0, math.inf]),
)
def test_constants_pass_whatever_the_sizes(
    size: tuple[int, int], cells: tuple[int, int], radius: int, stride: int, fineness: float
) -> None:
    guide = photo(*size)
    features = torch.tensor([3.0, -2.0]).reshape(2, 1, 1).expand(2, *cells)
    coefs = guided.coefficients(features, guide, radius=radius, eps=1e-3, stride=stride, fineness=fineness)
    assert coefs.shape == (-(-size[0] // stride), -(-size[1] // stride), 2, 4)
    assert coefs[..., :3].abs().max() <= 1e-4
    assert (coefs[..., 3] - torch.tensor([3.0, -2.0])).abs().max() <= 1e-4


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 9999), views=st.integers(1, 4), channels=st.integers(1, 11))
def test_packed_views_answer_what_each_one_says(seed: int, views: int, channels: int) -> None:
    """Against `apply` in float64 for the very halves that are stored; also at borders and in a grid of one
    cell.
    """
    draw = torch.Generator().manual_seed(seed)
    cells = torch.randint(1, 7, (views, 2), generator=draw)
    size = cells * 5 + torch.randint(0, 5, (views, 2), generator=draw)
    padded = channels + 3
    parts = [torch.randn(int(n), 4, padded, generator=draw).half() for n in cells.prod(1)]
    ends = cells.prod(1).cumsum(0)
    scale = torch.rand(views, channels, generator=draw) + 0.1
    centre = 10 * torch.randn(views, channels, generator=draw)
    packed = guided.Packed(torch.cat(parts), ends - cells.prod(1), cells, size, scale, centre)
    view = torch.randint(views, (50,), generator=draw)
    pixel = (1.4 * torch.rand(50, 2, generator=draw) - 0.2) * size[view].flip(1)
    rgb = torch.rand(50, 3, generator=draw)
    found = guided.apply_packed(packed, view, pixel, rgb, grey=0.5)
    for number, part in enumerate(parts):
        mine = view == number
        rows, columns = cells[number].tolist()
        coefs = part[..., :channels].double().transpose(1, 2).reshape(rows, columns, channels, 4)
        height, width = size[number].tolist()
        plain = guided.apply(coefs, pixel[mine], rgb[mine] - 0.5, (height, width))
        expected = plain * scale[number] + centre[number]
        # Two sums of sixteen products each, in another order, and what adding the centre rounds off.
        largest = 16 * part.abs().max() * scale[number].max() + centre[number].abs().max()
        assert (found[mine] - expected).abs().le(32 * UNIT * largest).all()


def error(features: Tensor, guide: Tensor, radius: int, stride: int) -> float:
    """RMS difference from the exact filter, half precision included, in standard deviations of its output."""
    truth = exact(features, guide, radius, 1e-3)
    coefs = guided.coefficients(features, guide, radius=radius, eps=1e-3, stride=stride).half().float()
    dense = F.interpolate(coefs.permute(3, 2, 0, 1), guide.shape[:2], mode="bilinear")
    found = ((dense[:3] * guide.permute(2, 0, 1)[:, None]).sum(0) + dense[3]).permute(1, 2, 0)
    return ((found - truth).square().mean().sqrt() / truth.flatten(0, 1).var(0).mean().sqrt()).item()


def test_cheap_is_close_to_exact() -> None:
    guide = photo(120, 160)
    assert error(torch.randn(6, 15, 20), guide, 15, 4) <= 0.02
    # White noise at twice the pixel's size is all but averaged away, so what is left to compare with is
    # small.
    assert error(torch.randn(6, 60, 80), guide, 15, 4) <= 0.03


@pytest.mark.parametrize(
    "shapes", [((2, 2), (4, 4, 3)), ((1, 2, 2), (4, 4)), ((1, 0, 2), (4, 4, 3)), ((1, 2, 2), (4, 4, 1))]
)
def test_shapes_that_do_not_fit_are_named(shapes: tuple[tuple[int, ...], tuple[int, ...]]) -> None:
    with pytest.raises(DataError, match="guided filter: features"):
        guided.coefficients(torch.zeros(shapes[0]), torch.zeros(shapes[1]), radius=1, eps=1e-3, stride=1)
