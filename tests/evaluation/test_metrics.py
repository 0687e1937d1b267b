"""Scores of pictures against their definitions."""

import pytest
import torch
from ssim_oracle import noise, ssim_oracle

from fprf.errors import DataError, NumericsError
from fprf.evaluation.metrics import PSNR_CAP, image_metrics, psnr, ssim


def test_psnr_of_identical_images_is_the_cap_and_nothing_is_above() -> None:
    image = noise(8, 8).double()
    assert psnr(image, image) == PSNR_CAP == psnr(image, image + 1e-9)
    assert psnr(image, image + 2e-5) < PSNR_CAP
    assert psnr(torch.zeros(2, 2, 3), torch.ones(2, 2, 3)) == 0.0


def test_ssim_agrees_with_the_definition() -> None:
    a = noise(17, 19)
    for b in (noise(17, 19, 1), (0.7 * a + 0.3 * noise(17, 19, 2)), a * 0.8, 1 - a):
        assert ssim(a, b) == pytest.approx(ssim_oracle(a.double().numpy(), b.double().numpy()), abs=1e-5)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_is_not_finite_is_no_score(value: float) -> None:
    broken = noise(12, 12)
    broken[5, 5, 1] = value
    for metric in (psnr, ssim):
        with pytest.raises(NumericsError, match="not finite"):
            metric(broken, noise(12, 12))


@pytest.mark.parametrize("shape", [(14, 15, 3), (15, 14, 4), (14, 15), (0, 14, 3)])
def test_unlike_shapes_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(DataError):
        psnr(torch.zeros(shape), torch.zeros(15, 14, 3))


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
