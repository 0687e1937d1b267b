import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.errors import DataError, NumericsError
from fprf.evaluation.metrics import PSNR_CAP, image_metrics, psnr, ssim


def noise(height: int, width: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))


def ssim_oracle(a: np.ndarray, b: np.ndarray) -> float:
    """Wang et al. 2004 in float64, window by window."""
    x = np.arange(11) - 5
    g = np.exp(-(x**2) / (2 * 1.5**2))
    window = np.outer(g, g)[..., None] / g.sum() ** 2
    found = []
    for i in range(a.shape[0] - 10):
        for j in range(a.shape[1] - 10):
            p, q = a[i : i + 11, j : j + 11], b[i : i + 11, j : j + 11]
            mp, mq = (window * p).sum((0, 1)), (window * q).sum((0, 1))
            vp, vq = (window * (p - mp) ** 2).sum((0, 1)), (window * (q - mq) ** 2).sum((0, 1))
            cov = (window * (p - mp) * (q - mq)).sum((0, 1))
            top = (2 * mp * mq + 1e-4) * (2 * cov + 9e-4)
            found.append(top / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4)))
    return float(np.mean(found))


@settings(max_examples=30, deadline=None)
@given(st.floats(1e-4, 0.9), st.integers(1, 9), st.integers(1, 9))
def test_psnr_of_a_constant_offset(offset: float, height: int, width: int) -> None:
    image = torch.full((height, width, 3), 0.05, dtype=torch.float64)
    assert psnr(image, image + offset) == pytest.approx(-20 * math.log10(offset), abs=1e-6)


def test_psnr_of_identical_images_is_the_cap_and_nothing_is_above() -> None:
    image = noise(8, 8).double()
    assert psnr(image, image) == PSNR_CAP == psnr(image, image + 1e-9)
    assert psnr(image, image + 2e-5) < PSNR_CAP
    assert psnr(torch.zeros(2, 2, 3), torch.ones(2, 2, 3)) == 0.0


def test_metrics_are_symmetric_and_take_mixed_dtypes() -> None:
    a, b = noise(20, 24), noise(20, 24, 1)
    for metric in (psnr, ssim):
        assert metric(a, b) == pytest.approx(metric(b, a), abs=1e-6)
        assert metric(a, b.double()) == pytest.approx(metric(a, b), abs=1e-5)
        assert metric(a.half(), b) == pytest.approx(metric(a, b), abs=1e-2)
        assert isinstance(metric(a.requires_grad_(), b), float)


def test_ssim_agrees_with_the_definition() -> None:
    a = noise(17, 19)
    for b in (noise(17, 19, 1), (0.7 * a + 0.3 * noise(17, 19, 2)), a * 0.8, 1 - a):
        assert ssim(a, b) == pytest.approx(ssim_oracle(a.double().numpy(), b.double().numpy()), abs=1e-5)


@settings(max_examples=20, deadline=None)
@given(st.floats(0, 1), st.floats(0, 1))
def test_ssim_of_flat_images_is_the_luminance_term(a: float, b: float) -> None:
    first, second = (torch.full((12, 13, 3), value, dtype=torch.float64) for value in (a, b))
    assert ssim(first, second) == pytest.approx((2 * a * b + 1e-4) / (a * a + b * b + 1e-4), abs=1e-6)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_is_not_finite_is_no_score(value: float) -> None:
    broken = noise(12, 12)
    broken[5, 5, 1] = value
    for metric in (psnr, ssim):
        with pytest.raises(NumericsError, match="not finite"):
            metric(broken, noise(12, 12))


@pytest.mark.parametrize("shape", [(4, 5, 3), (5, 4, 4), (4, 5), (0, 5, 3)])
def test_unlike_shapes_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(DataError, match="cannot be compared"):
        psnr(torch.zeros(shape), torch.zeros(5, 4, 3))


def test_what_a_mask_leaves_out_does_not_count() -> None:
    """Any change there leaves PSNR as it is, and SSIM but for windows that reach into it: those see the same in both images."""
    draw = torch.Generator().manual_seed(0)
    truth, where = torch.rand(40, 30, 3, generator=draw), torch.zeros(40, 30, dtype=torch.bool)
    where[:, :20] = True
    render = (truth + 0.1 * torch.randn(40, 30, 3, generator=draw)).clamp(0, 1)
    spoilt = torch.where(where[..., None], render, torch.rand(40, 30, 3, generator=draw))
    assert image_metrics(render, truth, where) == image_metrics(spoilt, truth, where)
    assert image_metrics(render, truth, where)["psnr"] == pytest.approx(psnr(render[:, :20], truth[:, :20]))
    assert image_metrics(render, truth, torch.ones_like(where)) == pytest.approx(image_metrics(render, truth))
    with pytest.raises(DataError, match="leaves nothing"):
        image_metrics(render, truth, torch.zeros_like(where))
