"""3D Gaussians to pixels and back, and steps of training: the compiled kernels against the plain form in
float64.
"""

import math

import numba
import numpy as np
import pytest
import torch
from kornia.metrics import ssim as ssim_map
from torch import Tensor

from fprf.ops import photometric
from fprf.ops.rasterise import rendering as rasterise
from fprf.ops.rasterise.reference import rasterise_reference, view_colours
from fprf.ops.rasterise.training import TrainableGaussians, target_of
from fprf.training.camera_optimizers import rotated

ROUGH = 1.1e-4
"""Relative error of the kernels' exponential."""
STOP = 1e-3
"""Share of the light below which they go no deeper."""
Tensors = list[Tensor]


def camera(width: int = 40, height: int = 30, near: float = 0.01, k1: float = 0.0) -> rasterise.Pinhole:
    """At (-1.3, 0.2, -3.8), turned by 0.3 about y; different focal lengths, centre off the middle."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 0] = pose[2, 2] = math.cos(0.3)
    pose[0, 2], pose[2, 0] = math.sin(0.3), -math.sin(0.3)
    pose[:3, 3] = torch.tensor([0.1, -0.2, 4.0])
    intrinsics = torch.tensor(
        [[0.95 * width, 0, 0.48 * width], [0, 1.37 * height, 0.53 * height], [0, 0, 1]], dtype=torch.float64
    )
    return rasterise.Pinhole(intrinsics, pose, width, height, near, k1)


def cloud(count: int = 60, bands: int = 16, channels: int = 0, size: float = -1.5, seed: int = 0) -> Tensors:
    """Means, quaternions, log scales, logits, harmonics, features, background."""
    draw = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=draw)

    means = normal(count, 3) * torch.tensor([1.2, 0.9, 0.5])
    shape = [normal(count, 4), 0.5 * normal(count, 3) + size, normal(count), 0.3 * normal(count, bands, 3)]
    return [means, *shape, torch.rand(count, channels, generator=draw), torch.tensor([0.2, 0.5, 0.1])]


def render(given: Tensors, view: rasterise.Pinhole, antialiased: bool = False) -> rasterise.Rasterised:
    return rasterise.rasterise(
        *given[:5], view, features=given[5], background=given[6], antialiased=antialiased
    )


def exact(given: Tensors) -> Tensors:
    return [x.double() for x in given]


@pytest.mark.parametrize(
    ("bands", "channels", "antialiased", "k1"),
    [(16, 9, False, 0.0), (9, 0, True, 0.3), (4, 8, True, -0.4), (1, 1, False, 0.0)],
)
def test_images_and_gradients_are_those_of_float64(
    bands: int, channels: int, antialiased: bool, k1: float
) -> None:
    """A weight is a product over what lies before; each factor errs by at most ROUGH alpha / (1 - alpha),
    which stays below ROUGH for the alphas here, and tens of Gaussians lie on a pixel: 2 ROUGH of the largest
    value, on average; gradients have twice as many factors. A pixel of thousands may lie where one alpha is
    cut at 1/255.
    """
    given = cloud(bands=bands, channels=channels)
    view = camera(k1=k1)
    pulls = torch.Generator().manual_seed(1)
    results = []
    weights = [
        torch.randn(shape, generator=pulls) for shape in ((30, 40, 3), (30, 40), (30, 40), (30, 40, channels))
    ]
    for inputs in (given, exact(given)):
        learnt = [x.detach().clone().requires_grad_() for x in inputs]
        found = render(learnt, view, antialiased)
        torch.stack([(x * w).sum() for x, w in zip(found[:4], weights, strict=True)]).sum().backward()
        results.append((found, [x.grad for x in learnt]))
    (ours, slopes), (theirs, wanted) = results
    for a, b in zip(ours[:4], theirs[:4], strict=True):
        assert a.dtype == torch.float32 and a.shape == b.shape
        if b.numel():
            off = (a.double() - b).abs().flatten().sort(descending=True).values / b.abs().max()
            assert off[2:].max() < 2 * ROUGH and off.max() < 1 / 255
    for one, other in zip(slopes, wanted, strict=True):
        assert one is not None and other is not None and bool(torch.isfinite(one).all())
        if other.numel():
            assert (one.double() - other).norm() < 4 * ROUGH * other.norm()


@pytest.mark.parametrize("k1", [0.0, -0.3])
def test_gradients_of_the_plain_form_are_finite_differences(k1: float) -> None:
    given = exact(cloud(count=7, bands=16, channels=2, size=-0.7))
    view = camera(12, 9, k1=k1)
    # Far from the cut at 1/255: everything covers everything.
    given[2], given[3] = given[2] + 1.5, given[3].abs() + 1

    def value(*x: Tensor) -> Tensor:
        found = render(list(x), view, antialiased=True)
        return torch.cat(
            [found.image.flatten(), found.depth.flatten(), found.opacity.flatten(), found.features.flatten()]
        )

    assert torch.autograd.gradcheck(
        value, [x.requires_grad_() for x in given], eps=1e-6, atol=1e-5, rtol=1e-4, fast_mode=True
    )


def test_what_is_skipped_is_counted_and_leaves_no_more_than_promised() -> None:
    given = cloud(count=3000, bands=4, size=-1.0)
    view = camera(70, 50)
    given[3][:1500] += 3  # opaque: tiles saturate
    given[3][1500:1600] = -9.0
    given[0][1600:1700, 2] -= 20
    given[0][1700:1800, 1] += 50
    given[0][1800] = math.nan
    given[4][1801, 2, 1] = math.inf
    given[2][1802] = math.nan
    ours = render(given, view)
    theirs = render(exact(given), view)
    counts = ours.counts
    assert (
        counts["faint"] >= 100
        and counts["behind"] >= 100
        and counts["outside"] >= 100
        and counts["invalid"] == 3
    )
    assert counts["saturated"] > 0.2 * counts["entries"]
    apart = (ours.image.double() - theirs.image).abs().flatten().sort(descending=True).values
    bound = STOP * float(theirs.image.max()) + 3 * ROUGH * float(theirs.image.max())
    assert apart[len(apart) // 500 :].max() < bound and apart.max() < 1 / 255 + bound
    assert (ours.opacity - theirs.opacity).abs().max() < STOP + 3 * ROUGH


def test_lifting_is_the_transpose_of_rendering_features() -> None:
    given = cloud(count=200, bands=1, channels=11)
    view = camera(50, 37)
    pixels = torch.cat(
        [torch.randn(37, 50, 11, generator=torch.Generator().manual_seed(2)), torch.ones(37, 50, 1)], 2
    )
    ours = rasterise.lift(*given[:4], view, pixels)
    theirs = rasterise.lift(*(x.double() for x in given[:4]), view, pixels.double())
    for a, b in ((ours[:, :11], theirs[:, :11]), (ours[:, 11], theirs[:, 11])):
        assert (a.double() - b).norm() < 4 * ROUGH * b.norm()
    with torch.inference_mode():
        assert torch.equal(rasterise.lift(*(x.double() for x in given[:4]), view, pixels.double()), theirs)
    # <render(v), p> = <v, lift(p)>, and the weights of all Gaussians are all the opacity.
    found = render(given, view)
    assert float((found.features * pixels[..., :11]).sum()) == pytest.approx(
        float((given[5] * ours[:, :11]).sum()), rel=1e-3
    )
    assert float(found.opacity.sum()) == pytest.approx(float(ours[:, 11].sum()), rel=1e-4)


def test_one_gaussian_is_the_formula() -> None:
    """An isotropic one on the axis: alpha = o exp(-d^2 / 2 sigma^2), sigma^2 = (f s / z)^2 + 0.3."""
    intrinsics = torch.tensor([[50.0, 0, 16], [0, 50.0, 16], [0, 0, 1]])
    view = rasterise.Pinhole(intrinsics, torch.eye(4), 32, 32)
    given = [
        torch.tensor([[0.0, 0, 2]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), math.log(0.1)),
        torch.zeros(1),
    ]
    found = rasterise.rasterise(*given, torch.zeros(1, 1, 3), view)
    x = torch.arange(32) + 0.5 - 16
    variance = (50 * 0.1 / 2) ** 2 + 0.3
    alpha = 0.5 * torch.exp(-(x[:, None] ** 2 + x**2) / (2 * variance))
    alpha = torch.where(alpha > 1 / 255, alpha, 0)
    assert (found.opacity - alpha).abs().max() < ROUGH and (
        found.image - 0.5 * alpha[..., None]
    ).abs().max() < ROUGH
    assert (found.depth - 2 * (alpha > 0)).abs().max() < 1e-4
    smooth = rasterise.rasterise(*given, torch.zeros(1, 1, 3), view, antialiased=True)
    assert float(smooth.opacity.max() / found.opacity.max()) == pytest.approx(
        (variance - 0.3) / variance, abs=1e-3
    )


@pytest.mark.parametrize(
    "spoilt",
    [
        {0: 30.0},
        {0: torch.tensor([3e38, -3e38, 3e38])},
        {0: -camera().world_to_camera[:3, :3].T.float() @ camera().world_to_camera[:3, 3].float()},
        {1: 0.0},
        {2: -math.inf},
        {2: 80.0},
        {2: torch.tensor([9.0, -1.5, -1.5])},
        {3: math.inf},
        dict.fromkeys(range(5), math.nan),
    ],
)
def test_no_input_leaves_the_image_or_a_gradient_without_a_number(spoilt: dict[int, Tensor | float]) -> None:
    given = cloud(bands=4, channels=2)
    view = camera()
    antialiased = True
    for k, value in spoilt.items():
        given[k][: 20 + 7 * k] = value
    images = []
    for inputs in (given, exact(given)):
        learnt = [x.detach().clone().requires_grad_() for x in inputs]
        found = render(learnt, view, antialiased)
        assert all(bool(torch.isfinite(x).all()) for x in found[:4])
        torch.stack([x.sum() for x in found[:4]]).sum().backward()
        assert all(x.grad is not None and bool(torch.isfinite(x.grad).all()) for x in learnt)
        images.append(found.image.double().detach())
    # Alphas of 0.99 let factors of 1 - alpha err by 99 ROUGH.
    assert (images[0] - images[1]).abs().median() < 100 * ROUGH


def test_the_number_of_threads_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    given = cloud(count=3000, bands=4, channels=3, size=-2.5)
    view = camera(170, 90)
    found = []
    for threads in (1, 4):
        monkeypatch.setattr(numba, "get_num_threads", lambda threads=threads: threads)
        learnt = [x.detach().clone().requires_grad_() for x in given]
        seen = render(learnt, view)
        torch.stack([x.square().sum() for x in seen[:4]]).sum().backward()
        lifted = rasterise.lift(*given[:4], view, seen.features.detach())
        found.append([*seen[:4], *(x.grad for x in learnt), lifted])
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


WIDTH = 40
HEIGHT = 30


@pytest.mark.parametrize(("bands", "antialiased"), [(9, True), (1, False)])
def test_the_gradient_of_the_camera_is_that_of_float64(bands: int, antialiased: bool) -> None:
    """By a turn about the camera's own axes and centre, and by a shift of the centre, of the mean absolute
    error. Gaussians behind the camera add nothing. The parts of the Gaussians cancel: each errs by ROUGH of
    itself for each of four factors (tests/ops/test_rasterise.py); those of turns are as large as those of
    means times the distance.
    """
    view = camera(WIDTH, HEIGHT)
    means, quaternions, log_scales, logits, harmonics, _, background = cloud(count=60, bands=bands)
    means[:16, 2] -= 40
    beside = view.world_to_camera.clone()
    beside[:3, 3] += torch.tensor([0.15, -0.1, 0.3])
    shape = means, quaternions, log_scales, logits, harmonics
    there = view._replace(world_to_camera=beside)
    wanted = rasterise.rasterise(*shape, there, background=background, antialiased=antialiased).image.permute(
        2, 0, 1
    )
    rows = [means, log_scales, quaternions, logits[:, None], harmonics.flatten(1)]
    gaussians = TrainableGaussians(60, bands)
    gaussians.start(torch.cat(rows, 1).numpy())
    found = gaussians.learn(
        target_of(view, wanted.permute(1, 2, 0).numpy(), antialiased=antialiased),
        background=tuple(background.tolist()), ssim=0.0, rates=np.zeros(gaussians.rows, np.float32),
    )  # fmt: skip

    move = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    axes = view.world_to_camera[:3, :3]
    shift = view.world_to_camera[:3, 3]
    turned = rotated(axes, (axes.T @ move[:3]).expand(3, 3))
    centre = -axes.T @ shift + move[3:]
    below = torch.tensor([[0.0, 0, 0, 1]], dtype=torch.float64)
    moved = view._replace(
        world_to_camera=torch.cat([torch.cat([turned, (-turned @ centre)[:, None]], 1), below])
    )
    exact = [x.double() for x in (means, quaternions, log_scales, logits)]
    exact[0].requires_grad_()
    colours = view_colours(exact[0], harmonics.double(), moved)[0]
    image, _ = rasterise_reference(*exact, colours, moved, background.double(), antialiased=antialiased)
    (image[..., :3] - wanted.permute(1, 2, 0)).abs().mean().backward()
    assert move.grad is not None and exact[0].grad is not None
    allowed = 4 * ROUGH * exact[0].grad.norm(dim=1)
    apart = torch.from_numpy(found.of_camera) - move.grad
    distance = (means - centre.detach()).norm(dim=1)
    assert apart[3:].norm() < allowed.sum() < 0.05 * move.grad[3:].norm()
    assert apart[:3].norm() < (allowed * distance).sum() < 0.05 * move.grad[:3].norm()


def planes(image: torch.Tensor) -> np.ndarray:
    height, width = image.shape[:2]
    tall = -(-height // 16) * 16
    wide = -(-width // 16) * 16
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
    given = planes(image.detach())
    wanted = planes(target)
    l1, ssim, grad = photometric.loss(
        given, wanted, photometric.blurred(wanted, width, height), width, height, share
    )
    tall = -(-height // 16) * 16
    wide = -(-width // 16) * 16
    found = torch.from_numpy(grad[: 3 * tall * wide].reshape(3, tall, wide))
    inner = found[:, :height, :width].permute(1, 2, 0).double()
    assert l1 == pytest.approx(float(apart.detach()), rel=1e-5)
    # Without a share nobody asks for the similarity.
    assert ssim == pytest.approx(float(similar.detach()) if share else 0.0, abs=1e-5)
    assert image.grad is not None and (inner - image.grad).norm() <= 1e-5 * image.grad.norm()
    assert float(found.abs().sum()) == pytest.approx(float(inner.abs().sum())), "nothing beyond the image"
