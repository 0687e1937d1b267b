"""The compiled loss of Gaussians against the metrics and their gradients in float64."""

import numpy as np
import pytest
import torch
from kornia.metrics import ssim as ssim_map

from fprf.ops import photometric


def planes(image: torch.Tensor) -> np.ndarray:
    height, width = image.shape[:2]
    tall, wide = -(-height // 16) * 16, -(-width // 16) * 16
    out = np.zeros(3 * tall * wide + photometric.slack(wide), np.float32)
    out[: 3 * tall * wide].reshape(3, tall, wide)[:, :height, :width] = image.permute(2, 0, 1).numpy()
    return out


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("size", [(37, 52), (11, 12), (8, 30)])
def test_loss_and_gradient_are_those_of_float64(size: tuple[int, int], share: float) -> None:
    draw = torch.Generator().manual_seed(0)
    target = torch.rand(*size, 3, generator=draw, dtype=torch.float64)
    image = (0.5 * target + 0.5 * torch.rand(*size, 3, generator=draw, dtype=torch.float64)).requires_grad_()
    similar = torch.zeros((), dtype=torch.float64)
    if min(size) >= 11:
        a, b = (x.permute(2, 0, 1)[None] for x in (image, target))
        similar = ssim_map(a, b, 11, eps=0.0, padding="valid").mean()
    apart = (image - target).abs().mean()
    ((1 - share) * apart + share * (1 - similar)).backward()
    height, width = size
    given, wanted = planes(image.detach()), planes(target)
    l1, ssim, grad = photometric.loss(given, wanted, photometric.blurred(wanted, width, height), width, height, share)
    tall, wide = -(-height // 16) * 16, -(-width // 16) * 16
    found = torch.from_numpy(grad[: 3 * tall * wide].reshape(3, tall, wide))
    inner = found[:, :height, :width].permute(1, 2, 0).double()
    assert l1 == pytest.approx(float(apart.detach()), rel=1e-5)
    # Without a share nobody asks for the similarity.
    assert ssim == pytest.approx(float(similar.detach()) if share else 0.0, abs=1e-5)
    assert image.grad is not None and (inner - image.grad).norm() <= 1e-5 * image.grad.norm()
    assert float(found.abs().sum()) == pytest.approx(float(inner.abs().sum())), "nothing beyond the image"
