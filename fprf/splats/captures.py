"""Finished captures, one or many and of any size: seen as one scene, recoloured file by file.

What is found out about a capture (views, semantics) is kept in a cache, by the content of its file.

What a style needs to know is found from a sample of the Gaussians of all files together, so that all take the
same maps of colours. A Gaussian that is not in the sample takes the features of those of the sample in the
smallest cell around it that holds any. Then each file is read and written once; of the others nothing is in
memory.
"""

import functools
import hashlib
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, NamedTuple, TypeAlias

import torch
from torch import Tensor

from ..errors import CheckpointError, DataError
from ..interfaces import Encoder
from ..io.cache import cache_folder, forget_oldest
from ..io.images import to_uint8, write_image
from ..io.tensorfiles import load_sealed, save_kept
from ..ops.rasterise import MIN_ALPHA
from ..rendering.cameras import Cameras
from ..rendering.north import North
from ..scenes import Scene
from ..training.loading import open_run
from ..types import Origin
from .capture_alignment import UNMOVED, Placement, axes_of, joined_world
from .config import LookConfig
from .drawing import clip_distance
from .files import Capture, read_capture, release
from .files.base import direction_of, pieces
from .gaussians import Gaussians
from .ground import USUAL_UP
from .neighbours import Neighbours, sampled
from .relighting import relit_harmonics
from .restyle import restyled_harmonics
from .scene import SplatScene, with_illumination
from .semantics import Semantics, find_semantics, load_semantics, semantics_tensors, tensor_group
from .views import find_views

Progress: TypeAlias = Callable[[str, int, int], None]
"""Hears what is being done, and how many of how many steps of it are."""
FINDING_VIEWS = "finding views"
LOOKING = "looking"
SAMPLE = 2_000_000
"""Gaussians that are looked at, at most: what is in memory of captures of any size, beside the file at
hand.
"""
_CACHE_VERSION = 13
"""Of what is found out about a capture: it counts up whenever the same file gives something else."""
_MAX_CACHED_CAPTURES = 24
"""Captures of which the cache keeps what was found out, some MB each."""
_REFERENCE_SIZE = (480, 360)
"""Width and height of views in the place of photographs: what encoders see of photographs."""
_MIN_REFERENCE_OPACITY = 0.95
"""Of pixels of such views that count: of others a part is background."""
MAX_REFERENCE_VIEWS = 16
"""Views of a capture that are references, at most: more say the same again (by eye)."""


def with_direction_up(look: LookConfig, capture: Capture, say: Callable[[str], None]) -> LookConfig:
    """Views of a capture with a direction up, which is said where it was not asked for."""
    if look.up is not None:
        return look
    axes = axes_of(capture)
    say(axes.note)
    return replace(look, up=axes.up)


def with_asked_north(capture: Capture, look: LookConfig) -> Capture:
    """A capture with north where it is asked to be. Raises DataError for what is no direction."""
    if look.north is None:
        return capture
    direction = direction_of(look.north)
    if direction is None:
        raise DataError(f"north {look.north}: no direction; give three numbers, not all 0")
    return replace(capture, north=North(direction=direction, source="--north says so"))


def look_at_capture(
    gaussians: Gaussians,
    antialiased: bool,
    encoder: Encoder,
    config: LookConfig,
    progress: Progress = lambda what, done, total: None,
    camera: Cameras | None = None,
) -> SplatScene:
    """Find views of Gaussians that are all finite, sizes included. What they show is found when it is first
    asked for.

    `camera` is the view that the capture was made from, where it is known. `progress` hears of "finding views"
    and "looking". Raises DataError where nothing can be seen.
    """
    # Mistakes are told before views are sought, which takes seconds.
    up = torch.tensor(config.up or USUAL_UP)
    if not bool(up.isfinite().all() & (up.norm() > 0)):
        raise DataError(f"up {config.up}: no direction; give three numbers, not all 0")
    if float(gaussians.opacities.max()) < MIN_ALPHA:
        raise DataError(
            f"all {len(gaussians)} Gaussians are transparent; nothing of the capture can be seen or restyled"
        )
    cameras = find_views(
        gaussians,
        config,
        antialiased=antialiased,
        camera=camera,
        progress=functools.partial(progress, FINDING_VIEWS),
    )

    def found() -> Semantics:
        near = clip_distance(gaussians)
        told = functools.partial(progress, LOOKING)
        return find_semantics(
            gaussians, antialiased, encoder, cameras, config.regions, near=near, progress=told
        )

    return _scene_of(gaussians, antialiased, cameras, functools.cache(found), encoder)


def _scene_of(
    gaussians: Gaussians,
    antialiased: bool,
    cameras: Cameras,
    found: Callable[[], Semantics],
    encoder: Encoder,
) -> SplatScene:
    """The scene of a capture; its views are numbered."""
    names = tuple(f"{view:02d}" for view in range(len(cameras)))
    longest = int(cameras.size.amax())
    near = clip_distance(gaussians)
    scene = SplatScene(gaussians, antialiased, cameras, names, found, lambda: encoder, longest, near)
    return with_illumination(scene)


def open_capture(
    capture: Capture,
    look: LookConfig,
    *,
    cache: Path | None = None,
    progress: Progress = lambda what, done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> SplatScene:
    """A capture as a scene: its Gaussians that can be drawn, with views and features from the cache.

    What points up is as `look` says, else as `axes_of`. Where views and features are absent, views are
    found here, and features, which are then stored, when they are first asked for. `cache` is the folder; by
    default the user's own.
    """
    capture = with_asked_north(capture, look)
    look = with_direction_up(look, capture, say)
    encoder = look.semantic.encoder.build()
    path = (cache or cache_folder("captures")) / _cache_name(capture, look, encoder)
    gaussians = capture.gaussians.drawable()
    kept = _load_findings(path, len(gaussians), say)
    if kept is not None:

        def known() -> Semantics:
            return kept.semantics

        scene = _scene_of(gaussians, capture.antialiased, kept.cameras, known, encoder)
        scene = replace(scene, origin=capture.origin, north=capture.north)
        return _keeping_light(scene, cache)
    scene = look_at_capture(gaussians, capture.antialiased, encoder, look, progress, capture.camera)

    def found() -> Semantics:
        semantics = scene.found()
        _save_findings(path, _Findings(scene.views, semantics))
        return semantics

    opened = replace(scene, found=functools.cache(found), origin=capture.origin, north=capture.north)
    return _keeping_light(opened, cache)


def _keeping_light(scene: SplatScene, cache: Path | None) -> SplatScene:
    """The scene, with what is found out about its light kept beside other findings."""
    return with_illumination(scene, None if cache is None else cache / "light")


class _Findings(NamedTuple):
    """Findings about a capture, as the cache keeps them."""

    cameras: Cameras
    semantics: Semantics


def _cache_name(capture: Capture, look: LookConfig, encoder: Encoder) -> str:
    """A name that follows from all that findings depend on: the file, the encoder and how it is looked at."""
    digest = hashlib.sha256(capture.data)
    viewed = f"{look.up} {look.inside} {look.views} {look.size} {look.regions} {look.activated}"
    digest.update(f"{_CACHE_VERSION} {encoder.identity} {viewed}".encode())
    return f"{digest.hexdigest()[:32]}.safetensors"


def _load_findings(path: Path, count: int, say: Callable[[str], None]) -> _Findings | None:
    """Findings about a capture of `count` Gaussians from the cache; None where it keeps none, or none sound."""
    if not os.path.isfile(path):  # False also where the folder is closed to us
        return None
    try:
        tensors = load_sealed(path)
        found = _Findings(Cameras(**tensor_group(tensors, "camera")), load_semantics(tensors, count))
    except (CheckpointError, TypeError) as error:
        say(f"looking again: {error}")
        return None
    with suppress(OSError):  # another process may just have removed it
        os.utime(path)
    return found


def _save_findings(path: Path, found: _Findings) -> None:
    """Keep what was found out, and remove what was not asked for longest."""
    views = {}
    for field in fields(Cameras):
        views[f"camera.{field.name}"] = getattr(found.cameras, field.name)
    save_kept(path, {**views, **semantics_tensors(found.semantics)})
    forget_oldest(path.parent, _MAX_CACHED_CAPTURES)


@dataclass(frozen=True, eq=False)
class Captures:
    """Captures that are seen as one scene."""

    scene: SplatScene
    """A sample of all of them, about the origin of the first one."""
    rows: tuple[slice, ...]
    """Rows of each capture among the Gaussians of the scene."""
    placements: tuple[Placement, ...]
    """Place of each capture in the scene, so that none lies in another's, and up and north are one."""
    first: Capture
    """The first capture, as it was read."""
    count: int
    """Gaussians of all captures."""

    def harmonics(self, index: int, capture: Capture, styled: SplatScene) -> Annotated[Tensor, "N K 3"]:
        """Harmonics of all Gaussians of capture number `index` that can be drawn, in the look of the scene of all
        in a style.
        """
        look = styled.look
        gaussians = capture.gaussians
        rows = self.rows[index]
        placement = self.placements[index]
        finite = gaussians.finite
        if not bool(finite.all()):
            gaussians = gaussians.select(finite)
        means = gaussians.means + moved_origin(capture.origin, self.scene.origin)
        if rows.stop - rows.start == len(gaussians):
            there = replace(gaussians, means=means)
            return styled.styled_harmonics(there, rows, placement.points(means))
        if look is None:
            return gaussians.harmonics
        # Numbers of the sample that the others take from those near to them.
        found = self.scene.found().features[rows]
        channels = found.shape[1]
        if look.lit:
            found = torch.cat([found.float(), styled.light_gain[rows]], 1)
        # The sample stands where its own capture was moved to: back in its place.
        near = Neighbours(placement.back(self.scene.gaussians.means[rows]), found)
        out = torch.empty_like(gaussians.harmonics)
        for some in pieces(len(out)):
            taken = near(means[some])
            seen_at = placement.points(means[some])
            part = restyled_harmonics(
                gaussians.harmonics[some], means[some], taken[:, :channels], look, seen_at
            )
            if look.lit:
                part = relit_harmonics(part, taken[:, channels:].float())
            out[some] = part
        return out

    def views_of(self, index: int, capture: Capture) -> Cameras:
        """The views of the scene about the origin of capture number `index`, in its axes."""
        placed = self.placements[index].cameras_back(self.scene.views)
        return placed.shifted(moved_origin(capture.origin, self.scene.origin).tolist())


def open_captures(
    paths: Sequence[Path],
    look: LookConfig,
    *,
    first: Capture | None = None,
    sample: int = SAMPLE,
    cache: Path | None = None,
    progress: Progress = lambda what, done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> Captures:
    """Read captures and see them as one scene; arguments as those of `open_capture`.

    Of several captures each gives a like share of the sample. `first` is the first one, where it was read
    already. Raises DataError where nothing can be seen.
    """
    first = first or _read(paths[0], look, say)
    if len(paths) == 1 and len(first.gaussians) <= sample:
        scene = open_capture(first, look, cache=cache, progress=progress, say=say)
        whole = (slice(0, len(scene.gaussians)),)
        return Captures(scene, whole, (UNMOVED,), first, len(first.gaussians))
    samples = []
    axes = []
    for path in paths:
        if path == paths[0]:
            capture = first
        else:
            capture = _read(path, look, say)
        samples.append(_sample_of(capture, first.origin, max(1, sample // len(paths))))
        if len(paths) > 1:
            axes.append(axes_of(capture, look.up))
        release(capture.data)
    parts = []
    for each in samples:
        parts.append(each.part)
    placements: tuple[Placement, ...] = (UNMOVED,)
    together = first
    if len(paths) > 1:
        world = joined_world(parts, axes)
        placements = world.placements
        # What lies in one row is looked at as an object; a known camera is that of one capture alone.
        together = replace(first, camera=None, up=world.up, up_reason=world.up_reason, north=world.north)
        for note in world.notes:
            say(note)
    together = replace(
        together,
        gaussians=_joined(parts, placements),
        antialiased=any(each.antialiased for each in samples),
        data=_joint_key(samples, sample, placements),
    )
    scene = open_capture(together, look, cache=cache, progress=progress, say=say)
    rows = []
    start = 0
    for part in parts:
        rows.append(slice(start, start + len(part)))
        start += len(part)
    count = sum(each.total for each in samples)
    return Captures(scene, tuple(rows), placements, first, count)


class _Sample(NamedTuple):
    """Sample of one of several captures."""

    part: Gaussians
    """Some of those that can be drawn, about the origin of the first capture."""
    here: Annotated[Tensor, "3"]
    """The capture's own origin, seen from that."""
    digest: bytes
    """Of its file."""
    total: int
    """Gaussians that it has."""
    antialiased: bool


def moved_origin(origin: Origin, new: Origin) -> Annotated[Tensor, "3"]:
    """Offset from positions about one origin to those about a new one."""
    parts = []
    for old, other in zip(origin, new, strict=True):
        parts.append(old - other)
    return torch.tensor(parts)


def _sample_of(capture: Capture, origin: Origin, most: int) -> _Sample:
    """At most so many Gaussians of a capture, about an origin."""
    here = moved_origin(capture.origin, origin)
    part = sampled(capture.gaussians.drawable(), most)
    part = replace(part, means=part.means + here)
    digest = hashlib.sha256(capture.data).digest()
    return _Sample(part, here, digest, len(capture.gaussians), capture.antialiased)


def _joint_key(samples: Sequence[_Sample], most: int, placements: Sequence[Placement]) -> bytes:
    """Key of the findings about several captures, in the place of a file's content."""
    key = hashlib.sha256(f"{most} {len(samples)}".encode())
    for each, placement in zip(samples, placements, strict=True):
        key.update(each.digest)
        if placement.turned:
            key.update(f"{placement.turn.tolist()} {placement.move.tolist()}".encode())
        if bool(each.here.any()):
            key.update(f"{each.here.tolist()}".encode())  # an offset beside a file moves it among the others
    return key.digest()


def _read(path: Path, look: LookConfig, say: Callable[[str], None]) -> Capture:
    """A capture, with what its file was taken for."""
    capture = read_capture(path, activated=look.activated)
    for note in capture.notes:
        say(f"{capture.path}: {note}")
    return with_asked_north(capture, look)


def _joined(parts: Sequence[Gaussians], placements: Sequence[Placement]) -> Gaussians:
    """Gaussians of several captures, each in its place, with as many harmonics as the most of them have."""
    bands = max(part.harmonics.shape[1] for part in parts)
    harmonics = []
    placed = []
    for own, placement in zip(parts, placements, strict=True):
        part = placement.placed(own)
        placed.append(part)
        # Harmonics of a higher degree are 0 where a file has none.
        missing = part.harmonics.new_zeros(len(part), bands - part.harmonics.shape[1], 3)
        harmonics.append(torch.cat([part.harmonics, missing], 1))
    return Gaussians(
        means=torch.cat([part.means for part in placed]),
        quaternions=torch.cat([part.quaternions for part in placed]),
        log_scales=torch.cat([part.log_scales for part in placed]),
        logits=torch.cat([part.logits for part in placed]),
        harmonics=torch.cat(harmonics),
    )


class ReferenceViews(NamedTuple):
    """Pictures in the place of photographs."""

    pictures: tuple[Path, ...]
    masks: tuple[Path, ...]
    """White where a picture shows something."""
    weights: tuple[float, ...]
    """Shares of the pictures that show anything."""


def reference_views(path: Path, look: LookConfig, folder: Path) -> ReferenceViews:
    """Write pictures of views of a capture or of a run into a folder: in the place of photographs, as
    references. Raises DataError where none shows anything.
    """
    scene = _reference_scene(path, look)
    count = min(MAX_REFERENCE_VIEWS, len(scene.names))
    chosen = torch.linspace(0, len(scene.names) - 1, count).round().long()
    cameras = scene.cameras.select(chosen)
    pictures = list[Path]()
    masks = list[Path]()
    weights = list[float]()
    for view in range(len(cameras)):
        shown = scene.render(cameras, view)
        solid = shown.opacity > _MIN_REFERENCE_OPACITY
        if bool(solid.any()):
            pictures.append(folder / f"{view:02d}.png")
            masks.append(folder / f"{view:02d}.mask.png")
            weights.append(float(solid.double().mean()))
            # What is not solid is transparent: no encoder sees the backdrop.
            layers = torch.cat([shown.rgb, solid[..., None].to(shown.rgb)], 2)
            write_image(pictures[-1], to_uint8(layers))
            write_image(masks[-1], to_uint8(solid[..., None].expand(-1, -1, 3).float()))
    if not pictures:
        raise DataError(f"{path}: nothing in it is opaque enough to be a reference")
    return ReferenceViews(tuple(pictures), tuple(masks), tuple(weights))


def _reference_scene(path: Path, look: LookConfig) -> Scene:
    """The scene of a run, or a sample of a capture with as many views as one that takes the style is looked at
    from: of one place both show alike shares.
    """
    if (path / "config.json").is_file():
        return open_run(path, device="cpu").scene
    capture = read_capture(path, activated=look.activated)
    up = axes_of(capture, look.up).up
    gaussians = sampled(capture.gaussians.drawable(), SAMPLE)
    encoder = look.semantic.encoder.build()
    look = replace(look, size=_REFERENCE_SIZE, up=up)
    return look_at_capture(gaussians, capture.antialiased, encoder, look, camera=capture.camera)
