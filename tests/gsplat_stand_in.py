"""gsplat's `rasterization` without a GPU: the parameters of it that fprf names, in plain torch, strict about
what it is given.

Every Gaussian is composited in every pixel, on any device and in any float type, with gradients by autograd.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from fprf.ops.harmonics import spherical_harmonics
from fprf.ops.rasterise import gsplat as rasterise_gsplat


class Splats(NamedTuple):
    """Gaussians of one view: half widths in pixels (0 where they are not drawn), positions, depths, inverse
    covariances (xx, xy, yy), and what the blur takes from their opacities.
    """

    radii: Tensor
    means: Tensor
    depths: Tensor
    conics: Tensor
    compensations: Tensor


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    eps2d: float,
    near: float,
) -> Splats:
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    columns = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1),
        torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], 1),
        torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1),
    ]
    axes = viewmat[:3, :3] @ (torch.stack(columns, 2) * scales[:, None])
    centres = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    depths = centres[:, 2]
    ahead = torch.where(depths > near, depths, 1.0)
    focal = K.diagonal()[:2]
    middle = K[:2, 2]
    tangents = centres[:, :2] / ahead[:, None]
    beyond = torch.stack([0.15 * width / focal[0], 0.15 * height / focal[1]])
    size = torch.stack([width - middle[0], height - middle[1]])
    near_by = tangents.maximum(-middle / focal - beyond).minimum(size / focal + beyond)
    slopes = (axes[:, :2] - near_by[:, :, None] * axes[:, 2:]) * (focal / ahead[:, None])[:, :, None]
    covariance = slopes @ slopes.transpose(1, 2)
    sharp = covariance.det()
    covariance = covariance + eps2d * torch.eye(2, dtype=means.dtype, device=means.device)
    whole = covariance[:, 0, 0] * covariance[:, 1, 1] - covariance[:, 0, 1].square()
    conics = torch.stack([covariance[:, 1, 1], -covariance[:, 0, 1], covariance[:, 0, 0]], 1) / whole[:, None]
    places = tangents * focal + middle
    radii = (3.33 * covariance.detach().diagonal(dim1=1, dim2=2).sqrt()).ceil()
    outside = (
        (places + radii <= 0) | (places - radii >= torch.stack([middle[0] + size[0], middle[1] + size[1]]))
    ).any(1)
    radii = torch.where((outside | (depths <= near))[:, None], 0.0, radii).int()
    return Splats(radii, places, depths, conics, (sharp / whole).clamp_min(1e-12).sqrt())


def harmonics(degree: int, directions: Tensor, coefficients: Tensor) -> Tensor:
    basis = spherical_harmonics(torch.nn.functional.normalize(directions, dim=-1), degree + 1)
    return (basis[..., None] * coefficients[:, : basis.shape[1]]).sum(1)


def composite(
    splats: Splats, opacities: Tensor, values: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """[H W D] and [H W], front to back."""
    order = torch.where((splats.radii > 0).all(1), splats.depths.detach(), torch.inf).argsort(stable=True)
    drawn = (splats.radii[order] > 0).all(1)[:, None, None]
    across, down = (torch.arange(size, device=values.device) + 0.5 for size in (width, height))
    dx = across - splats.means[order, 0, None, None]
    dy = down[:, None] - splats.means[order, 1, None, None]
    xx, xy, yy = (each[:, None, None] for each in splats.conics[order].unbind(1))
    alphas = opacities[order, None, None] * (-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy).exp()
    alphas = torch.where(drawn & (alphas >= 1 / 255), alphas.clamp_max(0.999), 0.0)
    passing = torch.cat([torch.ones_like(alphas[:1]), (1 - alphas).cumprod(0)])
    return torch.einsum("nhw,nd->hwd", alphas * passing[:-1], values[order]), 1 - passing[-1]


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    backgrounds: Tensor | None = None,
    render_mode: Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"] = "RGB",
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    count = len(means)
    channels = colors.shape[-1]
    given = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
    given |= {"viewmats": viewmats, "Ks": Ks} | ({} if backgrounds is None else {"backgrounds": backgrounds})
    shapes = {
        "means": (count, 3),
        "quats": (count, 4),
        "scales": (count, 3),
        "opacities": (count,),
        "Ks": (1, 3, 3),
    }
    shapes |= {"viewmats": (1, 4, 4), "backgrounds": (1, channels), "colors": (count, channels)}
    if sh_degree is not None:
        shapes["colors"] = (count, (sh_degree + 1) ** 2, 3)
    for name, tensor in given.items():
        assert tuple(tensor.shape) == shapes[name], f"{name}: {tuple(tensor.shape)}, not {shapes[name]}"
        assert (tensor.dtype, tensor.device) == (means.dtype, means.device), (
            f"{name}: {tensor.dtype} on {tensor.device}"
        )
    assert means.is_floating_point() and type(width) is type(height) is int and near_plane > 0 and not packed
    assert render_mode in ("RGB", "RGB+D") and rasterize_mode in ("classic", "antialiased")
    # Values are looked at where that is no wait of a device.
    if means.device.type == "cpu":
        assert all(bool(tensor.isfinite().all()) for tensor in given.values() if tensor is not backgrounds)
        assert bool(
            (scales > 0).all() & (opacities > 0).all() & (opacities < 1).all() & (quats.norm(dim=1) > 0).all()
        )
        assert viewmats[0, 3].tolist() == [0, 0, 0, 1] and Ks[0, 2].tolist() == [0, 0, 1]

    splats = project(means, quats, scales, viewmats[0], Ks[0], width, height, eps2d, near_plane)
    if sh_degree is not None:
        centre = -viewmats[0, :3, :3].T @ viewmats[0, :3, 3]
        colors = (harmonics(sh_degree, means - centre, colors) + 0.5).clamp_min(0)
    if render_mode == "RGB+D":
        colors = torch.cat([colors, splats.depths[:, None]], 1)
    if rasterize_mode == "antialiased":
        opacities = opacities * splats.compensations
    image, alpha = composite(splats, opacities, colors, width, height)
    if backgrounds is not None:
        behind = (
            backgrounds[0]
            if render_mode == "RGB"
            else torch.cat([backgrounds[0], torch.zeros_like(backgrounds[0, :1])])
        )
        image = image + (1 - alpha)[..., None] * behind
    return image[None], alpha[None, ..., None], {"radii": splats.radii[None]}


@contextmanager
def stand_in(drawing: Callable[..., Any] | None = None) -> Iterator[None]:
    """Within it, `import gsplat` gives a module of this `rasterization`, or of another."""
    module = ModuleType("gsplat")
    module.__spec__ = ModuleSpec("gsplat", None)
    module.rasterization = drawing or rasterization  # type: ignore[attr-defined]
    before = sys.modules.get("gsplat")
    sys.modules["gsplat"] = module
    rasterise_gsplat.obstacle.cache_clear()
    try:
        yield
    finally:
        if before is None:
            del sys.modules["gsplat"]
        else:
            sys.modules["gsplat"] = before
        rasterise_gsplat.obstacle.cache_clear()
