"""Features of cells at pixels: against a plain float64 loop, and where the answer is known."""

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from fprf.errors import DataError
from fprf.ops.cell_regression import apply_cell_maps, cell_maps
from fprf.ops.config import GuidedConfig
from fprf.ops.guided import upsample

UNIT = 2.0**-24


def sharpened(features: Tensor, guide: Tensor, eps: float = 1e-4) -> Tensor:
    return apply_cell_maps(cell_maps(features, guide, reach=1, eps=eps), guide)


def oracle(features: Tensor, guide: Tensor, reach: int, eps: float) -> Tensor:
    """Ridge regression of one window at a time, in float64: [H W C]."""
    channels, rows, columns = features.shape
    height, width = guide.shape[:2]
    value = features.double().permute(1, 2, 0)
    colour = F.interpolate(guide.double().permute(2, 0, 1)[None], (rows, columns), mode="area")[0]
    colour = colour.permute(1, 2, 0)

    def windows(row: int, column: int) -> tuple[slice, slice]:
        return (
            slice(max(row - reach, 0), row + reach + 1),
            slice(max(column - reach, 0), column + reach + 1),
        )

    maps = torch.empty(rows, columns, 4, channels, dtype=torch.float64)
    for row in range(rows):
        for column in range(columns):
            window = windows(row, column)
            m = colour[window].flatten(0, 1)
            f = value[window].flatten(0, 1)
            centred = m - m.mean(0)
            left = centred.T @ centred / len(m) + eps * torch.eye(3, dtype=torch.float64)
            slope = torch.linalg.solve(left, centred.T @ (f - f.mean(0)) / len(m))
            maps[row, column, :3] = slope
            maps[row, column, 3] = f.mean(0) - m.mean(0) @ slope
    mean = torch.empty_like(maps)
    for row in range(rows):
        for column in range(columns):
            mean[row, column] = maps[windows(row, column)].flatten(0, 1).mean(0)
    flat = mean.flatten(2).permute(2, 0, 1)[None]
    dense = F.interpolate(flat, (height, width), mode="bilinear", align_corners=False)[0]
    a = dense.view(4, channels, height, width)
    return torch.einsum("kchw,hwk->hwc", a[:3], guide.double()) + a[3].permute(1, 2, 0)


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    size=st.sampled_from([(7, 9), (24, 31), (40, 16)]),
    cells=st.sampled_from([(1, 1), (3, 4), (5, 7)]),
    reach=st.integers(0, 2),
)
def test_it_is_the_regression_of_each_window(
    seed: int, size: tuple[int, int], cells: tuple[int, int], reach: int
) -> None:
    draw = torch.Generator().manual_seed(seed)
    guide = torch.rand(*size, 3, generator=draw)
    features = torch.randn(5, *cells, generator=draw)
    eps = 1e-2
    maps = cell_maps(features, guide, reach=reach, eps=eps)
    expected = oracle(features, guide, reach, eps)
    # Maps are kept, mixed between four cells and applied in float32: sums of 4 and of 4 numbers.
    largest = float(maps.abs().amax()) * 4
    assert float((apply_cell_maps(maps, guide).double() - expected).abs().max()) <= 16 * UNIT * largest


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), value=st.floats(-100, 100))
def test_where_features_do_not_differ_colours_change_nothing(seed: int, value: float) -> None:
    guide = torch.rand(40, 48, 3, generator=torch.Generator().manual_seed(seed))
    fine = sharpened(torch.full((2, 5, 6), value), guide)
    assert float((fine - value).abs().max()) <= 16 * UNIT * max(1.0, abs(value))


def test_what_is_affine_in_colours_is_found_at_every_pixel() -> None:
    """Cells hold means: the map that made them is found, however much finer the pixels are."""
    draw = torch.Generator().manual_seed(0)
    guide = torch.rand(48, 64, 3, generator=draw)
    matrix = torch.randn(3, 4, generator=draw)
    true = guide @ matrix + 0.7
    cells = F.interpolate(true.permute(2, 0, 1)[None], (6, 8), mode="area")[0]
    # As the ridge tends to 0; colours of cells, means of 64 pixels, have a variance of 1 / 12 / 64.
    assert float((sharpened(cells, guide, eps=1e-9) - true).abs().max()) < 1e-3


def bars(size: int = 96, period: int = 12, width: int = 3) -> tuple[Tensor, Tensor]:
    """Thin dark bars before a bright sky, above a dark ground of the bars' kind: colours, and 1 for sky."""
    x = torch.arange(size)
    sky = ((x % period) >= width)[None].expand(size, -1).clone()
    sky[2 * size // 3 :] = False
    noise = 0.03 * torch.randn(size, size, 3, generator=torch.Generator().manual_seed(0))
    bright = torch.tensor([0.75, 0.8, 0.9])
    dark = torch.tensor([0.2, 0.15, 0.1])
    return (torch.where(sky[..., None], bright, dark) + noise).clamp(0, 1), sky


def test_thin_bars_before_the_sky_are_told_from_it() -> None:
    guide, sky = bars()
    cells = F.interpolate(sky[None, None].float(), (12, 12), mode="area")[0]
    found = sharpened(cells, guide)[..., 0] > 0.5
    assert float((found == sky).float().mean()) > 0.99

    # Interpolated features, filtered by the colours of pixels, take bars for sky: what this is for.
    guided = GuidedConfig()
    blurred = upsample(cells, guide, radius=round(guided.radius * 96), eps=guided.eps)[..., 0] > 0.5
    assert float((blurred == sky).float()[:64].mean()) < 0.9
    # Far from edges both are what the encoder says.
    assert float(sharpened(cells, guide)[76:, :, 0].abs().max()) < 0.05


def test_shapes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(DataError, match="cell regression"):
        cell_maps(torch.zeros(3, 4), torch.zeros(8, 8, 3), reach=1, eps=1e-4)
    with pytest.raises(DataError, match="cell regression"):
        cell_maps(torch.zeros(2, 3, 4), torch.zeros(8, 8, 1), reach=1, eps=1e-4)
