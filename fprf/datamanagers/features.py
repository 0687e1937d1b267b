"""Feature targets of every view of a scene, at any pixel, for a few megabytes an image.

Extraction runs the encoder once a view at the image's own size and keeps guided-filter coefficients
(`ops.guided`) in half precision in files; `FeatureStore.at` reads the cells around the pixels of a batch and
applies them. Full-size feature maps never exist. Semantic features are projected on principal components of
the training views before they are kept.

A file is named by the hash of everything that it was made from, holds checksums (`io.tensorfiles`), and
appears under its name only when it is whole. So whatever an interrupted run, a second writer or a bad disk
leaves behind is either right or made again; nothing is ever found by position.

Half precision keeps 11 bits of each number, so numbers are made small first: b is taken at mid-grey (colours
are then in [-0.5, 0.5]) and relative to its mean, and each channel is divided by its largest coefficient.
"""

# The checker takes compiled functions to have one argument.
# mypy: disable-error-code="call-arg"

import contextlib
import copy
import hashlib
import os
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import CheckpointError, DataError, NumericsError, PluginError
from ..interfaces import Encoder
from ..io import tensorfiles
from ..io.cache import files_in
from ..ops import guided
from ..ops.backend import float32_convolutions
from ..ops.config import GuidedConfig
from .basis import Basis, fit_basis

GREY = 0.5
"""Colour about which b is taken: colours are then in [-0.5, 0.5]."""
LANES = 8
"""Channels that a kernel takes at once: eight floats are a vector of AVX."""
# Part of every key: raise it when the same inputs give other files.
FORMAT = "fprf-features-1"
# Stored numbers stay within +-TOP: far from half precision's 65504, and its 24 bits below 1 are left for the
# small ones.
TOP = 4096.0


class Entry(NamedTuple):
    """A view's features: F = scale (A (I - GREY) + b) + centre, with A and b interpolated over s x t
    cells.
    """

    coefs: Annotated[Tensor, "s t 4 P"]
    """float16: A for red, green, blue, then b; P is C rounded up to a multiple of LANES, zeros beyond C."""
    scale: Annotated[Tensor, "C"]
    centre: Annotated[Tensor, "C"]
    size: Annotated[Tensor, "2"]
    """Height, width of the image in pixels, int64."""
    moments: Annotated[Tensor, "2 C"]
    """Mean and variance of the features over the view's pixels, float64."""

    def plain(self) -> Annotated[Tensor, "s t C 4"]:
        """The coefficients as `ops.guided.coefficients` gives them, float32."""
        channels = len(self.scale)
        coefs = self.coefs[..., :channels].float() * self.scale
        coefs[..., 3, :] += self.centre - GREY * coefs[..., :3, :].sum(2)
        return coefs.transpose(2, 3)


def digest(*parts: str | bytes) -> str:
    """SHA-256 of the parts and the format, as 32 hexadecimal digits; parts cannot run into each other."""
    state = hashlib.sha256(FORMAT.encode())
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        state.update(len(data).to_bytes(8, "little"))
        state.update(data)
    return state.hexdigest()[:32]


def read_kept(folder: Path, key: str) -> dict[str, Tensor] | None:
    """The tensors in FOLDER/KEY.safetensors, mapped; None where it is absent or damaged."""
    path = folder / f"{key}.safetensors"
    try:
        tensors = tensorfiles.load_sealed(path)
    except CheckpointError:
        return None
    with contextlib.suppress(OSError):  # a cache that is only read; its order of use is then not known
        os.utime(path)
    return tensors


def keep_within(folder: Path, size: int, used: Collection[str]) -> None:
    """Delete the files that were used longest ago until at most `size` bytes are left, but none whose key is
    in `used`.

    Whoever has one mapped keeps it on POSIX; on Windows it stays.
    """
    # The file that was used longest ago first.
    files = []
    for path in files_in(folder, "[!.]*.safetensors"):
        with contextlib.suppress(OSError):  # another process was first
            files.append((path.stat().st_mtime, path.stat().st_size, path))
    total = sum(bytes_of for _, bytes_of, _ in files)
    for _, bytes_of, path in sorted(files):
        if total <= size:
            return
        if path.stem not in used:
            with contextlib.suppress(OSError):
                path.unlink()
                total -= bytes_of


Progress = Callable[[int, int, str], None]
"""Told (done, total, what)."""

BASIS_VIEWS = 64
"""Views, spread evenly, that a basis is fitted on, at most: by eye."""
BASIS_CELLS = 32_768
"""Cells of all these views that it is fitted on, at most: some 40 for each of 768 channels (by eye)."""
# Features met while fitting the basis are remembered up to this, so that small scenes are encoded once, not
# twice.
REMEMBER_BYTES = 1 << 28
MOMENT_PIXELS = 2048
"""Pixels of a view that moments of its features are measured on: they are then known to some percent."""
_UNFINISHED_SECONDS = 3600.0
"""Age from which a file that was not finished belongs to no living writer: encoding a view takes minutes at most."""
CACHED_BYTES = 1 << 30
"""Bytes of the files in a folder, at most; those of the views at hand stay whatever they take. By eye."""
# A and b move within a window's fifth: measured on photographs, a coarser grid costs more than 1.5 % of the
# features' spread.
CELLS_PER_WINDOW = 5


class FeatureStore:
    """Targets of some views of a scene; see `extract`."""

    def __init__(self, entries: Mapping[int, Entry], basis: Basis | None = None) -> None:
        if not entries:
            raise DataError("feature store: no views; a scene needs at least one training view")
        self.basis = basis
        """Basis that the encoder's features were projected on; None = kept raw."""
        self._coefs = [entry.coefs for entry in entries.values()]
        parts = zip(*((e.size, e.scale, e.centre, e.moments) for e in entries.values()), strict=True)
        self._size, self._scale, self._centre, moments = (torch.stack(part) for part in parts)
        self._slots = torch.tensor(list(entries))
        """The view of each entry."""
        self._numbers = torch.zeros(int(self._slots.max()) + 1, dtype=torch.int64)
        """The entry of each view; 0 as well for those that have none."""
        self._numbers[self._slots] = torch.arange(len(entries))
        self.channels = self._scale.shape[1]
        self.bytes = sum(coefs.numel() * 2 for coefs in self._coefs)
        """Size of the coefficients."""
        # Mean and variance of each channel over all views, each counted by its pixels.
        weight = self._size.prod(1).double()[:, None]
        means, variances = moments.unbind(1)
        mean = (weight * means).sum(0) / weight.sum()
        variance = (weight * (variances + (means - mean).square())).sum(0) / weight.sum()
        self.std = float(variance.mean().sqrt())
        """Root mean square over the channels' standard deviations, over all pixels."""
        if self.std > 1e-6 * float(self._centre.abs().max()):
            self.scale = self.std
        else:
            self.scale = 1.0
        """The unit of losses: `std`, or 1 where the features do not change but for rounding."""
        # Kernels read the coefficients where they lie, in mapped files.
        rows = []
        for coefs in self._coefs:
            rows.append(coefs.data_ptr())
        self._address = torch.tensor(rows)
        self._shape = torch.cat([torch.tensor([coefs.shape[:2] for coefs in self._coefs]), self._size], 1)
        self._packed: tuple[guided.Packed, Tensor] | None = None

    def to(self, device: torch.device) -> "FeatureStore":
        """The same targets, with the coefficients on a device as well: `at` of tensors there computes
        there.
        """
        parts = []
        for coefs in self._coefs:
            parts.append(coefs.shape[:2])
        shapes = torch.tensor(parts)
        ends = shapes.prod(1).cumsum(0)
        packed = torch.empty(int(ends[-1]), *self._coefs[0].shape[2:], dtype=torch.float16, device=device)
        # One after the other: together they would be in memory twice.
        for coefs, end in zip(self._coefs, ends.tolist(), strict=True):
            packed[end - coefs[..., 0, 0].numel() : end].copy_(coefs.flatten(0, 1))
        small = ends - shapes.prod(1), shapes, self._size, self._scale, self._centre
        there = copy.copy(self)
        there._packed = guided.Packed(packed, *(part.to(device) for part in small)), self._numbers.to(device)
        return there

    def at(
        self, view: Annotated[Tensor, "R"], pixel: Annotated[Tensor, "R 2"], rgb: Annotated[Tensor, "R 3"]
    ) -> Annotated[Tensor, "R C"]:
        """Features, float32, raw. `view` counts in the scene; pixel is x, y with centres at +0.5; rgb in [0,
        1] is the image's own colour there. Raises DataError for a view that is not in the store; on the
        device of `to` views are not checked, since the host would wait.
        """
        if self._packed is not None and view.device == self._packed[1].device:
            # On the device everything is there already, and the host does not look at the views.
            packed, numbers = self._packed
            return guided.apply_packed(packed, numbers[view], pixel, rgb, grey=GREY)
        from ..ops import guided_kernels as kernels

        # Entries of the views, and a clear word for those that have none.
        asked = view.detach().cpu()
        slot = self._numbers[asked.clamp(0, len(self._numbers) - 1)]
        missing = asked[self._slots[slot] != asked]
        if len(missing):
            raise DataError(
                f"feature store: view {int(missing.min())} has no features; {len(self._coefs)} training views have"
            )
        # The kernel takes contiguous float32 on the CPU, colours about mid-grey as they are stored.
        positions = pixel.detach().cpu().float().contiguous()
        colours = rgb.detach().cpu().float().contiguous()
        out = torch.empty(len(view), self.channels)
        tensors = slot, self._address, self._shape, self._scale, self._centre, positions, colours - GREY, out
        slots, address, shape, scale, centre, places, offsets, found = (part.numpy() for part in tensors)
        kernels.gather(slots, address, shape, scale, centre, self._coefs[0].shape[3], places, offsets, found)
        return out.to(view.device)


class Projection(NamedTuple):
    """Basis that features are projected on before they are kept."""

    dim: int
    """Principal components; fewer, where the encoder has fewer."""
    basis: Basis | None = None
    """The basis of a larger scene; None = the components of the views themselves."""


def extract(
    folder: Path,
    views: Sequence[int],
    image: Callable[[int], Annotated[Tensor, "H W 3"]],
    encoder: Encoder,
    config: GuidedConfig,
    *,
    projection: Projection | None = None,
    progress: Progress | None = None,
) -> FeatureStore:
    """The store of some views, made in `folder` as far as it is not there yet.

    `image` gives a view as uint8. A run that is cut off goes on where it stopped; where nothing can be written to
    `folder` it goes on without (`tensorfiles.keep`). Raises NumericsError where the encoder's features are not
    finite, PluginError where they are not of the shape it promises.
    """
    # Unfinished files of processes that died go; those of the last hour may belong to a living writer.
    for path in files_in(folder, ".*.safetensors"):
        with contextlib.suppress(OSError):  # another process was first
            if time.time() - path.stat().st_mtime > _UNFINISHED_SECONDS:
                path.unlink()
    # What a view's features depend on begins with its pixels.
    prints = {}
    for view in views:
        pixels = image(view)
        prints[view] = digest(str(tuple(pixels.shape)), pixels.contiguous().numpy().tobytes())
    remembered: dict[int, Tensor] = {}
    basis = None if projection is None else projection.basis
    if projection is not None and basis is None:
        basis = _basis(folder, prints, image, encoder, projection.dim, remembered)
    projected = "raw"
    if basis is not None:
        projected = digest(*(t.numpy().tobytes() for t in basis.tensors().values()))
    device = _device(encoder)
    # Other devices round otherwise; files without "float32" are from when CUDA convolved in TF32.
    place = () if device.type == "cpu" else (device.type, "float32")
    entries: dict[int, Entry] = {}
    keys = {}
    # View by view, what is not there yet.
    for done, view in enumerate(views):
        if progress is not None:
            progress(done, len(views), f"features of {encoder.identity}")
        pixels = image(view)
        radius = round(config.radius * min(pixels.shape[:2]))
        stride = min(config.stride, max(1, (2 * radius + 1) // CELLS_PER_WINDOW))
        settings = f"radius {radius} eps {config.eps!r} stride {stride} fineness {guided.FINENESS}"
        keys[view] = key = digest(prints[view], encoder.identity, settings, projected, *place)
        tensors = read_kept(folder, key)
        features = remembered.pop(view, None)
        if tensors is None or tensors.keys() != set(Entry._fields):
            if features is None:
                features = _encode(encoder, pixels, view)
            made = _make(features, pixels, basis, radius=radius, eps=config.eps, stride=stride)
            # What trains is what lies on disk, mapped rather than held in memory.
            tensors = tensorfiles.keep(folder / f"{key}.safetensors", made._asdict())
        entries[view] = Entry(**tensors)
    keep_within(folder, CACHED_BYTES, set(keys.values()))
    if progress is not None:
        progress(len(views), len(views), f"features of {encoder.identity}")
    return FeatureStore(entries, basis)


def _device(encoder: Encoder) -> torch.device:
    """Device of its parameters; the CPU where it has none."""
    weight = next(chain(encoder.parameters(), encoder.buffers()), None)
    if weight is None:
        return torch.device("cpu")
    return weight.device


@torch.no_grad()
def _encode(encoder: Encoder, pixels: Annotated[Tensor, "H W 3"], view: int) -> Annotated[Tensor, "C h w"]:
    image = (pixels.float() / 255).permute(2, 0, 1)[None]
    device = _device(encoder)
    with float32_convolutions(device):
        features: Tensor = encoder(image.to(device))
    # An encoder may be a stranger's: its mistakes are told here, not met as a strange scene.
    if features.ndim != 4 or features.shape[:2] != (1, encoder.channels) or not features.numel():
        raise PluginError(
            f"encoder {encoder.identity}: features {tuple(features.shape)} of one image; "
            f"it promises [1 {encoder.channels} h w]: report it to its author"
        )
    if not torch.isfinite(features).all():
        raise NumericsError(
            f"encoder {encoder.identity}: features of view {view} are not finite; check image and weights"
        )
    return features[0].float()


def _make(
    features: Tensor, pixels: Tensor, basis: Basis | None, *, radius: int, eps: float, stride: int
) -> Entry:
    """A view's entry: coefficients in storage form, and moments measured on what they will answer."""
    if basis is not None:
        features = basis.project(features.movedim(0, -1)).movedim(-1, 0)
    guide = pixels.float() / 255
    size = (int(pixels.shape[0]), int(pixels.shape[1]))
    coefs = guided.coefficients(features, guide, radius=radius, eps=eps, stride=stride)
    # b at mid-grey and about its mean, each channel by its largest number: half precision keeps 11 bits of
    # what is left.
    runs = coefs.detach().cpu().float().transpose(2, 3).clone()
    runs[..., 3, :] += GREY * runs[..., :3, :].sum(2)
    centre = runs[..., 3, :].mean((0, 1))
    runs[..., 3, :] -= centre
    scale = runs.abs().amax((0, 1, 2)) / TOP
    scale = torch.where(scale > 0, scale, torch.ones_like(scale))
    halves = F.pad(runs / scale, (0, -len(scale) % LANES)).half()
    entry = Entry(halves, scale, centre, torch.tensor(size), torch.zeros(2, len(scale), dtype=torch.float64))
    # Mean and variance over pixels drawn evenly.
    at = torch.randint(size[0] * size[1], (MOMENT_PIXELS,), generator=torch.Generator().manual_seed(0))
    pixel = torch.stack([at % size[1], at // size[1]], 1) + 0.5
    values = guided.apply(entry.plain(), pixel, guide.reshape(-1, 3)[at], size).double()
    return entry._replace(moments=torch.stack([values.mean(0), values.var(0, correction=0)]))


def _basis(
    folder: Path,
    prints: Mapping[int, str],
    image: Callable[[int], Tensor],
    encoder: Encoder,
    dim: int,
    remembered: dict[int, Tensor],
) -> Basis:
    """Fitted on cells drawn from up to BASIS_VIEWS views, spread evenly; kept in a file of its own."""
    # The basis depends on these views alone, so it is kept under the hash of theirs.
    views = list(prints)
    chosen = views[:: max(1, -(-len(views) // BASIS_VIEWS))]
    key = digest("basis", str(dim), str(BASIS_CELLS), encoder.identity, *(prints[view] for view in chosen))
    kept = read_kept(folder, key)
    if kept is not None:
        return Basis.from_tensors(kept)
    # As many cells of each view, drawn evenly.
    generator = torch.Generator().manual_seed(0)
    samples = []
    held = 0
    for view in chosen:
        features = _encode(encoder, image(view), view)
        held += features.numel() * 4
        if held <= REMEMBER_BYTES:
            remembered[view] = features
        cells = features.flatten(1).T.cpu()
        count = min(len(cells), max(1, BASIS_CELLS // len(chosen)))
        samples.append(cells[torch.randperm(len(cells), generator=generator)[:count]])
    basis = fit_basis(torch.cat(samples), dim)
    tensorfiles.keep(folder / f"{key}.safetensors", basis.tensors())
    return basis
