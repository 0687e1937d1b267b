"""Photographs and masks as 8-bit arrays [H W 3], sRGB, at the size that a scene's cameras have.

- Photographs of captures are taken as COLMAP takes them, because their cameras were calibrated so: the EXIF
  orientation of JPEG, PNG, WebP and TIFF is ignored. Photographs without a camera, such as references, are
  turned upright.
- Transparency of captures is composited over a background before any reduction, which averages areas.
- Of a reference, what is not at least half opaque plays no part: `Cutout` says what counts, and holds the
  colours that the file has there, not what shows when it is laid over something.

`image_files` reads the files.
"""

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import cv2
import numpy as np
import PIL.Image
from numpy.typing import NDArray

from ..errors import DataError
from .image_files import (
    Image,
    ImageHeader,
    colour_note,
    decode,
    exif_of,
    header_of,
    kind_of,
    open_image,
    opened,
    read_header,
)
from .raw import RAW_SUFFIXES, silent

if TYPE_CHECKING:
    from .scene import ParsedScene

__all__ = [
    "IMAGE_SUFFIXES",
    "WHITE",
    "Cutout",
    "Image",
    "ImageHeader",
    "colour_notes",
    "covered_mean",
    "exif_of",
    "filled",
    "has_transparency",
    "header_of",
    "image_names",
    "kind_of",
    "load_cutout",
    "load_image",
    "load_images",
    "load_mask",
    "load_preview",
    "open_image",
    "opened",
    "photographs",
    "raw_twins",
    "read_header",
    "silent",
    "transparent_fault",
    "useless_masks",
]

IMAGE_SUFFIXES = RAW_SUFFIXES | frozenset(
    {".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".heic", ".heif", ".hif", ".avif"}
)
"""Suffixes of images in a folder's list, in lower case. What a file is, its content says."""
WHITE = (1.0, 1.0, 1.0)
"""Default colour behind transparent pixels."""
MIN_OPAQUE_SHARE = 0.001
"""Share of a reference's pixels that must be opaque: less is dust that an eraser left. By eye."""

_COPIED_ROWS = 128
"""Rows that are copied at once: the whole would be copied three times, which takes as long as decoding."""
_HALF_OPAQUE = 128
"""Alpha from which on a pixel counts: more of it is seen than of what is behind."""
_SHAPE_TOLERANCE = 1e-6
"""Pixels by which a shape may deviate beyond rounding: that of floats."""


class Cutout(NamedTuple):
    """A photograph without what is behind it."""

    pixels: Image
    """Colours of the file, straight: not mixed with anything. Those of transparent pixels mean nothing."""
    opaque: Annotated[NDArray[np.bool_], "H W"] | None
    """Pixels that count; None = all."""


def load_image(
    path: Path,
    size: tuple[int, int] | None = None,
    background: Sequence[float] | None = None,
    *,
    upright: bool = False,
) -> Image:
    """An image [H W 3] in sRGB, 0 to 255, resized to `size` (width, height), or as delivered without one.

    16-bit files are rounded to 8 bits, grey ones repeated. Transparent pixels show `background` (RGB in [0,
    1]; white by default). `upright` obeys EXIF orientation. Raises DataError where the file is absent,
    truncated, damaged, of no known format or over 1e8 pixels.
    """
    colour, alpha = decode(path, upright=upright)
    pixels = _rgb(colour)
    # Straight alpha over the background.
    if alpha is not None:
        share = np.asarray(alpha, dtype=np.float32)[:, :, None] / 255
        behind = np.asarray(WHITE if background is None else background, dtype=np.float32) * 255
        pixels = np.clip(np.rint(pixels * share + behind * (1 - share)), 0, 255).astype(np.uint8)
    if size is None or size == colour.size:
        return pixels
    smaller = size[0] <= colour.width and size[1] <= colour.height
    resized = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
    return np.asarray(resized, dtype=np.uint8)


def load_cutout(path: Path) -> Cutout:
    """A reference photograph, upright, and which of its pixels count: those that are at least half opaque.

    Raises DataError as `load_image` does, and where less than a thousandth is opaque.
    """
    colour, alpha = decode(path, upright=True)
    pixels = _rgb(colour)
    if alpha is None:
        return Cutout(pixels, None)
    opaque = np.asarray(alpha) >= _HALF_OPAQUE
    if opaque.all():
        return Cutout(pixels, None)
    check_opaque(path, float(opaque.mean()))
    return Cutout(pixels, opaque)


def check_opaque(path: Path, share: float) -> None:
    """Raise DataError where the share of opaque pixels of a photograph is too small for it to show anything."""
    if share < MIN_OPAQUE_SHARE:
        raise DataError(
            f"{path}: {share:.2%} of its pixels are opaque (by half at least), {MIN_OPAQUE_SHARE:.1%} are needed; "
            "give a photograph that shows something"
        )


def load_preview(path: Path, side: int) -> NDArray[np.uint8]:
    """A reference photograph for people to look at, upright, its longer side at most `side` pixels: [H W 3],
    or [H W 4] with straight alpha where something is transparent. Raises DataError as `load_cutout` does.
    """
    colour, alpha = decode(path, upright=True)
    pixels = _rgb(colour)
    scale = min(1.0, side / max(colour.size))
    size = (max(1, round(colour.width * scale)), max(1, round(colour.height * scale)))
    if alpha is None or np.asarray(alpha).min() == 255:
        if scale == 1:
            return pixels
        return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))
    cover = np.asarray(alpha)
    check_opaque(path, float((cover >= _HALF_OPAQUE).mean()))
    # The mean colour of what is seen, by how much of it is.
    mean, reduced = covered_mean(pixels, (cover / 255).astype(np.float32), size)
    return np.dstack([mean, np.rint(reduced * 255).astype(np.uint8)])


def covered_mean(
    pixels: Image, cover: Annotated[NDArray[np.float32], "H W"], size: tuple[int, int]
) -> tuple[Image, Annotated[NDArray[np.float32], "h w"]]:
    """A picture in another size (width, height): mean colours by a weight in [0, 1], and the mean weight. Where
    nothing has any, the colour is black.
    """
    weighted = pixels * cover[:, :, None]
    sums = np.asarray(cv2.resize(weighted, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    weight = np.asarray(cv2.resize(cover, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    mean = sums / np.maximum(weight, np.finfo(np.float32).tiny)[:, :, None]
    return np.rint(mean.clip(0, 255)).astype(np.uint8), weight


def filled(pixels: Image, known: Annotated[NDArray[np.bool_], "H W"]) -> Image:
    """The picture with every pixel that is not known in the colour of the nearest known one, so that an encoder
    sees nothing foreign beside what counts. At least one must be known.
    """
    _, label = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    # Labels number the known pixels, from 1, in the order of rows.
    colour_of = np.zeros((int(label.max()) + 1, 3), dtype=np.uint8)
    colour_of[label[known]] = pixels[known]
    return np.asarray(colour_of[label])


def has_transparency(path: Path) -> bool:
    """Return true if an image has a pixel that is not opaque, and for one that cannot be decoded."""
    try:
        alpha = decode(path, upright=False).alpha
    except DataError:
        return True
    return alpha is not None and np.asarray(alpha).min() < 255


def transparent_fault(path: Path) -> str:
    """Fault of an image that is transparent all over, or nearly; empty for others. Raises DataError
    as `load_image` does.
    """
    if not read_header(path).alpha:
        return ""
    alpha = decode(path, upright=False).alpha
    try:
        check_opaque(path, 1.0 if alpha is None else float((np.asarray(alpha) >= _HALF_OPAQUE).mean()))
    except DataError as error:
        return str(error)
    return ""


def colour_notes(paths: Sequence[Path]) -> list[str]:
    """Decisions about the colours of photographs, a line for each kind; those that cannot be read are left
    to who reads them.
    """
    alike: dict[str, list[str]] = {}
    for path in paths:
        with suppress(DataError):
            alike.setdefault(colour_note(path), []).append(path.name)
    lines = []
    for note, names in alike.items():
        if note:
            if len(names) == 1:
                count = ""
            else:
                count = f" and {len(names) - 1} more"
            lines.append(f"{names[0]}{count}: {note}")
    return lines


def load_mask(path: Path, size: tuple[int, int] | None = None, *, upright: bool = False) -> NDArray[np.bool_]:
    """A mask [H W] at `size` (width, height), or as delivered without one: true where it is white or opaque.

    Alpha decides where it varies; else the luminance of the colours, also of a palette's. True is what is
    above a half. Where nothing is, as with labels 0 and 1 or red painted on black, it is what is brighter
    than the darkest pixel (than black, in a mask of one colour); not in JPEG and the like, where that would
    be noise. The nearest pixel is taken. Raises DataError as `load_image` does, and where the shape is not
    that of `size`.
    """
    # Rounded up, so that 1 of 65535 is not black.
    colour, alpha = decode(path, upright=upright, rounded=np.ceil, convert=False)
    width, height = colour.size
    if size is not None and abs(size[0] * height - size[1] * width) > width + height + size[0] + size[1]:
        raise DataError(
            f"{path}: {width}x{height} pixels do not fit an image of {size[0]}x{size[1]}; mend it"
        )
    grey = _mask_values(np.asarray(colour.convert("L")), alpha)
    half = 127
    if grey.max() <= half and read_header(path).kind in ("PNG", "BMP", "TIFF"):
        half = int(grey.min()) if np.ptp(grey) else 0
    bright = (grey > half).astype(np.uint8)
    if size is not None:
        bright = np.asarray(cv2.resize(bright, size, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)
    return bright.astype(np.bool_)


def _mask_values(grey: NDArray[np.uint8], alpha: PIL.Image.Image | None) -> NDArray[np.uint8]:
    """Channel that decides in a mask: the first of alpha and luminance that varies, else the darker of both."""
    if alpha is None:
        return grey
    opaque = np.asarray(alpha)
    if np.ptp(opaque):
        return opaque
    if np.ptp(grey):
        return grey
    return np.asarray(np.minimum(grey, opaque))


def useless_masks(scene: "ParsedScene") -> str:
    """Describe masks that leave no pixel of any view, or every pixel of all; empty for others and without
    masks.
    """
    # Masks of one colour, all of the same, mean that white and black were swapped, or that nothing was
    # painted.
    first = None
    for path in scene.masks:
        if path is None:
            share = 1.0
        else:
            share = float(load_mask(path).mean())
        first = share if first is None else first
        if share not in (0, 1) or share != first:  # masks that say something end the reading early
            return ""
    if first is None:
        return ""
    count = f"the masks of all {len(scene.masks)} views"
    if first == 0:
        return f"{count} are black: no pixel is used; paint white, or opaque, what is to be used"
    return f"{count} are white: every pixel is used; paint black, or transparent, what is to be left out"


def load_images(
    scene: "ParsedScene", background: Sequence[float] | None = None, views: Sequence[int] | None = None
) -> list[Image]:
    """Views of a scene (all, in the scene's order, where none are named) at their cameras' sizes, which may
    differ.

    Raises DataError as `load_image` does, and where a file's shape has changed since the scene was parsed.
    """

    def load(view: int) -> Image:
        path = scene.paths[view]
        (width, height) = scene.cameras.size[view].tolist()
        header = read_header(path)
        # Both sides were rounded to whole pixels: a larger deviation is another shape, not another scale.
        rounding = 0.5 * (header.width + header.height) + _SHAPE_TOLERANCE
        if abs(width * header.height - height * header.width) > rounding:
            raise DataError(
                f"{path}: {header.width}x{header.height} pixels do not fit its camera's {width}x{height}; "
                "restore the image (was it rotated or cropped?) or run the reconstruction again"
            )
        return load_image(path, (width, height), background)

    with ThreadPoolExecutor() as pool:
        return list(pool.map(load, range(len(scene.paths)) if views is None else views))


def image_names(folder: Path) -> list[str]:
    """Sorted names of the images directly in a folder, hidden files and raw twins left out; DataError where
    there is none.
    """
    try:
        entries = os.listdir(folder)
    except OSError as error:
        raise DataError(
            f"{folder}: no such image folder ({error.strerror}); name it or put the images there"
        ) from error
    # Hidden files are what other systems leave behind, such as ._0001.jpg.
    names = sorted(n for n in entries if Path(n).suffix.lower() in IMAGE_SUFFIXES and not n.startswith("."))
    if not names:
        raise DataError(
            f"{folder}: no image among {len(entries)} files; put PNG, JPEG, WebP, BMP, TIFF, HEIC or AVIF images there"
        )
    twins = set()
    for path in raw_twins(Path(name) for name in names):
        twins.add(path.name)
    found: list[str] = []
    for name in names:
        if name not in twins:
            found.append(name)
    return found


def raw_twins(paths: Iterable[Path]) -> list[Path]:
    """Raw photographs that lie beside a developed one of the same name, as cameras write both: the same picture
    a second time.
    """
    listed = list(paths)
    developed = set()
    for path in listed:
        if path.suffix.lower() not in RAW_SUFFIXES:
            developed.add(path.with_suffix("").as_posix().lower())
    twins = []
    for path in listed:
        if path.suffix.lower() in RAW_SUFFIXES and path.with_suffix("").as_posix().lower() in developed:
            twins.append(path)
    return twins


def photographs(paths: Sequence[Path], report: Callable[[str], None]) -> list[Path]:
    """The files among the paths and the images in the folders, each once; those of a folder in the order of
    their names.

    An image in a folder that cannot be read is left out, and `report` is given the reason. Raises DataError
    for a folder without a readable image.
    """
    # Those of folders are tried; those that are named are taken as they are.
    listed: dict[Path, None] = {}
    for path in paths:
        if path.is_dir():
            found = _readable(path, report)
        else:
            found = [path]
        listed |= dict.fromkeys(found)
    return list(listed)


def _readable(folder: Path, report: Callable[[str], None]) -> list[Path]:
    """The images of a folder that can be references."""
    images = []
    for name in image_names(folder):
        images.append(folder / name)
    # Decoding runs in threads.
    with ThreadPoolExecutor() as pool:
        faults = list(pool.map(_fault, images))
    reasons = []
    for reason in faults:
        if reason:
            reasons.append(reason)
    for reason in reasons:
        report(f"left out: {reason}")
    if len(reasons) == len(images):
        raise DataError(
            f"{folder}: none of its {len(images)} images can be read; the first one: {reasons[0]}"
        )
    found: list[Path] = []
    for image, reason in zip(images, faults, strict=True):
        if not reason:
            found.append(image)
    return found


def _fault(path: Path) -> str:
    """Fault of a reference photograph; empty for a good one."""
    try:
        load_cutout(path)
    except DataError as error:
        return str(error)
    return ""


def _rgb(colour: PIL.Image.Image) -> Image:
    """The pixels of an image [H W 3]."""
    rgb = colour if colour.mode == "RGB" else colour.convert("RGB")
    pixels = np.empty((rgb.height, rgb.width, 3), dtype=np.uint8)
    for top in range(0, rgb.height, _COPIED_ROWS):
        bottom = min(top + _COPIED_ROWS, rgb.height)
        pixels[top:bottom] = np.asarray(rgb.crop((0, top, rgb.width, bottom)))
    return pixels
