"""What gsplat draws, and what is learnt through it: against the float64 reference and the trainer of the CPU.

Through the stand-in of `gsplat_stand_in`; where gsplat is installed through its own torch code, which needs
no GPU and defines what its kernels compute; and with `pytest -m gpu` through these themselves.
"""

import inspect
import sys
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

import gsplat_stand_in
import numpy as np
import pytest
import torch
from gsplat_stand_in import stand_in
from pretend_cuda import CUDA, pretend_cuda
from test_rasterise import ROUGH, STOP, Tensors, camera, cloud, exact
from torch import Tensor

from fprf.ops import backend, photometric
from fprf.ops.rasterise import gsplat as rasterise_gsplat
from fprf.ops.rasterise import rendering as rasterise
from fprf.ops.rasterise.gsplat import GsplatGaussians, photometric_loss, target_on
from fprf.ops.rasterise.training import Target, TrainableGaussians, target_of

CPU = torch.device("cpu")


def without_kernels(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """gsplat's own `rasterization` on its torch code: projection, harmonics, and alphas with their sums. Of
    kernels that have no such form, the lists of tiles are left out and all pairs of Gaussians and pixels are
    composited; two functions of nerfacc that gsplat's torch code asks for, products and sums along a ray, are
    given here.
    """
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    from gsplat import rendering
    from gsplat.cuda import _torch_impl as own

    drawn: list[Tensor] = []
    depths: list[Tensor] = []

    def project(means: Tensor, covars: None, quats: Tensor, scales: Tensor, *where: Any, **how: Any) -> Any:
        covariances, _ = own._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
        known = {
            name: how[name]
            for name in ("eps2d", "near_plane", "far_plane", "calc_compensations", "camera_model")
        }
        radii, *found = own._fully_fused_projection(means, covariances, *where, **known)
        drawn[:] = [(radii[0] > 0).all(1)]
        return radii, *found[:3], found[3] if how["calc_compensations"] else None

    def composite(
        means: Tensor,
        conics: Tensor,
        colors: Tensor,
        opacities: Tensor,
        width: int,
        height: int,
        *tiles: Any,
        **how: Any,
    ) -> tuple[Tensor, Tensor]:
        # All pairs, pixel by pixel and front to back; where the kernel makes none of a pair, its opacity is
        # 0.
        order = depths[0].argsort(stable=True)
        pixels = torch.arange(width * height).repeat_interleave(len(order))
        which = order.repeat(width * height)
        apart = torch.stack([pixels % width, pixels // width], 1) + 0.5 - means[0, which].detach()
        xx, xy, yy = conics[0, which].detach().unbind(1)
        shape = (
            -0.5 * (xx * apart[:, 0] ** 2 + yy * apart[:, 1] ** 2) - xy * apart[:, 0] * apart[:, 1]
        ).exp()
        visible = drawn[0][which] & (opacities[0, which] * shape >= 1 / 255)
        # One entry a pair: a Gaussian of that pixel alone.
        image, alpha = own.accumulate(
            means[:, which], conics[:, which], torch.where(visible, opacities[:, which], 0.0), colors[:, which],
            torch.arange(len(which)), pixels, torch.zeros_like(pixels), width, height,
        )  # fmt: skip
        return image + (1 - alpha) * how["backgrounds"][:, None, None], alpha

    def tiles(
        means: Tensor, radii: Tensor, depth: Tensor, *sizes: Any, **how: Any
    ) -> tuple[None, None, None]:
        depths[:] = [depth[0].detach()]
        return None, None, None

    def weights(alphas: Tensor, *, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
        by_ray = alphas.view(n_rays, -1)
        passing = torch.cat([torch.ones_like(by_ray[:, :1]), (1 - by_ray).cumprod(1)[:, :-1]], 1)
        return (by_ray * passing).flatten(), passing.flatten()

    def along(weights: Tensor, values: Tensor | None, *, ray_indices: Tensor, n_rays: int) -> Tensor:
        by_ray = weights.view(n_rays, -1, 1)
        return (by_ray if values is None else by_ray * values.view(n_rays, -1, values.shape[-1])).sum(1)

    nerfacc = ModuleType("nerfacc")
    nerfacc.render_weight_from_alpha = weights  # type: ignore[attr-defined]
    nerfacc.accumulate_along_rays = along  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "nerfacc", nerfacc)
    monkeypatch.setattr(rendering, "fully_fused_projection", project)
    monkeypatch.setattr(rendering, "spherical_harmonics", lambda *of, masks: own._spherical_harmonics(*of))
    monkeypatch.setattr(rendering, "isect_tiles", tiles)
    monkeypatch.setattr(
        rendering, "isect_offset_encode", lambda ids, images, wide, tall: torch.zeros(images, tall, wide)
    )
    monkeypatch.setattr(rendering, "rasterize_to_pixels", composite)
    return rendering.rasterization


@pytest.fixture(params=["stand-in", "gsplat's torch code", pytest.param("card", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[torch.device]:
    """Where gsplat draws."""
    if request.param != "card":
        with stand_in(
            gsplat_stand_in.rasterization if request.param == "stand-in" else without_kernels(monkeypatch)
        ):
            yield CPU
    elif torch.cuda.is_available():
        assert rasterise_gsplat.obstacle(CUDA) is None
        yield CUDA
    else:
        pytest.skip("torch sees no CUDA device")


def test_the_stand_in_has_the_signature_of_gsplat() -> None:
    gsplat = pytest.importorskip("gsplat", reason="gsplat is not installed")
    real = inspect.signature(gsplat.rasterization).parameters
    for name, own in inspect.signature(gsplat_stand_in.rasterization).parameters.items():
        assert (real[name].default, real[name].kind) == (own.default, own.kind), name


@pytest.mark.parametrize(("channels", "antialiased"), [(3, False), (3, True), (9, True)])
def test_images_and_gradients_are_those_of_the_reference(
    device: torch.device, channels: int, antialiased: bool
) -> None:
    """In float64 where that is possible. The references differ in 1e-8 below a root, of a ratio above 0.1
    here: 5e-8 of an opacity. On a card exponentials are approximate, as those of the CPU's kernels are.
    """
    means, quaternions, log_scales, logits, *_ = exact(cloud(size=-1.0))
    view = camera(20, 15)
    draw = torch.Generator().manual_seed(1)
    values, background = (torch.rand(*shape, channels, generator=draw).double() for shape in ((60,), ()))
    pull, of_passing = (torch.randn(15, 20, *more, generator=draw).double() for more in ((channels + 1,), ()))
    results = []
    for form in (rasterise_gsplat.rasterise_gsplat, rasterise.rasterise_reference):
        at = (device, torch.float32) if device == CUDA and not results else (CPU, torch.float64)
        inputs = (means, quaternions, log_scales, logits, values, background)
        learnt = [x.detach().to(*at).requires_grad_() for x in inputs]
        image, passing = form(*learnt[:5], view, learnt[5], antialiased=antialiased)
        found = torch.autograd.grad(
            (image * pull.to(*at)).sum() + (passing * of_passing.to(*at)).sum(), learnt
        )
        results.append([x.to(CPU, torch.float64) for x in (image, passing, *found)])
    for ours, theirs in zip(*results, strict=True):
        assert (ours - theirs).norm() < (1e-6 if device == CPU else 4 * ROUGH) * theirs.norm()


def test_what_is_not_finite_is_not_drawn(device: torch.device) -> None:
    spoilt = [x.to(device) for x in cloud(count=40)]
    view = camera(20, 15)
    for part, places in zip(
        spoilt[:5], (slice(0, 3), slice(2, 6), slice(5, 8), slice(7, 9), slice(9, 12)), strict=True
    ):
        part[places] = torch.nan
    spoilt[0][12], spoilt[1][13] = torch.inf, 0  # and a quaternion without length, which turns nothing
    means, quaternions, log_scales, logits, harmonics, _, background = spoilt
    learnt = [
        x.requires_grad_()
        for x in (means, quaternions, log_scales, logits, torch.nan_to_num(harmonics[:, 0]))
    ]
    rest = [x.detach()[13:].clone() for x in learnt]
    rest[1][0, 0] = 1
    learnt[4].detach()[9:12] = torch.nan
    image, passing = rasterise_gsplat.rasterise_gsplat(*learnt, view, background, antialiased=True)
    wanted, left = rasterise_gsplat.rasterise_gsplat(*rest, view, background, antialiased=True)
    torch.testing.assert_close((image, passing), (wanted, left))
    slopes = torch.autograd.grad(image.sum(), learnt)
    assert all(bool(each.isfinite().all()) for each in slopes)


@pytest.mark.parametrize("size", [(40, 30), (9, 30)])
def test_the_loss_is_that_of_the_kernels(size: tuple[int, int]) -> None:
    width, height = size
    draw = torch.Generator().manual_seed(2)
    target = torch.rand(height, width, 3, generator=draw)
    shown = (target + 0.2 * torch.rand(height, width, 3, generator=draw)).permute(2, 0, 1)
    planes = [
        target_of(camera(width, height), each.contiguous().numpy())
        for each in (shown.permute(1, 2, 0), target)
    ]
    l1, similar, slope = photometric.loss(
        planes[0].planes, planes[1].planes, planes[1].blurred, width, height, 0.2
    )
    tall = -(-height // 16) * 16
    wide = -(-width // 16) * 16
    wanted = torch.from_numpy(slope[: 3 * tall * wide]).view(3, tall, wide)[:, :height, :width]
    found = photometric_loss(shown, target.permute(2, 0, 1), 0.2)
    # Both subtract squares of means of colours from means of squares: float32's rounding over a constant of
    # 9e-4.
    assert float(found[0]) == pytest.approx(l1, rel=1e-5) and float(found[1]) == pytest.approx(
        similar, abs=1e-4
    )
    assert (found[2] - wanted).norm() < 1e-3 * wanted.norm()


def both(
    bands: int, antialiased: bool = True, device: torch.device = CPU
) -> tuple[Target, Target, TrainableGaussians, GsplatGaussians]:
    """A photograph with a mask and sky for the CPU's kernels and on a device, and the same Gaussians for
    either.
    """
    view = camera()
    draw = np.random.default_rng(0)
    means, quaternions, log_scales, logits, harmonics, _, _ = cloud(bands=bands, size=-1.0)
    rows = torch.cat([means, log_scales, quaternions, logits[:, None], harmonics.flatten(1)], 1).numpy()
    colours = draw.random((30, 40, 3), np.float32)
    x, y = np.meshgrid(np.arange(40), np.arange(30))
    given = view, colours, x > 5, y < 9
    targets = target_of(*given, antialiased=antialiased), target_on(device, *given, antialiased=antialiased)
    weight = draw.random(len(rows), np.float32)
    pair = TrainableGaussians(64, bands), GsplatGaussians(64, bands, device)
    for each in pair:
        each.start(rows, weight=weight)
    return *targets, *pair


@pytest.mark.parametrize(
    ("bands", "antialiased", "factors"), [(9, True, (1.2, 0.9, 0.7)), (1, False, None), (16, True, None)]
)
def test_a_step_is_that_of_the_cpu(
    device: torch.device, bands: int, antialiased: bool, factors: tuple[float, float, float] | None
) -> None:
    """Moments hold the gradients: 4 ROUGH, and 8 ROUGH of their squares (tests/ops/test_rasterise.py). A step
    of Adam is the gradient by its own size, so that what is nearly 0 may go either way.
    """
    target, there, ours, theirs = both(bands, antialiased, device)
    rates = np.full(ours.rows, 1e-3, np.float32)
    exposure = None if factors is None else np.array(factors, np.float32)
    kept = {"background": (0.2, 0.5, 0.1), "ssim": 0.2, "rates": rates, "factors": exposure}
    before = ours.read()
    wanted = ours.learn(target, **kept)
    found = theirs.learn(there, **kept)
    assert found[:3] == pytest.approx(wanted[:3], rel=STOP)
    for a, b in ((found.pull, wanted.pull), (found.of_camera, wanted.of_camera)):
        assert np.linalg.norm(a - b) <= 4 * ROUGH * np.linalg.norm(b)
    for a, b in zip(theirs.moments(), ours.moments(), strict=True):
        assert np.linalg.norm(a - b) <= 8 * ROUGH * np.linalg.norm(b)
    moved = theirs.read() - before
    way = ours.read() - before
    assert np.linalg.norm(moved - way) < 0.02 * np.linalg.norm(way) and np.linalg.norm(way) > 0
    a, b = (each.errors(target, (0.2, 0.5, 0.1), exposure) for each in (theirs, ours))
    assert a.shape == b.shape and (np.linalg.norm(a - b, axis=0) < STOP * np.linalg.norm(b, axis=0)).all()


def test_all_else_is_bit_for_bit_that_of_the_cpu() -> None:
    *_, ours, theirs = both(4)
    draw = np.random.default_rng(1)
    some = np.array([5, 17, 3])
    moments = draw.normal(size=(2, *ours.read().shape)).astype(np.float32)
    for each in (ours, theirs):
        each.start(each.read(), *moments, draw.random(60, np.float32) if each is ours else ours.moments()[2])
    order, one, other = draw.permutation(62), *draw.normal(size=(2, 3, ours.rows)).astype(np.float32)
    for each in (ours, theirs):
        each.limit_scales(np.full(60, -1.1, np.float32), np.arange(60))
        each.limit_scales(np.array([-1.5, -1.2, -3], np.float32), some)
        each.multiply(slice(14, None), 0.7)
        each.split(some, np.array([8, 60, 61]), one, other)
        each.reorder(order)
    assert ours.count == theirs.count == 62
    for a, b in zip(
        (*ours.moments(), ours.read(), ours.read(slice(3, 6), some)),
        (*theirs.moments(), theirs.read(), theirs.read(slice(3, 6), some)),
        strict=True,
    ):
        assert np.array_equal(a, b)


def test_a_photograph_without_numbers_moves_nothing(device: torch.device) -> None:
    target, _, _, gaussians = both(4, device=device)
    target.planes[:] = np.nan
    before = gaussians.read(), *gaussians.moments()
    found = gaussians.learn(target, background=(0, 0, 0), ssim=0.2, rates=np.ones(gaussians.rows, np.float32))
    assert not np.isfinite(found.l1) and not found.of_camera.any()
    for a, b in zip(before, (gaussians.read(), *gaussians.moments()), strict=True):
        assert np.array_equal(a, b)


def device_views(given: Tensors, view: rasterise.Pinhole) -> Iterator[Tensor]:
    """Everything that `rasterise` and `lift` give for Gaussians with features."""
    there = [x.to("cuda:0") for x in given]
    yield from rasterise.rasterise(
        *there[:5], view, features=there[5], background=there[6], antialiased=True
    )[:4]
    yield rasterise.lift(*there[:4], view, torch.ones(30, 40, 2, device="cuda:0"), antialiased=True)


def test_the_device_is_drawn_by_gsplat_where_it_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    given = cloud(channels=5)
    view = camera()
    calls: list[str] = []

    def counted(**arguments: Any) -> Any:
        calls.append(arguments["render_mode"])
        return plain(**arguments)

    plain = gsplat_stand_in.rasterization
    monkeypatch.setattr(gsplat_stand_in, "rasterization", counted)
    with pretend_cuda():
        with stand_in():
            drawn = [x.cpu() for x in device_views(given, view)]
            assert rasterise_gsplat.obstacle(CUDA) is None and len(calls) == 3
            with backend.plain():
                wanted = [x.cpu() for x in device_views(given, view)]
        assert len(calls) == 3
    for a, b in zip(drawn, wanted, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


def test_what_keeps_gsplat_from_drawing_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(**arguments: Any) -> Any:
        raise AttributeError("no kernels\n were compiled")

    monkeypatch.setattr(gsplat_stand_in, "rasterization", broken)
    with pretend_cuda(), stand_in():
        device = CUDA
        assert rasterise_gsplat.obstacle(device) == "gsplat does not work here: no kernels were compiled"
        assert not rasterise_gsplat.usable(device) and not rasterise_gsplat.usable(CPU)
        assert isinstance(rasterise_gsplat.trainable(16, 4, device), TrainableGaussians)
