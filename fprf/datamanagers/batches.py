"""Training batches: random pixels of all training views with their colours and feature targets.

A batch is a pure function of (seed, step): its generator is seeded by BLAKE2b of the two, so any step can be
drawn without the ones before, a resumed run sees the same pixels, and neighbouring seeds or steps share
nothing. A GPU that holds the images draws with a generator of its own: the same on every run there, but other
pixels than on the CPU.

Pixels of many images lie in a mapped file without a name, which ends with its process: the system keeps of it
what memory there is to spare, so thousands of images need not fit.
"""

import copy
import hashlib
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..errors import DataError
from ..interfaces import DataManager
from ..io.atomic import unwritable
from ..io.cache import reason_of, say_uncached, temporary_folder
from ..memory import available_memory
from ..types import Batch
from .config import FeatureTargets, RayBatchesConfig, TrainingPixels
from .features import FeatureStore, Progress, Projection, extract
from .images import WHITE, load_images, load_mask
from .scene import find_sightings

HELD = 512 * 2**20
"""Bytes of pixels that are simply held in memory: by eye, a sixteenth of what a small machine has."""
_MEMORY_SHARE = 0.5
"""Of the free memory, what pixels may take where no disk has room for them; by eye."""


def allocate_pixels(pixels: int, folder: Path, held: int = HELD) -> Annotated[Tensor, "P 3"]:
    """Space for so many pixels, uint8, to be written to; mapped from a file in `folder` above `held` bytes.

    Where that has no room, from a temporary file; where the system has no room for one either, in memory.
    Raises DataError where that would not hold it.
    """
    size = 3 * pixels
    if size <= held:
        return torch.empty(pixels, 3, dtype=torch.uint8)
    try:
        return _mapped_pixels(pixels, folder)
    except OSError as error:
        say_uncached(folder, reason_of(error))
        refused = unwritable(folder, error, size)
    temporary = temporary_folder("pixels")
    if temporary is not None:
        with suppress(OSError):
            return _mapped_pixels(pixels, temporary)
    free = available_memory()
    if free is None or size > _MEMORY_SHARE * free:
        raise refused
    return torch.empty(pixels, 3, dtype=torch.uint8)


def _mapped_pixels(pixels: int, folder: Path) -> Annotated[Tensor, "P 3"]:
    """Mapped from a file without a name in `folder`. Raises OSError where the system refuses."""
    size = 3 * pixels
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder) as file:
        if hasattr(os, "posix_fallocate"):
            # Blocks for all of it now: a write to a mapped file that the disk has no room for would end
            # the process.
            os.posix_fallocate(file.fileno(), 0, size)
        else:
            os.ftruncate(file.fileno(), size)
        mapped = np.memmap(file, dtype=np.uint8, mode="r+", shape=(pixels, 3))
    return torch.from_numpy(np.asarray(mapped))


class PixelRuns:
    """A set of numbers of 0 to 2^63, as K runs that neither touch nor overlap, in order."""

    def __init__(self, start: Annotated[Tensor, "K"], length: Annotated[Tensor, "K"]) -> None:
        self._start = start
        self._after = length.cumsum(0)
        self._before = self._after - length
        self._count = int(self._after[-1]) if len(start) else 0

    @staticmethod
    def of(masks: Iterable[tuple[int, Tensor]]) -> "PixelRuns":
        """Of masks of any shape, each with the number of its first entry, which rise; a run may go on in the
        next mask.
        """
        # Where a mask changes runs begin and end; runs that touch across masks become one.
        starts = []
        ends = []
        for first, mask in masks:
            edge = torch.zeros(1, dtype=torch.bool)
            change = torch.cat([edge, mask.reshape(-1), edge]).diff().nonzero()[:, 0] + first
            starts.append(change[::2])
            ends.append(change[1::2])
        none = torch.zeros(0, dtype=torch.int64)
        start = torch.cat([none, *starts])
        end = torch.cat([none, *ends])
        apart = torch.ones(len(start) + 1, dtype=torch.bool)
        apart[1:-1] = start[1:] != end[:-1]
        start = start[apart[:-1]]
        end = end[apart[1:]]
        return PixelRuns(start, end - start)

    def __len__(self) -> int:
        """Count of the numbers."""
        return self._count

    def to(self, device: torch.device) -> "PixelRuns":
        """The same set on a device."""
        there = copy.copy(self)
        there._start, there._after, there._before = (
            x.to(device) for x in (self._start, self._after, self._before)
        )
        return there

    def pick(self, rank: Annotated[Tensor, "R"]) -> Annotated[Tensor, "R"]:
        """The numbers of these ranks, 0 <= rank < len: the first, second ... of the set."""
        run = torch.searchsorted(self._after, rank, right=True)
        return self._start[run] + rank - self._before[run]

    def holds(self, number: Annotated[Tensor, "R"]) -> Annotated[Tensor, "R"]:
        """Mask of the numbers that are in the set."""
        if not len(self._start):
            return torch.zeros_like(number, dtype=torch.bool)
        run = (torch.searchsorted(self._start, number, right=True) - 1).clamp_min(0)
        apart = number - self._start[run]
        return (apart >= 0) & (apart < self._after[run] - self._before[run])


# Images decoded at a time (in threads) before they are copied together.
DECODE = 16


def generator_of(
    seed: int, step: int, device: torch.device | None = None, *, purpose: str = "pixels"
) -> torch.Generator:
    """The generator of one step's draws, on the CPU unless a device is given.

    Its seed is a hash of purpose, seed and step, since the CPU's generator looks at 32 bits of its seed
    alone.
    """
    name = f"fprf {purpose} {seed} {step}".encode()
    number = int.from_bytes(hashlib.blake2b(name, digest_size=8).digest(), "little") >> 1
    return torch.Generator(device or "cpu").manual_seed(number)


class _Source(NamedTuple):
    """Pixels, masks and points that batches are drawn from, on one device."""

    pixels: Annotated[Tensor, "P 3"]
    """uint8, all training views one after the other."""
    view: Annotated[Tensor, "T"]
    """int64 index of each training view in the scene."""
    size: Annotated[Tensor, "T 2"]
    """int64 width and height of each."""
    ends: Annotated[Tensor, "T"]
    """int64 pixels up to the end of each."""
    chosen: PixelRuns
    """Pixels that may be drawn."""
    sky: PixelRuns | None
    marked: Annotated[Tensor, "O"] | None
    """int64 pixels that show a point of the reconstruction; None = none do."""
    distance: Annotated[Tensor, "O"] | None
    """World distance of that point along the ray."""


class RayBatches(DataManager):
    """Pixels drawn uniformly, with replacement, from all pixels of the training views.

    Images are held as uint8, one after the other, in a mapped file where they are many; feature coefficients
    stay in mapped files under `cache`. Pixels that a capture's masks leave out are never drawn. Transparent
    ones show the background, white by default. `progress(done, total, what)` is told how far features are.
    """

    def __init__(
        self,
        config: RayBatchesConfig,
        pixels: TrainingPixels,
        targets: FeatureTargets,
        *,
        cache: Path,
        seed: int,
        progress: Progress | None = None,
    ) -> None:
        scene = pixels.scene
        if not len(scene.train):
            raise DataError(f"{scene.name}: no training views; at least one image must not be held out")
        self.background = pixels.background or (WHITE if scene.alpha else None)
        """Colour (RGB in [0, 1]) behind transparent pixels; None for opaque scenes."""
        self._config = config
        self._scene = scene
        self._seed = seed
        # Views lie in slots one after the other: pixel p of slot k is number ends[k - 1] + p.
        self._views = scene.train.tolist()
        self._sizes = scene.cameras.size[scene.train]
        self._ends = self._sizes.prod(1).cumsum(0)
        self._slots = {view: slot for slot, view in enumerate(self._views)}
        self._pixels = self._load_pixels(cache)
        self._chosen = self._drawn_pixels(pixels.seen)
        self._source = self._source_of()
        # Features are those of the very pixels above, which are not decoded again for each encoder.
        features = partial(
            extract, views=self._views, image=self._stored, config=config.guided, progress=progress
        )
        self.content_store: FeatureStore | None = None
        self.semantic_store: FeatureStore | None = None
        if targets.content is not None:
            self.content_store = features(cache / "content", encoder=targets.content)
        if targets.semantic is not None:
            projection = Projection(targets.dim, targets.basis)
            self.semantic_store = features(
                cache / "semantic", encoder=targets.semantic, projection=projection
            )

    def _load_pixels(self, cache: Path) -> Annotated[Tensor, "P 3"]:
        """All training pixels, view after view; many of them mapped from a file in `cache`."""
        pixels = allocate_pixels(int(self._ends[-1]), cache)
        filled = 0
        for first in range(0, len(self._views), DECODE):
            some = self._views[first : first + DECODE]
            for image in load_images(self._scene, self.background, some):
                rows = torch.from_numpy(image).reshape(-1, 3)
                pixels[filled : filled + len(rows)] = rows
                filled += len(rows)
        return pixels

    def _drawn_pixels(self, seen: Callable[[int], Annotated[Tensor, "H W"]] | None) -> PixelRuns:
        """The pixels that may be drawn. Raises DataError where there are none."""
        masks = self._scene.masks if self._config.masks else ()
        if not masks and seen is None:
            return PixelRuns(torch.zeros(1, dtype=torch.int64), self._ends[-1:])
        chosen = self._runs(masks, unmasked=True, seen=seen)
        if not len(chosen):
            raise DataError(
                f"{self._scene.name}: none of {len(self._views)} training views shows what is to be learnt"
            )
        return chosen

    def _source_of(self) -> _Source:
        """Pixels that batches are drawn from: all, those of sky, and those that show points."""
        skies = self._scene.sky_masks if self._config.masks else ()
        sky = self._runs(skies, unmasked=False) if skies else None
        marked = None
        distance = None
        if self._config.depth_share > 0:
            marked, distance = self._marked()
        return _Source(
            self._pixels, self._scene.train, self._sizes, self._ends, self._chosen, sky, marked, distance
        )

    def batch(self, step: int) -> Batch:
        """The pixels of a step; the first `semantic_share` of them carry semantics."""
        source = self._source
        device = source.pixels.device
        # Pixels among all that may be drawn.
        generator = generator_of(self._seed, step, device)
        at = source.chosen.pick(
            torch.randint(len(source.chosen), (self._config.rays,), generator=generator, device=device)
        )
        distance = None
        if source.marked is not None and source.distance is not None:
            # Some through sparse points, as the last rays: the first ones carry semantics, which must stay an
            # even sample.
            count = round(self._config.depth_share * len(at))
            mark = torch.randint(len(source.marked), (count,), generator=generator, device=device)
            at = torch.cat([at[: len(at) - count], source.marked[mark]])
            unknown = torch.full((len(at) - count,), torch.nan, device=device)
            distance = torch.cat([unknown, source.distance[mark]])
        # From the number of a pixel to its view and its place there.
        slot = torch.searchsorted(source.ends, at, right=True)
        width, height = source.size[slot].unbind(1)
        local = at - (source.ends[slot] - width * height)
        pixel = torch.stack([local % width, local // width], 1) + 0.5
        view = source.view[slot]
        rgb = source.pixels[at].float() / 255
        share = round(self._config.semantic_share * len(at))
        content = self.content_store
        semantic = self.semantic_store
        return Batch(
            view=view,
            pixel=pixel,
            rgb=rgb,
            content=content.at(view, pixel, rgb) if content is not None else None,
            semantic=semantic.at(view[:share], pixel[:share], rgb[:share])
            if semantic is not None and share
            else None,
            distance=distance,
            sky=None if source.sky is None else source.sky.holds(at),
        )

    @property
    def held_bytes(self) -> int:
        """Size of the images and the features' coefficients."""
        stores = (self.content_store, self.semantic_store)
        return self._pixels.numel() + sum(store.bytes for store in stores if store is not None)

    def to(self, device: torch.device, *, room: int) -> "RayBatches":
        """The same pixels drawn on a CUDA device, where images and coefficients take at most `room` bytes."""
        if device.type != "cuda" or self.held_bytes > room:
            return self
        there = copy.copy(self)
        there._source = _Source._make(None if part is None else part.to(device) for part in self._source)
        there.content_store = None if self.content_store is None else self.content_store.to(device)
        there.semantic_store = None if self.semantic_store is None else self.semantic_store.to(device)
        return there

    def image(self, view: int) -> Annotated[Tensor, "H W 3"]:
        """One view of the scene as a float image in [0, 1]; held-out ones are read when asked for."""
        if view in self._slots:
            return self._stored(view).float() / 255
        return torch.from_numpy(load_images(self._scene, self.background, [view])[0]).float() / 255

    def _stored(self, view: int) -> Annotated[Tensor, "H W 3"]:
        slot = self._slots[view]
        width, height = self._sizes[slot].tolist()
        end = int(self._ends[slot])
        return self._pixels[end - width * height : end].reshape(height, width, 3)

    def _runs(
        self, paths: Sequence[Path | None], *, unmasked: bool, seen: Callable[[int], Tensor] | None = None
    ) -> PixelRuns:
        """The training pixels that are bright in their view's mask, and that `seen` allows; of a view without
        a mask they are as `unmasked` says.
        """

        def masks() -> Iterator[tuple[int, Tensor]]:
            for slot, view in enumerate(self._views):
                width, height = self._sizes[slot].tolist()
                path = paths[view] if paths else None
                mask = torch.full((height, width), unmasked)
                if path is None:
                    mask = mask
                else:
                    mask = torch.from_numpy(load_mask(path, (width, height)))
                yield int(self._ends[slot]) - width * height, mask if seen is None else mask & seen(view)

        return PixelRuns.of(masks())

    def _marked(self) -> tuple[Annotated[Tensor, "O"], Annotated[Tensor, "O"]] | tuple[None, None]:
        """Pixels that are learnt from and show a sparse point, and its world distance along the ray; None
        where none does.

        Of a reconstruction that says who saw what, points count that two of these views saw: one alone says
        nothing of depth.
        """
        seen = self._scene.seen
        if seen is not None:
            seen = seen[torch.isin(seen[:, 0], self._scene.train)]
            seen = seen[torch.bincount(seen[:, 1])[seen[:, 1]] >= 2]
        sightings = find_sightings(replace(self._scene, seen=seen))
        if sightings is None:
            return None, None
        # From a view and a pixel to the number among all training pixels.
        slots = torch.full((len(self._scene.cameras),), -1, dtype=torch.int64)
        slots[self._scene.train] = torch.arange(len(self._views))
        slot = slots[sightings.view]
        pixel = sightings.pixel.long()
        width, height = self._sizes[slot].unbind(1)
        at = self._ends[slot] - width * height + pixel[:, 1] * width + pixel[:, 0]
        kept = self._chosen.holds(at)
        if bool(kept.any()):
            return (at[kept], sightings.distance[kept].float())
        return (None, None)
