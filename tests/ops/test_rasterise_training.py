"""Training steps of the rasteriser: the photometric loss, and the gradient of a camera."""

import numpy as np
import pytest
import torch
from kornia.metrics import ssim as ssim_map
from test_rasterise import ROUGH, camera, cloud

from fprf.ops import photometric
from fprf.ops.rasterise import rendering as rasterise
from fprf.ops.rasterise.reference import rasterise_reference, view_colours
from fprf.ops.rasterise.training import TrainableGaussians, target_of
from fprf.training.camera_optimizers import rotated

WIDTH, HEIGHT = 40, 30


@pytest.mark.parametrize(("bands", "antialiased"), [(9, True), (1, False)])
def test_the_gradient_of_the_camera_is_that_of_float64(bands: int, antialiased: bool) -> None:
    """By a turn about the camera's own axes and centre, and by a shift of the centre, of the mean absolute error. Gaussians
    behind the camera add nothing. The parts of the Gaussians cancel: each errs by ROUGH of itself for each of four factors
    (tests/ops/test_rasterise.py); those of turns are as large as those of means times the distance."""
    view = camera(WIDTH, HEIGHT)
    means, quaternions, log_scales, logits, harmonics, _, background = cloud(count=60, bands=bands)
    means[:16, 2] -= 40
    beside = view.world_to_camera.clone()
    beside[:3, 3] += torch.tensor([0.15, -0.1, 0.3])
    shape = means, quaternions, log_scales, logits, harmonics
    there = view._replace(world_to_camera=beside)
    wanted = rasterise.rasterise(*shape, there, background=background, antialiased=antialiased).image.permute(2, 0, 1)
    rows = [means, log_scales, quaternions, logits[:, None], harmonics.flatten(1)]
    gaussians = TrainableGaussians(60, bands)
    gaussians.start(torch.cat(rows, 1).numpy())
    found = gaussians.learn(
        target_of(view, wanted.permute(1, 2, 0).numpy(), antialiased=antialiased),
        background=tuple(background.tolist()), ssim=0.0, rates=np.zeros(gaussians.rows, np.float32),
    )  # fmt: skip

    move = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    axes, shift = view.world_to_camera[:3, :3], view.world_to_camera[:3, 3]
    turned, centre = rotated(axes, (axes.T @ move[:3]).expand(3, 3)), -axes.T @ shift + move[3:]
    below = torch.tensor([[0.0, 0, 0, 1]], dtype=torch.float64)
    moved = view._replace(world_to_camera=torch.cat([torch.cat([turned, (-turned @ centre)[:, None]], 1), below]))
    exact = [x.double() for x in (means, quaternions, log_scales, logits)]
    exact[0].requires_grad_()
    colours = view_colours(exact[0], harmonics.double(), moved)[0]
    image, _ = rasterise_reference(*exact, colours, moved, background.double(), antialiased=antialiased)
    (image[..., :3] - wanted.permute(1, 2, 0)).abs().mean().backward()
    assert move.grad is not None and exact[0].grad is not None
    allowed = 4 * ROUGH * exact[0].grad.norm(dim=1)
    apart, distance = torch.from_numpy(found.of_camera) - move.grad, (means - centre.detach()).norm(dim=1)
    assert apart[3:].norm() < allowed.sum() < 0.05 * move.grad[3:].norm()
    assert apart[:3].norm() < (allowed * distance).sum() < 0.05 * move.grad[:3].norm()


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
