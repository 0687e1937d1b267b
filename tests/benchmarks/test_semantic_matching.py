import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.semantic_matching import matching_rate
from benchmarks.style_metrics import MIXED, whole_cells


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
