"""SOG (PlayCanvas): a meta.json and lossless WebP images, a pixel a Gaussian, in a folder or bundled in a
.sog archive.

means     two images, 16 bits between mins and maxs of sign(x) ln(1 + |x|)
quats     the three smaller components times sqrt 2 as bytes; alpha - 252 says which one is missing (w x y z)
scales    ln-scales, sh0 constants (alpha: opacity): indices into codebooks of 256 numbers
shN       labels of 16 bits into a palette of harmonics, 64 entries a row, which are indices into a codebook
`antialias` or `model` ("antialiased", "2dgs") say what the Gaussians are. An archive may hold all that in a
folder. Version 1 has ranges (mins, maxs) in the place of codebooks, and logits in sh0's alpha.

Recoloured, a file keeps its labels: each entry of the palette becomes the mean of what its Gaussians became.
"""

import io
import json
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ...datamanagers.images import header_of
from ...errors import DataError
from ...io.atomic import atomic_path
from ...rendering.north import Bearings
from ...types import Origin
from ..gaussians import COUNTS, Gaussians
from . import base
from .base import Bools, Capture, CaptureFormat, Data, Floats
from .sog_archive import bundle, folder_files, folder_of, image_names, read_meta, unbundle
from .sog_images import (
    CODEBOOK_NUMBERS,
    ENTRIES_PER_ROW,
    MAX_PALETTE_ENTRIES,
    ByteImage,
    label_means,
    lossless_webp,
    palette_labels,
    palette_picture,
    picture_of_rows,
    quantized,
)

_MAX_PIXELS_PER_BYTE = 8
"""Pixels a byte of the low image of positions at most: captures have far fewer, and it bounds what is
decoded.
"""
_SLACK_PIXELS = 1 << 16
"""Pixels or Gaussians that any image may have, whatever its bytes: small ones shrink more."""
_MAX_STEP_OF_SOG = 2.0**-12
"""Steps of positions in extents of the capture, to which outliers do not matter."""
_POSITION_STEPS = 65535
"""Of positions between their bounds: 16 bits."""
_MAX_LN_POSITION = 80.0
"""Of positions that are read, as logarithms: beyond, no float32 holds them."""
_LN_SIZES_OF_SOG = (-20.0, 20.0)
"""ln-scales that are written: what lies beyond would spoil the codebook of the others."""
_TURN_TAG = 252
"""Added to the number of the component of a rotation that is left out, in its alpha."""


@dataclass(frozen=True, kw_only=True)
class Sog(CaptureFormat):
    """PlayCanvas' .sog, or the meta.json of a folder, read in versions 1 and 2 and written in version 2."""

    def recognises(self, head: bytes, size: int) -> bool:
        return head.startswith(b"PK")

    def read(self, path: Path, data: Data) -> Capture:
        """A .sog archive, or the meta.json of a folder. Raises DataError for what is neither."""
        if data[:2] == b"PK":
            data = bytes(data)
        else:
            data = bundle(folder_files(path, bytes(data)))
        files = unbundle(path, data)
        folder = folder_of(path, files)
        parts = {}
        for name, content in files.items():
            if name.startswith(folder):
                parts[name.removeprefix(folder)] = content
        rows = _Rows(path, parts)

        def recolour(harmonics: Floats, changed: Bools) -> list[bytes]:
            new = {}
            for name, content in rows.recoloured(harmonics).items():
                new[folder + name] = content
            return [bundle(files | new, like=data)]

        gaussians, shift = base.decoded(rows.bands, (rows.count, rows.decoded))
        capture = Capture(path, gaussians, rows.antialiased, data, recolour, shift=shift)
        said = read_meta(path, parts["meta.json"]).get(base.OWN_KEY)
        if not isinstance(said, dict):
            return capture
        return base.with_said_bearings(capture, said.get("north"), said.get("up"))

    def keeps(self, gaussians: Gaussians) -> Bools:
        """All but outliers that would cost the others their 16 bits."""

        def step(kept: Floats, inner: Floats) -> float:
            ends = [_bent(kept.min(0)), _bent(kept.max(0))]
            return float(((ends[1] - ends[0]) / _POSITION_STEPS * (1 + np.abs(inner).max(0))).max())

        return base.precise(gaussians.means.numpy().astype(np.float64), step, _MAX_STEP_OF_SOG)

    def pack(self, gaussians: Gaussians, antialiased: bool, origin: Origin) -> list[bytes]:
        """A bundled file of version 2. Gaussians are put in spatial order, by which the images shrink."""
        gaussians = gaussians.select(torch.from_numpy(base.spatial_order(gaussians.means.numpy())))
        means, turns, log_scales, logits, harmonics = base.arrays(gaussians)
        count = len(means)
        # Images are about square, with a width that WebP likes.
        width = -(-int(np.ceil(count**0.5)) // 4) * 4
        shape = (-(-count // max(width, 1)), width)
        bent = _bent(means.astype(np.float64))
        least = bent.min(0)
        most = bent.max(0)
        at = base.steps(base.shares(bent, least, most), _POSITION_STEPS)
        # Rotations and opacities take 8 bits a number; sizes and constants share codebooks of 256.
        largest, three = base.smallest_three(turns)
        turn = np.concatenate([base.steps(three / 2 + 0.5, 255), largest[:, None] + _TURN_TAG], 1)
        opacity = base.steps(base.sigmoid(logits), 255)
        ln_sizes = log_scales.clip(*_LN_SIZES_OF_SOG)
        scale, scales = quantized(ln_sizes, {"files": ["scales.webp"], "codebook": []})
        tint, sh0 = quantized(harmonics[:, 0], {"files": ["sh0.webp"], "codebook": []})
        pictures = {
            "means_l.webp": picture_of_rows(at & 255, shape),
            "means_u.webp": picture_of_rows(at >> 8, shape),
            "quats.webp": picture_of_rows(turn, shape),
            "scales.webp": picture_of_rows(scale, shape),
            "sh0.webp": picture_of_rows(np.concatenate([tint, opacity[:, None]], 1), shape),
        }
        bounds = {"mins": least.tolist(), "maxs": most.tolist(), "files": ["means_l.webp", "means_u.webp"]}
        meta: dict[str, Any] = {"version": 2, "count": count}
        if antialiased:
            meta |= {"antialias": True, "model": "antialiased"}
        meta |= {"means": bounds, "scales": scales, "quats": {"files": ["quats.webp"]}, "sh0": sh0}
        if gaussians.degree > 0:
            palette, meta["shN"] = _packed_palette(harmonics, gaussians.degree, shape)
            pictures |= palette
        parts = {}
        for name, picture in pictures.items():
            parts[name] = lossless_webp(picture)
        return [bundle(parts | {"meta.json": json.dumps(meta, separators=(",", ":")).encode()})]

    def with_bearings(self, pieces: Iterable[bytes], bearings: Bearings) -> list[bytes]:
        """With a key of its own in meta.json."""
        data = b"".join(pieces)
        files = unbundle(Path("meta.json"), data)
        meta = json.loads(files["meta.json"]) | {base.OWN_KEY: bearings._asdict()}
        files["meta.json"] = json.dumps(meta, separators=(",", ":")).encode()
        return [bundle(files)]

    def write(self, path: Path, pieces: Iterable[bytes]) -> None:
        """An archive; of a meta.json its files, into the same folder: while images are replaced it has no
        meta.json.
        """
        if path.name.lower() != "meta.json":
            super().write(path, pieces)
            return
        files = unbundle(path, b"".join(pieces))
        folder = folder_of(path, files)
        names = dict.fromkeys(("meta.json", *image_names(path, read_meta(path, files[f"{folder}meta.json"]))))
        with ExitStack() as stack:
            # Files take their names from the last to the first.
            for name in names:
                if f"{folder}{name}" in files:
                    stack.enter_context(atomic_path(path.with_name(name))).write_bytes(
                        files[f"{folder}{name}"]
                    )
            path.with_name("meta.json").unlink(missing_ok=True)


class _Rows:
    """The Gaussians of a file, of which some rows at a time are decoded."""

    def __init__(self, path: Path, parts: Mapping[str, bytes]) -> None:
        self.parts = parts
        meta = read_meta(path, parts["meta.json"])
        # Version 1 has no such entry.
        version = meta.get("version", 1)
        if version not in (1, 2):
            raise DataError(f"{path}: SOG of version {version!r}; versions 1 and 2 are read")
        pictures = _Pictures(path, parts, meta)
        self.version = version
        self.flat = meta.get("model") == "2dgs"
        self.antialiased = meta.get("antialias") is True or meta.get("model") == "antialiased"
        self.pictures = pictures
        self.count = pictures.count
        self.low = pictures.rows("means", 0)[:, :3]
        self.high = pictures.rows("means", 1)[:, :3]
        self.least = pictures.numbers("means", "mins", 3)
        self.most = pictures.numbers("means", "maxs", 3)
        self.turn = pictures.rows("quats", 0)
        self.scale = pictures.rows("scales", 0)
        self.tint = pictures.rows("sh0", 0)
        self.labels, self.rest = pictures.palette()
        self.bands = 1 + self.rest.shape[1]

    def decoded(self, rows: slice) -> tuple[Floats, ...]:
        """Some of them as `base.decoded` wants them."""
        # Positions are 16 bits of a logarithm, low bytes in one image and high bytes in the other.
        steps = self.high[rows].astype(np.int64) << 8 | self.low[rows]
        bent = self.least + steps / _POSITION_STEPS * (self.most - self.least)
        means = np.sign(bent) * np.expm1(np.minimum(np.abs(bent), _MAX_LN_POSITION))
        tag = self.turn[rows, 3].astype(np.int64) - _TURN_TAG
        quaternions = base.three_to_four(np.clip(tag, 0, 3), self.turn[rows, :3] / 255 * 2 - 1)
        quaternions[tag < 0] = (1, 0, 0, 0)
        scales = self.pictures.decoded("scales", self.scale[rows, :3], 3)
        if self.flat:
            scales[:, 2] = -np.inf
        # The alpha of sh0: opacities as they are, or, in version 1, logits of a range of their own.
        if self.version == 2:
            constants = self.pictures.decoded("sh0", self.tint[rows, :3], 3)
            logits = base.logit(self.tint[rows, 3] / 255)
        else:
            constants, logits = np.split(self.pictures.decoded("sh0", self.tint[rows], 4), [3], 1)
        harmonics = constants[:, None]
        if len(self.rest):
            harmonics = np.concatenate([harmonics, self.rest[self.labels[rows]]], 1)
        return means, quaternions, scales, logits.reshape(-1), harmonics

    def recoloured(self, harmonics: Floats) -> dict[str, bytes]:
        """The files that change with other harmonics: constants are quantised anew, with a codebook or a range
        of their own.
        """
        new = {}
        said = json.loads(self.parts["meta.json"])
        name = said["sh0"]["files"][0]
        index, said["sh0"] = quantized(harmonics[:, 0], said["sh0"])
        picture = self.pictures.picture(name)
        picture.reshape(-1, 4)[: self.count, :3] = index
        new[name] = lossless_webp(picture)
        if len(self.rest):
            # Labels stay: an entry of the palette becomes the mean of what its Gaussians became.
            entries = len(self.rest)
            mixed = label_means(harmonics[:, 1:].reshape(self.count, -1), self.labels, entries)
            seen = np.bincount(self.labels, minlength=entries) > 0
            palette = np.where(seen[:, None, None], mixed.reshape(self.rest.shape), self.rest)
            name = said["shN"]["files"][0]
            index, said["shN"] = quantized(palette, said["shN"])
            new[name] = lossless_webp(palette_picture(index))
        new["meta.json"] = json.dumps(said, separators=(",", ":")).encode()
        return new


def _packed_palette(
    harmonics: Floats, degree: int, shape: tuple[int, int]
) -> tuple[dict[str, ByteImage], dict[str, Any]]:
    """The images of all harmonics but the constants, and what meta.json says of them: whole rows share a
    palette, whose entries share a codebook.
    """
    rows = harmonics[:, 1:].reshape(len(harmonics), -1)
    labels = palette_labels(rows)
    used = int(labels.max()) + 1
    entries = label_means(rows, labels, used).reshape(used, -1, 3)
    files = ["shN_centroids.webp", "shN_labels.webp"]
    index, said = quantized(entries, {"count": used, "bands": degree, "codebook": [], "files": files})
    bytes_of_labels = np.stack([labels & 255, labels >> 8, 0 * labels], 1)
    return {files[0]: palette_picture(index), files[1]: picture_of_rows(bytes_of_labels, shape)}, said


def _bent(means: Floats) -> Floats:
    return np.sign(means) * np.log1p(np.abs(means))


class _Pictures:
    """The decoded images of a capture, and the numbers that its meta.json gives them."""

    def __init__(self, path: Path, parts: Mapping[str, bytes], meta: Mapping[str, Any]) -> None:
        self.path = path
        self.parts = parts
        self.meta = meta
        # Version 1 has the number of Gaussians as the shape of their means.
        count = meta.get("count")
        if "count" not in meta and isinstance(meta.get("means"), dict):
            shape = meta["means"].get("shape")
            if isinstance(shape, list) and shape:
                count = shape[0]
        name = self._name("means", 0)
        if count == 0:
            raise DataError(f"{path}: holds no Gaussian")
        if (
            not isinstance(count, int)
            or isinstance(count, bool)
            or not 0 < count <= _MAX_PIXELS_PER_BYTE * len(parts[name]) + _SLACK_PIXELS
        ):
            raise self._wrong(f"{count!r} Gaussians with {len(parts[name])} bytes of positions")
        self.count: int = count

    def numbers(self, group: str, name: str, length: int, least: int | None = None) -> Floats:
        """A list of so many finite numbers, or from `least` on."""
        if least is None:
            least = length
        try:
            value = self.meta[group][name]
            # Exporters write null in the place of the first number of a codebook that is not finite.
            if name == "codebook" and value[:1] == [None]:
                value = value[1:2] + value[1:]
            values = np.array(value, dtype=np.float64)
        except (LookupError, TypeError, ValueError, OverflowError):
            values = np.zeros(0)
        if values.ndim != 1 or not least <= len(values) <= length or not np.isfinite(values).all():
            many = length if least == length else f"{least} to {length}"
            raise self._wrong(f"{group}.{name} is no list of {many} numbers")
        return values

    def picture(self, name: str, most: int | None = None) -> ByteImage:
        """An image [H W 4], RGBA, of at most so many pixels."""
        if most is None:
            most = 2 * self.count + _SLACK_PIXELS
        try:
            header = header_of(io.BytesIO(self.parts[name]), name)
        except DataError:
            header = None
        if (
            header is None
            or header.kind not in ("WebP", "PNG")
            or not 0 < header.width * header.height <= most
        ):
            raise self._wrong(f"{name} is no image of at most {most} pixels")
        try:
            image = cv2.imdecode(np.frombuffer(self.parts[name], np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            image = None
        if image is None or image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] not in (3, 4):
            raise self._wrong(f"{name} cannot be decoded")
        if image.shape[2] == 3:
            return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGBA), np.uint8)
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA), np.uint8)

    def rows(self, group: str, which: int) -> ByteImage:
        """The pixels [N 4] of an image, one a Gaussian."""
        name = self._name(group, which)
        pixels = self.picture(name).reshape(-1, 4)
        if len(pixels) < self.count:
            raise self._wrong(f"{name} has {len(pixels)} pixels for {self.count} Gaussians")
        return pixels[: self.count]

    def decoded(self, group: str, index: NDArray[np.integer[Any]], channels: int) -> Floats:
        """Bytes as the numbers that they stand for: by the codebook, or between mins and maxs."""
        if isinstance(self.meta[group], dict) and "codebook" in self.meta[group]:
            return np.asarray(self.book(group, index)[index])
        low = self.numbers(group, "mins", channels)
        high = self.numbers(group, "maxs", channels)
        return np.asarray(low + index / 255 * (high - low))

    def book(self, group: str, index: NDArray[np.integer[Any]]) -> Floats:
        """A codebook: of as many numbers, at least, as indices use."""
        return self.numbers(group, "codebook", CODEBOOK_NUMBERS, int(index.max(initial=0)) + 1)

    def palette(self) -> tuple[NDArray[np.int64], Floats]:
        """The label of each Gaussian, and the harmonics that labels mean [entries K-1 3]; no entries where it
        has none.
        """
        about = self.meta.get("shN")
        if about is None:
            return np.zeros(self.count, np.int64), np.zeros((0, 0, 3))
        name = self._name("shN", 0)
        picture = self.picture(name, MAX_PALETTE_ENTRIES * max(COUNTS))
        coefficients = picture.shape[1] // ENTRIES_PER_ROW
        entries = picture.shape[0] * ENTRIES_PER_ROW
        if picture.shape[1] % ENTRIES_PER_ROW or coefficients + 1 not in COUNTS or coefficients == 0:
            raise self._wrong(
                f"{name} is {picture.shape[1]} pixels wide; {ENTRIES_PER_ROW} entries of 3, 8 or 15 harmonics are a row"
            )
        index = picture[..., :3].reshape(entries, coefficients, 3)
        if "codebook" in about:
            rest = self.book("shN", index)[index]
        else:
            low = about.get("mins")
            high = about.get("maxs")
            if not all(isinstance(v, (int, float)) and abs(v) < 1e6 for v in (low, high)):
                raise self._wrong("shN.mins and shN.maxs are no numbers")
            rest = low + index / 255 * (high - low)
        pixels = self.rows("shN", 1).astype(np.int64)
        labels = pixels[:, 0] | pixels[:, 1] << 8
        if int(labels.max(initial=0)) >= entries:
            raise self._wrong(f"label {int(labels.max())} in a palette of {entries} entries")
        return labels, rest

    def _name(self, group: str, which: int) -> str:
        """Name of an image that the archive holds."""
        try:
            name = str(self.meta[group]["files"][which])
        except (LookupError, TypeError):
            name = ""
        if name not in self.parts:
            raise self._wrong(f"no image {which + 1} of {group}")
        return name

    def _wrong(self, what: str) -> DataError:
        return DataError(f"{self.path}: {what}; not a SOG file, or it is damaged")
