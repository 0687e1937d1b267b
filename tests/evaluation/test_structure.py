import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.errors import DataError
from fprf.evaluation.metrics import luminance_ssim, ssim, structure


def picture(height: int = 24, width: int = 30, seed: int = 0) -> torch.Tensor:
    """Noise with edges, colours apart."""
    draw = torch.Generator().manual_seed(seed)
    noise = torch.rand(height, width, 3, generator=draw)
    noise[:, width // 2 :] *= 0.3
    return noise


def structure_oracle(a: np.ndarray, b: np.ndarray) -> float:
    """Window by window, in float64."""
    weights = np.array([0.2126, 0.7152, 0.0722])
    greys = []
    for image in (a, b):
        grey = image @ weights
        greys.append((grey - grey.mean()) / grey.std() * 0.25)
    at = np.arange(11) - 5
    window = np.outer(np.exp(-(at**2) / 4.5), np.exp(-(at**2) / 4.5))
    window /= window.sum()
    found = []
    for i in range(a.shape[0] - 10):
        for j in range(a.shape[1] - 10):
            p, q = greys[0][i : i + 11, j : j + 11], greys[1][i : i + 11, j : j + 11]
            dp, dq = p - (window * p).sum(), q - (window * q).sum()
            found.append((2 * (window * dp * dq).sum() + 9e-4) / ((window * (dp**2 + dq**2)).sum() + 9e-4))
    return float(np.mean(found))


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.integers(11, 20), st.integers(11, 20))
def test_structure_is_the_written_out_one(seed: int, height: int, width: int) -> None:
    a, b = picture(height, width, seed), picture(height, width, seed + 1)
    b = 0.5 * a + 0.5 * b
    assert structure(a, b) == pytest.approx(structure_oracle(a.double().numpy(), b.double().numpy()), abs=1e-6)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.05, 0.9), st.floats(0.0, 0.1), st.floats(0.1, 1.0))
def test_brightness_contrast_and_tint_cost_nothing(contrast: float, brightness: float, red: float) -> None:
    grey = picture()[..., :1].expand(-1, -1, 3)
    tinted = (contrast * grey + brightness) * torch.tensor([red, 1.0, 0.5])
    assert structure(grey, tinted) == pytest.approx(1.0, abs=1e-6)


def test_noise_blur_and_lost_edges_cost_in_order() -> None:
    smooth = torch.linspace(0, 1, 40)[None, :, None].expand(30, 40, 3).clone()
    smooth[:, 20:] = 1 - smooth[:, 20:]
    noise = torch.randn(30, 40, 3, generator=torch.Generator().manual_seed(0))
    levels = [structure(smooth, smooth + amount * noise) for amount in (0.0, 0.01, 0.03, 0.1)]
    assert levels == sorted(levels, reverse=True)
    assert levels[1] < 0.999
    assert levels[3] < 0.6
    sharp = picture(30, 40)
    blurred = torch.nn.functional.avg_pool2d(sharp.permute(2, 0, 1)[None], 3, 1, 1, count_include_pad=False)[0].permute(1, 2, 0)
    assert structure(sharp, blurred) < 0.9


def test_pictures_without_structure_are_alike_and_noise_is_not() -> None:
    flat, other = torch.full((16, 16, 3), 0.4), torch.full((16, 16, 3), 0.8)
    assert structure(flat, other) == 1.0
    noisy = flat + 0.05 * torch.randn(16, 16, 3, generator=torch.Generator().manual_seed(0))
    assert structure(flat, noisy) < 0.1


@pytest.mark.parametrize(("a", "b"), [((16, 16, 3), (16, 17, 3)), ((10, 30, 3), (10, 30, 3)), ((16, 16), (16, 16))])
def test_sizes_that_cannot_be_compared_are_refused(a: tuple[int, ...], b: tuple[int, ...]) -> None:
    with pytest.raises(DataError, match="structure: pictures of shape"):
        structure(torch.rand(a), torch.rand(b))


def test_luminance_ssim_sees_light_but_no_hue() -> None:
    a = picture()
    grey = (a @ torch.tensor([0.2126, 0.7152, 0.0722]))[..., None].expand(-1, -1, 3)
    assert luminance_ssim(a, grey) == pytest.approx(1.0, abs=1e-5)
    assert luminance_ssim(a, a * 0.3) < 0.8 < structure(a, a * 0.3)
    assert luminance_ssim(grey, grey * 0.5) == pytest.approx(ssim(grey, grey * 0.5), abs=1e-5)
