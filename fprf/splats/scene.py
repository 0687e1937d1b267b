"""What restyling needs to know of a capture, found by looking at it: views, regions, and the semantics of its Gaussians.

Views from cameras of its own are encoded as photographs are; a guided filter brings the features to their pixels, and each
Gaussian takes the mean of the pixels that it shows in, by its weights there. The *content* of such a scene is its colour, as
drawn: a style is then an affine map of colours, which acts on harmonics exactly. Statistics are those of pixels: Gaussians
themselves have less contrast (deviation 0.13 against 0.17 on a plant), since what is seen is a mix of many.
"""

import hashlib
from collections.abc import Callable
from typing import Annotated

import torch
from torch import Tensor

from ..datamanagers.basis import Basis, fit_basis
from ..datamanagers.config import GuidedConfig
from ..errors import CheckpointError, DataError
from ..interfaces import Encoder
from ..ops.guided import upsample
from ..ops.rasterise import lift
from ..rendering.cameras import Cameras
from ..style.scene import SceneStyle, region_contacts, scene_style
from ..style.scene import from_tensors as style_from
from ..style.scene import to_tensors as style_tensors
from .gaussians import Gaussians
from .look_config import LookConfig
from .views import camera_of, draw, find_views

__all__ = ["SplatScene", "cache_name", "load_scene", "look_at_capture", "scene_tensors"]

_CHANNELS = 31
"""Principal components of the semantics that are kept; with the weight they are carried back in four vectors of eight."""
_SOLID = 0.5
"""Pixels and cells less opaque than this say nothing about the scene."""
_BACKDROPS = (1.0, 0.0)
"""Greys behind a capture where it is encoded; features are the mean, so that none of them decides what a single thing is."""
_TRUST = 4.0
"""Pixels count by this power of their opacity: a soft edge would carry the backdrop's semantics."""
_SAMPLES = 65_536
"""Pixels of all views together that statistics are taken of, about."""
_COARSER = 2
"""Features, which are smooth, are filtered and carried back at the views' resolution divided by this."""
_NEIGHBOURS, _LEVELS, _REACH = 1.0, 8, 0.02
"""Pixels that the nearest neighbourhood counts for, half of it for each that is twice as wide; how many; the edge of the
nearest one, as a share of the spread of the positions."""


class SplatScene:
    """Gaussians, views of them, and what the views showed. All on the CPU."""

    def __init__(
        self,
        gaussians: Gaussians,
        antialiased: bool,
        cameras: Cameras,
        style: SceneStyle,
        basis: Basis,
        semantic: Annotated[Tensor, "N D"],
        encoder: str,
    ) -> None:
        self.gaussians, self.antialiased, self.cameras = gaussians, antialiased, cameras
        self.style, self.basis, self.semantic, self.encoder = style, basis, semantic, encoder
        self.names = tuple(f"{view:02d}" for view in range(len(cameras)))


@torch.inference_mode()
def look_at_capture(
    gaussians: Gaussians,
    antialiased: bool,
    encoder: Encoder,
    config: LookConfig,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> SplatScene:
    """Find views of Gaussians that are all finite, encode them, carry the features back, and find the regions."""
    up = torch.tensor(config.up)
    if not bool(up.isfinite().all() & (up.norm() > 0)):
        raise DataError(f"up {config.up}: no direction; give three numbers, not all 0")
    cameras = find_views(gaussians, count=config.views, size=config.size, up=up, inside=config.inside, antialiased=antialiased)
    total = 2 * len(cameras)
    pictures, cells, solid = [], [], []
    for view in range(len(cameras)):
        progress(view, total)
        drawn = draw(gaussians, camera_of(cameras, view), antialiased=antialiased)
        pictures.append((drawn.image, drawn.opacity))
        behind = (1 - drawn.opacity)[..., None]
        filled = torch.stack([drawn.image + behind * grey for grey in _BACKDROPS]).clamp(0, 1)
        maps = encoder(filled.permute(0, 3, 1, 2)).float().mean(0)
        cover = torch.nn.functional.interpolate(drawn.opacity[None, None], maps.shape[1:], mode="area")[0, 0]
        cells.append(maps)
        solid.append(maps[:, cover > _SOLID].T)
    if not any(len(each) for each in solid):
        raise DataError("nothing in the capture is opaque enough to be seen; it cannot be restyled")
    basis = fit_basis(torch.cat(solid), _CHANNELS)
    dim = basis.matrix.shape[1]
    sums, weights = torch.zeros(len(gaussians), dim), torch.zeros(len(gaussians))
    every = max(1, sum(opacity.numel() for _, opacity in pictures) // (_SAMPLES * _COARSER**2))
    samples: list[tuple[Tensor, Tensor, Tensor]] = []
    pairs: list[Tensor] = []
    for view, (maps, (image, opacity)) in enumerate(zip(cells, pictures, strict=True)):
        progress(len(cameras) + view, total)
        small = cameras.select(torch.tensor([view])).scaled(_COARSER)
        coarse = _reduced(torch.cat([image, opacity[..., None]], 2), small)
        fine = _pixel_features(basis, maps, coarse[..., :3], coarse[..., 3])
        trust = coarse[..., 3:] ** _TRUST
        parts = (gaussians.means, gaussians.quaternions, gaussians.log_scales, gaussians.logits)
        pixels = torch.cat([fine * trust, trust], 2)
        found = lift(*parts, camera_of(small, 0), pixels, antialiased=antialiased).features
        sums += found[:, :dim]
        weights += found[:, dim]
        # Colours are those of single pixels of the whole picture: averages would have less contrast.
        height, width = fine.shape[:2]
        colour, seen = (each[::_COARSER, ::_COARSER][:height, :width].flatten(0, 1) for each in (image, opacity))
        at = (seen[::every] > _SOLID).nonzero()[:, 0] * every
        samples.append(((colour[at] / seen[at, None]).clamp(0, 1), fine.flatten(0, 1)[at], seen[at]))
        # Neighbours along rows: where both are solid.
        solid_here = coarse[..., 3] > _SOLID
        pair = (solid_here[:, :-1] & solid_here[:, 1:]).flatten().nonzero()[::every, 0]
        shown = torch.cat([(coarse[..., :3] / coarse[..., 3:].clamp_min(_SOLID)).clamp(0, 1), fine], 2)
        pairs.append(torch.stack([shown[:, :-1].flatten(0, 1)[pair], shown[:, 1:].flatten(0, 1)[pair]], 1))
    progress(total, total)
    colour, semantic, seen = (torch.cat(each) for each in zip(*samples, strict=True))
    style = scene_style(colour, semantic, seen, None, config.regions, seed=0)
    ends = torch.cat(pairs)
    if len(style.share) > 1:
        style = style._replace(contacts=region_contacts(style, ends[..., 3:], ends[..., :3]))
    features = _spread(gaussians.means, sums * _COARSER**2, weights * _COARSER**2, style.semantic_mean)
    # Half precision is what a cache holds: a capture seen again must give the same colours.
    return SplatScene(gaussians, antialiased, cameras, style, basis, features.half().float(), encoder.identity)


def scene_tensors(scene: SplatScene) -> dict[str, Tensor]:
    """What was found out about the Gaussians, without themselves: for a file of tensors."""
    cameras = {name: getattr(scene.cameras, name) for name in ("pose", "focal", "centre", "size", "distortion", "lens")}
    parts = {"camera": cameras, "style": style_tensors(scene.style), "basis": scene.basis.tensors()}
    named = {f"{group}.{name}": tensor for group, tensors in parts.items() for name, tensor in tensors.items()}
    return {**named, "semantic": scene.semantic.half()}


def load_scene(tensors: dict[str, Tensor], gaussians: Gaussians, antialiased: bool, encoder: str) -> SplatScene:
    """The scene of `scene_tensors`. Raises CheckpointError where they are not those of the Gaussians."""

    def group(name: str) -> dict[str, Tensor]:
        return {key.partition(".")[2]: tensor for key, tensor in tensors.items() if key.startswith(f"{name}.")}

    semantic = tensors.get("semantic", torch.zeros(0, 0))
    try:
        cameras, basis = Cameras(**group("camera")), Basis.from_tensors(group("basis"))
    except (TypeError, DataError) as error:
        raise CheckpointError(f"what is known of a capture is incomplete ({error})") from error
    if semantic.shape != (len(gaussians), basis.matrix.shape[1]):
        raise CheckpointError(f"what is known of a capture has features {tuple(semantic.shape)}; it is of another one")
    return SplatScene(gaussians, antialiased, cameras, style_from(group("style")), basis, semantic.float(), encoder)


def cache_name(data: bytes, encoder: str, config: LookConfig) -> str:
    """A name for what is found out about a file: by its content, the encoder, and how it is looked at."""
    digest = hashlib.sha256(data)
    digest.update(f"2 {encoder} {config}".encode())
    return f"{digest.hexdigest()[:32]}.safetensors"


def _pixel_features(
    basis: Basis, maps: Annotated[Tensor, "C h w"], image: Annotated[Tensor, "H W 3"], opacity: Annotated[Tensor, "H W"]
) -> Annotated[Tensor, "H W D"]:
    """Features at pixels, by the guided filter that photographs pass."""
    guided = GuidedConfig()
    low = basis.project(maps.flatten(1).T).T.reshape(-1, *maps.shape[1:])
    filled = (image + (1 - opacity)[..., None]).clamp(0, 1)
    return upsample(low, filled, radius=round(guided.radius * min(opacity.shape)), eps=guided.eps, stride=guided.stride)


def _reduced(pixels: Annotated[Tensor, "H W C"], cameras: Cameras) -> Annotated[Tensor, "h w C"]:
    width, height = (int(v) for v in cameras.size[0])
    return torch.nn.functional.interpolate(pixels.permute(2, 0, 1)[None], (height, width), mode="area")[0].permute(1, 2, 0)


def _spread(
    points: Annotated[Tensor, "N 3"], sums: Annotated[Tensor, "N D"], mass: Annotated[Tensor, "N"], none: Annotated[Tensor, "D"]
) -> Annotated[Tensor, "N D"]:
    """Means at points, drawn to those of ever larger neighbourhoods, which decide where little was seen.

    A point far from whatever was seen takes `none`.
    """
    out, trust = sums.clone(), mass.clone()
    edge = _REACH * float(points.std()) if len(points) > 1 else 0.0
    for level in range(_LEVELS):
        box = ((points - points.amin(0)) / max(edge * 2**level, 1e-30)).clamp_max(2.0**20).long()
        _, box = torch.unique((box[:, 0] << 42) + (box[:, 1] << 21) + box[:, 2], return_inverse=True)
        total = sums.new_zeros(int(box.max()) + 1, sums.shape[1]).index_add_(0, box, sums)
        weight = sums.new_zeros(len(total)).index_add_(0, box, mass)
        share = weight.clamp_max(_NEIGHBOURS * 0.5**level) / weight.clamp_min(1e-12)
        out, trust = out + (total * share[:, None])[box], trust + (weight * share)[box]
    return torch.where(trust[:, None] > 1e-6, out / trust.clamp_min(1e-12)[:, None], none)
