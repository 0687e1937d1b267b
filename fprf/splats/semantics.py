"""Semantics of Gaussians, found by looking at them: features of rendered views, carried back to what they
show.

Views are encoded as photographs are; colours bring the features of cells to their pixels (`cell_regression`),
and each Gaussian takes the mean of the pixels that it shows in, by its weights there. The *content* of such a scene is its
colour, as drawn: a style is then an affine map of colours, which acts on harmonics exactly. Statistics are
those of pixels: Gaussians themselves have less contrast (deviation 0.13 against 0.17 on a plant), since what
is seen is a mix of many.

Shapes: N Gaussians, V views of H W pixels and h w cells of the encoder's, C channels of the encoder, D
principal components of them that are kept, K regions. Layers are channels last; colours in [0, 1].
"""

import contextvars
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields
from typing import Annotated, NamedTuple, TypeVar

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from ..datamanagers.basis import Basis, fit_basis
from ..errors import CheckpointError, DataError
from ..interfaces import Encoder
from ..ops.backend import compiled
from ..ops.cell_regression import apply_cell_maps, cell_maps
from ..ops.rasterise.rendering import lift
from ..rendering.cameras import Cameras
from ..style.placing import Keypoints, keypoint_tensors, keypoints_from, view_keypoints
from ..style.scene_style import SceneStyle, region_contacts, scene_style
from ..style.scene_style import from_tensors as style_from
from ..style.scene_style import to_tensors as style_tensors
from .drawing import draw
from .gaussians import MAX_BULK_DISTANCE, Gaussians, bulk_of, cells_of
from .levels import seen_by
from .pinholes import camera_of

SEMANTICS_VERSION = 2
"""Of how semantics are found: it counts up whenever the same Gaussians and views give others."""
_SEMANTIC_COMPONENTS = 31
"""Principal components of the semantics that are kept; with the weight they are carried back in four vectors
of eight.
"""
_MIN_VIEW_OPACITY = 0.5
"""Pixels and cells less opaque than this say nothing about the scene; by eye."""
_TRUST_POWER = 4.0
"""Pixels count by this power of their opacity: a soft edge would carry the backdrop's semantics; by eye."""
_STATISTICS_PIXELS = 65_536
"""Pixels of all views together that statistics are taken of, about; by eye."""
_WINDOW_REACH = 1
"""Cells of the encoder beside one whose colours explain its features: with 2 fewer pixels at borders match
right."""
_MIN_CELL_VARIANCE = 1e-5
"""Variance of the colours of cells, below which they hardly explain features: a 300th of a channel's range.
With ten times as much fewer pixels at borders match right, with a tenth of it no more."""
_SPREAD_COMPONENTS = 8
"""Components of the features that are spread at a time: of all Gaussians there are copies of so many."""
_NEIGHBOURHOOD_PIXELS = 1.0
"""Pixels that the nearest neighbourhood counts for, and half as many each that is twice as wide; by eye."""
_NEIGHBOURHOODS = 8
"""Neighbourhoods of a Gaussian, each twice as wide as the one before; by eye."""
_NEIGHBOURHOOD_EDGE_SHARE = 0.02
"""Edge of the nearest one, as a share of the spread of the positions; by eye."""
_MAX_VIEWS_AT_ONCE = 4
"""Views that are looked at at the same time, at most: each takes the memory of what it draws."""
_Result = TypeVar("_Result")


class SeenViews(NamedTuple):
    """Views that semantics were gathered from, and their keypoints."""

    cameras: Cameras
    keypoints: tuple[Keypoints, ...]


class Semantics(NamedTuple):
    """Semantics of N Gaussians, gathered from views."""

    style: SceneStyle
    basis: Basis
    features: Annotated[Tensor, "N D"]
    """Half precision."""
    encoder: str
    """Identity of the encoder."""
    seen: SeenViews | None = None
    """Tell photographs of the very place; None in what an earlier version found."""


class _Picture(NamedTuple):
    """A view as drawn, and what the encoder makes of it."""

    image: Annotated[Tensor, "H W 3"]
    """Colours times opacity."""
    opacity: Annotated[Tensor, "H W"]
    maps: Annotated[Tensor, "C h w"]
    keypoints: Keypoints


@torch.inference_mode()
def find_semantics(
    gaussians: Gaussians,
    antialiased: bool,
    encoder: Encoder,
    cameras: Cameras,
    regions: int,
    *,
    near: float,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Semantics:
    """Encode views of Gaussians, carry the features back, and find the regions. Lenses are left out.

    Raises DataError where nothing is opaque enough to be seen.
    """
    count = len(cameras)
    total = 2 * len(cameras)

    # 1. Draw the views and encode them; the encoder leaves out what is transparent.
    def encoded(view: int) -> _Picture:
        camera = camera_of(cameras, view, near)
        drawn = draw(gaussians.select(seen_by(gaussians, camera)), camera, antialiased=antialiased)
        maps = encoder.cutout(drawn.image.permute(2, 0, 1)[None], drawn.opacity[None])[0].float()
        return _Picture(drawn.image, drawn.opacity, maps, view_keypoints(drawn.image))

    pictures = []
    solid = []
    for view, picture in enumerate(_in_threads(encoded, count)):
        progress(view, total)
        pictures.append(picture)
        cover = interpolate(picture.opacity[None, None], picture.maps.shape[1:], mode="area")[0, 0]
        solid.append(picture.maps[:, cover > _MIN_VIEW_OPACITY].T)
    if not any(len(each) for each in solid):
        raise DataError("nothing in the capture is opaque enough to be seen; it cannot be restyled")

    # 2. Bring the principal components of the encoder's cells to pixels, and pixels to Gaussians.
    basis = fit_basis(torch.cat(solid), _SEMANTIC_COMPONENTS)
    every = max(1, sum(picture.opacity.numel() for picture in pictures) // _STATISTICS_PIXELS)

    def carried(view: int) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor], Tensor]:
        """Numbers of the Gaussians that the view shows, sums of features and of weights over their pixels [M
        D+1], and samples.

        Samples are colours, features and opacities of some pixels, and colours and features of both ends of
        pairs [P 2 3+D].
        """
        image, opacity, maps, _ = pictures[view]
        low = basis.project(maps.flatten(1).T).T.reshape(-1, *maps.shape[1:])
        filled = (image + 1 - opacity[..., None]).clamp(0, 1)
        fine = apply_cell_maps(cell_maps(low, filled, reach=_WINDOW_REACH, eps=_MIN_CELL_VARIANCE), filled)
        # Colours are without what is behind them.
        colours = image.flatten(0, 1)
        features = fine.flatten(0, 1)
        seen = opacity.flatten()
        at = (seen[::every] > _MIN_VIEW_OPACITY).nonzero()[:, 0] * every
        sample = (colours[at] / seen[at, None]).clamp(0, 1), features[at], seen[at]
        # Neighbours along rows: where both are solid.
        solid = opacity > _MIN_VIEW_OPACITY
        row, column = (solid[:, :-1] & solid[:, 1:]).nonzero()[::every].unbind(1)
        first = row * opacity.shape[1] + column
        pair = torch.stack([first, first + 1], 1)
        shown = (colours[pair] / seen[pair][..., None]).clamp(0, 1)
        ends = torch.cat([shown, features[pair]], 2)
        # Each Gaussian that the camera may see takes the sum over its pixels, by its weights there.
        camera = camera_of(cameras, view, near)
        trust = opacity[..., None] ** _TRUST_POWER
        index = seen_by(gaussians, camera)
        shape = (
            gaussians.means[index],
            gaussians.quaternions[index],
            gaussians.log_scales[index],
            gaussians.logits[index],
        )
        lifted = lift(*shape, camera, torch.cat([fine * trust, trust], 2), antialiased=antialiased)
        return index, lifted, sample, ends

    dim = basis.matrix.shape[1]
    sums = torch.zeros(len(gaussians), dim)
    weights = torch.zeros(len(gaussians))
    samples = []
    pairs = []
    for view, (index, lifted, sample, ends) in enumerate(_in_threads(carried, count)):
        progress(count + view, total)
        sums.index_add_(0, index, lifted[:, :dim])
        weights.index_add_(0, index, lifted[:, dim])
        samples.append(sample)
        pairs.append(ends)
    progress(total, total)

    # 3. Regions and statistics of pixels, and which regions meet.
    colour, semantic, seen = (torch.cat(each) for each in zip(*samples, strict=True))
    style = scene_style(colour, semantic, seen, None, regions, seed=0)
    if len(style.share) > 1:
        met = torch.cat(pairs)
        style = style._replace(contacts=region_contacts(style, met[..., 3:], met[..., :3]))
    features = _spread(gaussians.means, sums, weights, style.semantic_mean)
    views = SeenViews(cameras, tuple(picture.keypoints for picture in pictures))
    return Semantics(style, basis, features, encoder.identity, views)


def _in_threads(function: Callable[[int], _Result], count: int) -> Iterator[_Result]:
    """function(0), function(1), ... function(count - 1) in order: several at a time, each on one thread.

    For views. The operations on one are too short to be shared between threads, which would wait for each
    other most of the time. At most one more is under way than there are threads, so memory is bounded.
    """
    before = torch.get_num_threads()
    threads = min(before, _MAX_VIEWS_AT_ONCE)
    if threads == 1:
        yield from map(function, range(count))
        return

    def begin() -> None:
        torch.set_num_threads(1)
        if compiled():
            import numba

            numba.set_num_threads(1)

    waiting: deque[Future[_Result]] = deque()
    with ThreadPoolExecutor(threads, "fprf-views", begin) as pool:
        try:
            for number in range(count):
                # Modes of this thread hold in others only if they are carried over.
                run = contextvars.copy_context().run
                waiting.append(pool.submit(run, torch.inference_mode()(function), number))
                if len(waiting) > threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            torch.set_num_threads(before)  # which threads that begin later take over


def _spread(
    points: Annotated[Tensor, "N 3"],
    sums: Annotated[Tensor, "N D"],
    mass: Annotated[Tensor, "N"],
    none: Annotated[Tensor, "D"],
) -> Annotated[Tensor, "N D"]:
    """Means at points, drawn to those of ever larger neighbourhoods, which decide where little was seen: half
    precision.

    A point far from whatever was seen takes `none`.
    """
    trust = mass.clone()
    levels = []
    # Neither stray Gaussians nor the distance from the origin decide how large neighbourhoods are, nor where
    # they begin.
    near = points[torch.from_numpy(bulk_of(points.numpy()).apart <= MAX_BULK_DISTANCE)].double()
    edge = _NEIGHBOURHOOD_EDGE_SHARE * float(near.var(0, correction=0).mean().sqrt())
    # Each level divides space into boxes twice as wide; a box counts for at most so many pixels, however much
    # was seen there.
    for level in range(_NEIGHBOURHOODS):
        box = torch.unique(cells_of(points, near.amin(0), max(edge * 2**level, 1e-30)), return_inverse=True)[
            1
        ]
        weight = sums.new_zeros(int(box.max()) + 1).index_add_(0, box, mass)
        share = weight.clamp_max(_NEIGHBOURHOOD_PIXELS * 0.5**level) / weight.clamp_min(1e-12)
        trust += (weight * share)[box]
        levels.append((box.int(), share))
    # Means of a point's own pixels and of its box in each level, by these weights.
    out = torch.empty(sums.shape, dtype=torch.float16)
    for some in torch.split(torch.arange(sums.shape[1]), _SPREAD_COMPONENTS):
        part = sums[:, some]
        mean = part.clone()
        for box, share in levels:
            mean += (sums.new_zeros(len(share), len(some)).index_add_(0, box, part) * share[:, None])[box]
        out[:, some] = torch.where(
            trust[:, None] > 1e-6, mean / trust.clamp_min(1e-12)[:, None], none[some]
        ).half()
    return out


def semantics_tensors(found: Semantics) -> dict[str, Tensor]:
    """Return semantics for a file of tensors."""
    parts = {"style": style_tensors(found.style), "basis": found.basis.tensors()}
    named = {}
    for group, tensors in parts.items():
        for name, tensor in tensors.items():
            named[f"{group}.{name}"] = tensor
    if found.seen is not None:
        for field in fields(Cameras):
            # A file has the views of a capture twice; tensors in it must not share memory.
            named[f"seen.{field.name}"] = getattr(found.seen.cameras, field.name).clone()
        for name, tensor in keypoint_tensors(found.seen.keypoints).items():
            named[f"keypoints.{name}"] = tensor
    return {
        **named,
        "semantic": found.features,
        "encoder": torch.tensor([*found.encoder.encode()], dtype=torch.uint8),
    }


def load_semantics(tensors: dict[str, Tensor], count: int) -> Semantics:
    """Read the tensors of `semantics_tensors`. Raises CheckpointError where they are not of as many
    Gaussians.
    """
    features = tensors.get("semantic", torch.zeros(0, 0))
    try:
        basis = Basis.from_tensors(tensor_group(tensors, "basis"))
        encoder = bytes(tensors["encoder"].tolist()).decode()
    except (KeyError, ValueError, DataError) as error:
        raise CheckpointError(f"what is known of a capture is incomplete ({error})") from error
    if features.shape != (count, basis.matrix.shape[1]):
        raise CheckpointError(
            f"what is known of a capture has features {tuple(features.shape)}; it is of another one"
        )
    style = style_from(tensor_group(tensors, "style"))
    keypoints = keypoints_from(tensor_group(tensors, "keypoints"))
    seen = None
    if keypoints:
        seen = SeenViews(Cameras(**tensor_group(tensors, "seen")), keypoints)
    return Semantics(style, basis, features.half(), encoder, seen)


def tensor_group(tensors: Mapping[str, Tensor], name: str) -> dict[str, Tensor]:
    """Tensors whose names begin with `name` and a dot, without these."""
    found: dict[str, Tensor] = {}
    for key, tensor in tensors.items():
        if key.startswith(f"{name}."):
            found[key.partition(".")[2]] = tensor
    return found
