import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from benchmarks.semantic_matching import Triplet, class_match, matching_rate, palette_match, semantic_matching, shared_regions
from fprf.errors import DataError
from fprf.evaluation.style_distance import MIXED, whole_cells
from fprf.interfaces import Encoder


class Shades(Encoder):
    """The image itself, a cell for every `stride` pixels."""

    def __init__(self, stride: int) -> None:
        super().__init__()
        self.stride = stride

    @property
    def identity(self) -> str:
        return "shades"

    @property
    def channels(self) -> int:
        return 3

    def forward(self, image: Tensor) -> Tensor:
        return torch.nn.functional.avg_pool2d(image, self.stride)


def halves(height: int = 64, width: int = 96, at: int = 48) -> Tensor:
    regions = torch.zeros(height, width, dtype=torch.int64)
    regions[:, at:] = 1
    return regions


def painted(regions: Tensor, shades: dict[int, tuple[float, float, float]]) -> Tensor:
    image = torch.zeros(*regions.shape, 3)
    for region, shade in shades.items():
        image[regions == region] = torch.tensor(shade)
    return image


def rate_oracle(a: np.ndarray, b: np.ndarray, la: np.ndarray, lb: np.ndarray, regions: list[int]) -> float:
    """Cell by cell, in float64."""
    centre = np.concatenate([a, b]).mean(0)
    a, b = a - centre, b - centre
    hits: dict[int, list[bool]] = {r: [] for r in regions}
    for x, label in zip(a, la, strict=True):
        if label not in regions:
            continue
        best = {}
        for r in regions:
            like = sorted((x @ y / np.linalg.norm(x) / np.linalg.norm(y) for y in b[lb == r]), reverse=True)[:3]
            best[r] = sum(like) / len(like)
        hits[label].append(max(best, key=lambda r: best[r]) == label)
    return float(np.mean([np.mean(hits[r]) for r in regions]))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 4), st.integers(6, 40), st.integers(6, 40))
def test_the_rate_is_the_written_out_one(seed: int, regions: int, n: int, m: int) -> None:
    draw = np.random.default_rng(seed)
    la, lb = (np.concatenate([np.arange(regions), draw.integers(-1, regions, k - regions)]) for k in (n, m))
    a, b = (draw.normal(size=(len(labels), 5)) + labels[:, None] for labels in (la, lb))
    tensors = [torch.from_numpy(x) for x in (a, b, la, lb)]
    found = matching_rate(*tensors, list(range(regions)))
    assert found == pytest.approx(rate_oracle(a, b, la, lb, list(range(regions))), abs=1e-12)


def test_the_rate_ignores_scale_and_common_offset() -> None:
    draw = torch.Generator().manual_seed(0)
    a, b = torch.randn(30, 8, generator=draw).double(), torch.randn(40, 8, generator=draw).double()
    la, lb = torch.arange(30) % 3, torch.arange(40) % 3
    plain = matching_rate(a, b, la, lb, [0, 1, 2])
    assert matching_rate(7 * a + 2, 7 * b + 2, la, lb, [0, 1, 2]) == plain


def test_a_region_without_cells_is_named() -> None:
    with pytest.raises(DataError, match="region 4"):
        matching_rate(torch.ones(2, 2), torch.ones(2, 2), torch.tensor([0, 4]), torch.tensor([0, 0]), [0, 4])


def test_cells_are_whole_or_mixed() -> None:
    regions = halves(8, 12, at=5)
    assert whole_cells(regions, (4, 6)).tolist() == [[0, 0, MIXED, 1, 1, 1]] * 4
    assert whole_cells(regions, (8, 12)).equal(regions)
    assert whole_cells(regions, (1, 1)).tolist() == [[MIXED]]


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.integers(3, 20), st.integers(3, 20), st.integers(1, 3), st.integers(1, 3))
def test_a_whole_cell_holds_nothing_else(seed: int, height: int, width: int, h: int, w: int) -> None:
    regions = torch.from_numpy(np.random.default_rng(seed).integers(0, 2, (height, width)))
    cells = whole_cells(regions, (h, w))
    for i in range(h):
        for j in range(w):
            rows = slice(i * height // h, math.ceil((i + 1) * height / h))
            columns = slice(j * width // w, math.ceil((j + 1) * width / w))
            kinds = regions[rows, columns].unique()
            assert int(cells[i, j]) == (int(kinds[0]) if len(kinds) == 1 else MIXED)


def test_colours_that_tell_the_parts_match_and_swapped_ones_do_not() -> None:
    regions = halves()
    shades = {0: (0.9, 0.2, 0.1), 1: (0.1, 0.2, 0.9)}
    image = painted(regions, shades)
    alike = Triplet("alike", image, image * 0.7 + 0.1, regions, regions)
    swapped = Triplet("swapped", image, image, regions, 1 - regions)
    single = Triplet("single", image, image, torch.zeros_like(regions), torch.zeros_like(regions))
    found = semantic_matching(Shades(8), [alike, swapped, single])
    assert found["per_triplet"] == {"alike": 1.0, "swapped": 0.0}
    assert (found["triplets"], found["matching"], found["chance"]) == (2, 0.5, 0.5)
    with pytest.raises(DataError, match="nothing to tell apart"):
        semantic_matching(Shades(8), [single])


def test_a_fine_encoder_is_averaged_to_eight_pixels() -> None:
    regions = halves()
    noise = torch.rand(64, 96, 3, generator=torch.Generator().manual_seed(1))
    image = painted(regions, {0: (0.8, 0.5, 0.5), 1: (0.5, 0.5, 0.8)}) * 0.3 + noise
    triplet = Triplet("one", image, image.flip(0), regions, regions)
    assert semantic_matching(Shades(1), [triplet])["matching"] == semantic_matching(Shades(8), [triplet])["matching"]


def test_slivers_are_no_shared_regions() -> None:
    regions = halves()
    thin = regions.clone()
    thin[:, :3] = 8
    image = torch.rand(64, 96, 3)
    assert shared_regions(Triplet("thin", image, image, thin, thin)) == [0, 1]
    gone = torch.where(regions == 1, 5, regions)
    assert shared_regions(Triplet("gone", image, image, regions, gone)) == [0]


def test_classes_are_found_in_another_light() -> None:
    draw = torch.Generator().manual_seed(2)
    labels = torch.arange(60) % 3
    day = torch.randn(60, 6, generator=draw) * 0.1 + torch.eye(3, 6)[labels]
    night = day * 0.5 + 9  # a common offset and a contrast decide nothing
    assert class_match(night, labels, day, labels) == (1.0, {0: 1.0, 1: 1.0, 2: 1.0})
    turned = (labels + 1) % 3
    assert class_match(night, turned, day, labels)[0] == 0.0


def test_mixed_cells_and_unknown_classes_do_not_count() -> None:
    features = torch.eye(4)[[0, 1, 2, 3]]
    known_labels, labels = torch.tensor([0, 1, MIXED, MIXED]), torch.tensor([0, 1, MIXED, 7])
    share, kinds = class_match(features, labels, features, known_labels)
    assert (share, kinds) == (1.0, {0: 1.0, 1: 1.0})
    with pytest.raises(DataError, match="no cell of a class"):
        class_match(features, torch.full((4,), 9), features, known_labels)


def test_palettes_are_averaged_without_the_known_one() -> None:
    labels = torch.tensor([0, 0, 1, 1])
    day = torch.tensor([[1.0, 0.0], [1.0, 0.1], [0.0, 1.0], [0.1, 1.0]])
    found = palette_match({"day": (day, labels), "night": (day, labels), "odd": (day.flip(0), labels)}, "day")
    assert found == {"match": 0.5, "class_mean": 0.5, "itself": 1.0, "per_palette": {"night": 1.0, "odd": 0.0}}
    with pytest.raises(DataError, match="only palette"):
        palette_match({"day": (day, labels)}, "day")
