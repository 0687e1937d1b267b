"""Image files to 8-bit arrays [H W 3], sRGB, at the size that a scene's cameras have.

Pillow decodes them; of a file with several images the first one counts. What a file's pixels are is decided
in `_decode`:

- Photographs of captures are taken as COLMAP takes them, because their cameras were calibrated so: the EXIF
  orientation of JPEG, PNG, WebP and TIFF is ignored. Photographs without a camera, such as references, are
  turned upright.
- HEIC and AVIF store their rotation in the image itself (`irot`, `imir`), which every decoder applies: always
  upright.
- Colours of an embedded ICC profile become sRGB. A profile that is broken or does not fit the pixels is
  ignored.
- Transparency is straight (not premultiplied) and composited before any reduction, which averages areas.

Opening a file reads its header only, so that sizes are checked before anything is decoded.
"""

import os
import re
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import IO, TYPE_CHECKING, NamedTuple, TypeAlias

import cv2
import numpy as np
import PIL.Image
from numpy.typing import NDArray
from PIL import ImageCms
from PIL.AvifImagePlugin import AvifImageFile
from PIL.BmpImagePlugin import BmpImageFile
from PIL.ExifTags import Base as Tag
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.TiffImagePlugin import TiffImageFile
from PIL.WebPImagePlugin import WebPImageFile

from ..errors import DataError

if TYPE_CHECKING:
    from .scene import ParsedScene

IMAGE_SUFFIXES = frozenset(
    {".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".heic", ".heif", ".hif", ".avif"}
)
"""Suffixes of images in a folder's list, in lower case. What a file is, its content says."""
MAX_PIXELS = 100_000_000
"""Files that claim more are refused before they are decoded."""
WHITE = (1.0, 1.0, 1.0)
"""Default colour behind transparent pixels."""

Image: TypeAlias = NDArray[np.uint8]


def _open_heif(file: IO[bytes]) -> ImageFile:
    """Open HEIC with the optional package, without registering it with Pillow for the whole process."""
    from pillow_heif import HeifImageFile

    image: ImageFile = HeifImageFile(file)
    return image


_READERS: dict[str, tuple[bytes, Callable[[IO[bytes]], ImageFile]]] = {
    "JPEG": (rb"\xff\xd8\xff", JpegImageFile),
    "PNG": (rb"\x89PNG\r\n\x1a\n", PngImageFile),
    "WebP": (rb"RIFF.{4}WEBP", WebPImageFile),
    "BMP": (rb"BM", BmpImageFile),
    "TIFF": (rb"II[*+]\0|MM\0[*+]", TiffImageFile),
    "AVIF": (rb".{4}ftyp(.{4}){0,9}avi[fs]", AvifImageFile),
    "HEIC": (rb".{4}ftyp(.{4}){0,9}(hei[cmsx]|hev[cmsx]|mif1|msf1)", _open_heif),
}
"""Each format's first bytes and reader. `PIL.Image.open` is not used: it warns of large images, tries formats
that we don't want, and HEIC would have to be registered.
"""
_TURNS = {
    2: PIL.Image.Transpose.FLIP_LEFT_RIGHT,
    3: PIL.Image.Transpose.ROTATE_180,
    4: PIL.Image.Transpose.FLIP_TOP_BOTTOM,
    5: PIL.Image.Transpose.TRANSPOSE,
    6: PIL.Image.Transpose.ROTATE_270,
    7: PIL.Image.Transpose.TRANSVERSE,
    8: PIL.Image.Transpose.ROTATE_90,
}
"""Transpose that turns an image upright, by its EXIF orientation."""
_STRIP = 128
"""Rows that are copied at once."""
_WARNINGS = threading.Lock()


class ImageHeader(NamedTuple):
    """Header of an image file: of the pixels that `load_image` delivers where they are not turned upright."""

    width: int
    height: int
    alpha: bool
    kind: str
    """JPEG, PNG, WebP, BMP, TIFF, AVIF or HEIC."""


def read_header(path: Path) -> ImageHeader:
    """The header of an image file. Raises DataError where the file is absent, empty, or of no known
    format.
    """
    with opened(path) as file:
        return header_of(file, path)


def header_of(file: IO[bytes], name: object) -> ImageHeader:
    """The header of an open file. Raises DataError, which begins with `name`, where it is empty or of no
    known format.
    """
    kind, image = open_image(file, name)
    width, height = image.size
    if isinstance(image, TiffImageFile):  # Pillow gives the size that they have upright
        width = image.tag_v2[Tag.ImageWidth]
        height = image.tag_v2[Tag.ImageLength]
    elif kind == "AVIF" and exif_orientation(image) > 4:
        width, height = height, width
    return ImageHeader(width, height, image.has_transparency_data, kind)


def open_image(file: IO[bytes], name: object) -> tuple[str, ImageFile]:
    """The format of an open file and its first image, of which only the header was read. Raises DataError as
    `header_of`.
    """
    # The first bytes say the format, whatever the name says.
    file.seek(0)
    head = file.read(64)
    if not head:
        raise DataError(f"{name}: the file is empty; restore the image or remove it from the scene")
    kind = kind_of(head)
    if not kind:
        raise DataError(
            f"{name}: no PNG, JPEG, WebP, BMP, TIFF, HEIC or AVIF header; replace the file or convert the image to PNG"
        )
    file.seek(0)
    with _decoding(kind, name), silent():
        return kind, _READERS[kind][1](file)


def kind_of(head: bytes) -> str:
    """The format of a file by its first 64 bytes: JPEG, PNG, WebP, BMP, TIFF, AVIF or HEIC; empty for
    another.
    """
    return next((kind for kind, (first, _) in _READERS.items() if re.match(first, head, re.DOTALL)), "")


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
    colour, alpha = _decode(path, upright)
    rgb = colour if colour.mode == "RGB" else colour.convert("RGB")
    pixels = np.empty((rgb.height, rgb.width, 3), dtype=np.uint8)
    # In strips: the whole would be copied three times, which takes as long as decoding.
    for top in range(0, rgb.height, _STRIP):
        pixels[top : top + _STRIP] = np.asarray(rgb.crop((0, top, rgb.width, min(top + _STRIP, rgb.height))))
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


def has_transparency(path: Path) -> bool:
    """Return true if an image has a pixel that is not opaque, and for one that cannot be decoded."""
    try:
        alpha = _decode(path, upright=False)[1]
    except DataError:
        return True
    return alpha is not None and np.asarray(alpha).min() < 255


def load_mask(path: Path, size: tuple[int, int] | None = None, *, upright: bool = False) -> NDArray[np.bool_]:
    """A mask [H W] at `size` (width, height), or as delivered without one: true where it is white or opaque.

    Alpha decides where it varies; else the luminance of the colours, also of a palette's. True is what is
    above a half. Where nothing is, as with labels 0 and 1 or red painted on black, it is what is brighter
    than the darkest pixel (than black, in a mask of one colour); not in JPEG and the like, where that would
    be noise. The nearest pixel is taken. Raises DataError as `load_image` does, and where the shape is not
    that of `size`.
    """
    colour, alpha = _decode(path, upright, np.ceil)  # so that 1 of 65535 is not black
    width, height = colour.size
    if size is not None and abs(size[0] * height - size[1] * width) > width + height + size[0] + size[1]:
        raise DataError(
            f"{path}: {width}x{height} pixels do not fit an image of {size[0]}x{size[1]}; mend it"
        )
    # What varies decides: alpha, else luminance, else the darker of both.
    grey = np.asarray(colour.convert("L"))
    if alpha is not None:
        opaque = np.asarray(alpha)
        if np.ptp(opaque):
            grey = opaque
        elif np.ptp(grey):
            grey = grey
        else:
            grey = np.minimum(grey, opaque)
    half = 127
    if grey.max() <= half and read_header(path).kind in ("PNG", "BMP", "TIFF"):
        half = int(grey.min()) if np.ptp(grey) else 0
    bright = (grey > half).astype(np.uint8)
    return np.asarray(
        bright if size is None else cv2.resize(bright, size, interpolation=cv2.INTER_NEAREST)
    ).astype(np.bool_)


def useless_masks(scene: "ParsedScene") -> str:
    """Describe masks that leave no pixel of any view, or every pixel of all; empty for others and without
    masks.
    """
    # Masks of one colour, all of the same, mean that white and black were swapped, or that nothing was
    # painted.
    first = None
    for path in scene.masks:
        share = 1.0 if path is None else float(load_mask(path).mean())
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
        if abs(width * header.height - height * header.width) > 0.5 * (header.width + header.height) + 1e-6:
            raise DataError(
                f"{path}: {header.width}x{header.height} pixels do not fit its camera's {width}x{height}; "
                "restore the image (was it rotated or cropped?) or run the reconstruction again"
            )
        return load_image(path, (width, height), background)

    with ThreadPoolExecutor() as pool:
        return list(pool.map(load, range(len(scene.paths)) if views is None else views))


def image_names(folder: Path) -> list[str]:
    """Sorted names of the images directly in a folder, hidden files left out; DataError where there is
    none.
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
    return names


def photographs(paths: Sequence[Path], report: Callable[[str], None]) -> list[Path]:
    """The files among the paths and the images in the folders, each once; those of a folder in the order of
    their names.

    An image in a folder that cannot be read is left out, and `report` is given the reason. Raises DataError
    for a folder without a readable image.
    """

    def fault(path: Path) -> str:
        try:
            load_image(path)
        except DataError as error:
            return str(error)
        return ""

    # Those of folders are tried, in threads; those that are named are taken as they are.
    listed: dict[Path, None] = {}
    for path in paths:
        if path.is_dir():
            images = [path / name for name in image_names(path)]
        else:
            images = []
        with ThreadPoolExecutor() as pool:
            faults = dict(zip(images, pool.map(fault, images), strict=True))
        for reason in filter(None, faults.values()):
            report(f"left out: {reason}")
        if images and all(faults.values()):
            raise DataError(
                f"{path}: none of its {len(images)} images can be read; the first one: {faults[images[0]]}"
            )
        listed |= dict.fromkeys([image for image in images if not faults[image]] if images else [path])
    return list(listed)


def _decode(
    path: Path, upright: bool, rounded: Callable[[NDArray[np.float32]], NDArray[np.float32]] = np.rint
) -> tuple[PIL.Image.Image, PIL.Image.Image | None]:
    """The colours of a file in mode L, RGB or CMYK, sRGB where it has a profile, and its alpha in mode L
    where it has one.

    Colours of 16 bits become 8 with `rounded`.
    """
    with opened(path) as file:
        kind, image = open_image(file, path)
        # For TIFF Pillow has a limit of its own, above which it warns.
        if kind == "TIFF":
            most = min(MAX_PIXELS, PIL.Image.MAX_IMAGE_PIXELS or MAX_PIXELS)
        else:
            most = MAX_PIXELS
        if image.width * image.height > most:
            raise DataError(
                f"{path}: {image.width}x{image.height} pixels; at most {most:.0e} are read: reduce the image"
            )
        with _decoding(kind, path, 8 * image.width * image.height):
            if kind == "PNG":
                image.verify()  # the checksums, which loading ignores; it uses the image up
                image = open_image(file, path)[1]
                if (
                    "transparency" in image.info
                ):  # Pillow scales grey of 2 and 4 bits, but not the transparent one
                    image.info["transparency"] *= {"L;2": 85, "L;4": 17}.get(str(image.tile[0].args), 1)
            deep = ";16" in str(image.tile)
            # Decode, and find the orientation by which the pixels are still to be turned.
            stored = exif_orientation(image) if kind == "TIFF" else 1
            image.load()
            if kind == "TIFF":
                # Pillow has turned them: they are turned back. 6 and 8 are each other's inverse, the rest
                # their own.
                if upright:
                    stored = 1
                else:
                    stored = {6: 8, 8: 6}.get(stored, stored)
            elif kind == "AVIF" or (upright and kind != "HEIC"):
                stored = exif_orientation(image)
            turn = _TURNS.get(stored)
    # Grey of 16 bits and what is transparent in it; colours of 16 bits; transparency of the others; then few
    # modes are left.
    profile = image.info.get("icc_profile")
    alpha = None
    pixels: PIL.Image.Image = image
    if image.mode.startswith("I;16"):
        values = np.asarray(image)
        if "transparency" in image.info:
            alpha = PIL.Image.fromarray(np.uint8(255) * (values != image.info["transparency"]))
        pixels = PIL.Image.fromarray(rounded(values * np.float32(255 / 65535)).astype(np.uint8))
    elif image.mode in ("I", "F"):
        raise DataError(f"{path}: pixels of 32 bits; 8 or 16 bits a channel are read: convert the image")
    elif deep:
        pixels = _from_16_bits(path, image, rounded)
    if alpha is None and pixels.has_transparency_data:
        grey = pixels.mode in ("1", "L", "LA")
        pixels = pixels.convert("RGBA")
        alpha = pixels.getchannel("A")
        if grey:
            pixels = pixels.getchannel("R")
        else:
            pixels = pixels.convert("RGB")
    if pixels.mode not in ("L", "RGB", "CMYK"):
        pixels = pixels.convert("L" if pixels.mode == "1" else "RGB")
    # To sRGB, and upright.
    if profile:
        mode, transform = _transform(profile)
        if mode == "RGB" and pixels.mode == "L":
            pixels = pixels.convert("RGB")
        if transform is None or pixels.mode != mode:
            pixels = pixels
        else:
            pixels = transform.apply(pixels)
    if turn is not None:
        pixels = pixels.transpose(turn)
        alpha = alpha and alpha.transpose(turn)
    return pixels, alpha


def exif_orientation(image: ImageFile) -> int:
    """The EXIF orientation, 1 to 8; 1 where the file says none, or nothing that can be understood."""
    try:
        with silent():
            found = image.getexif().get(Tag.Orientation, 1)
    except Exception:  # whatever is wrong with the block, the pixels are whole
        return 1
    return int(found) if found in _TURNS else 1


def _from_16_bits(
    path: Path, image: PIL.Image.Image, rounded: Callable[[NDArray[np.float32]], NDArray[np.float32]]
) -> PIL.Image.Image:
    """Colours of 16 bits, rounded, by OpenCV: Pillow keeps their upper 8 bits only. Pillow's where the two
    disagree.
    """
    flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    found = cv2.imdecode(np.fromfile(path, dtype=np.uint8), flags)
    if found is None or found.dtype != np.uint16 or found.shape[2:] not in ((3,), (4,)):
        return image
    eight = rounded(found[:, :, [2, 1, 0, 3][: found.shape[2]]] * np.float32(255 / 65535)).astype(np.uint8)
    upper = np.asarray(image.convert("RGB"), dtype=np.int16)
    same = eight.shape[:2] == upper.shape[:2] and np.abs(eight[:, :, :3] - upper).max() <= 1
    return PIL.Image.fromarray(eight) if same else image


@lru_cache(maxsize=16)
def _transform(profile: bytes) -> tuple[str, ImageCms.ImageCmsTransform | None]:
    """The mode that a profile is for, and the transform to sRGB; None for sRGB itself and for what is
    broken.
    """
    try:
        given = ImageCms.ImageCmsProfile(BytesIO(profile))
        mode = {"GRAY": "L", "RGB": "RGB", "CMYK": "CMYK"}[given.profile.xcolor_space.strip()]
        transform = ImageCms.buildTransform(given, ImageCms.createProfile("sRGB"), mode, "RGB")
    except (ImageCms.PyCMSError, OSError, KeyError):
        return "", None
    if mode != "RGB":
        return mode, transform
    # sRGB has many profiles, so it is told by what it does to colours all over the cube.
    cube = np.indices((16, 16, 16)).reshape(3, 1, -1).transpose(1, 2, 0) * 17
    moved = transform.apply(PIL.Image.fromarray(np.ascontiguousarray(cube, dtype=np.uint8)))
    return mode, None if np.abs(np.asarray(moved) - cube).max() <= 2 else transform


@contextmanager
def opened(path: Path) -> Iterator[IO[bytes]]:
    """A file open for reading. Raises DataError where that cannot be."""
    try:
        file = path.open("rb")
    except OSError as error:
        raise DataError(
            f"{path}: cannot be read ({error.strerror}); check the path and its permissions"
        ) from error
    with file:
        yield file


@contextmanager
def _decoding(kind: str, name: object, room: int = 0) -> Iterator[None]:
    """Whatever a decoder raises over the bytes of a stranger, as a DataError; MemoryError where `room` bytes
    are not there.
    """
    try:
        yield
    except (DataError, MemoryError):
        raise
    except ImportError as error:
        raise DataError(
            f"{name}: is HEIC, which needs the package pillow-heif: pip install pillow-heif, or convert the image to JPEG"
        ) from error
    except Exception as error:
        np.empty(
            room, np.uint8
        )  # raises MemoryError where that is what the decoder lacked: few of them say so
        reason = " ".join(str(error).lower().split()) or type(error).__name__
        raise DataError(
            f"{name}: the {kind} data cannot be decoded: {reason}; copy or export the image again"
        ) from error


@contextmanager
def silent() -> Iterator[None]:
    """Suppress Pillow's warnings of EXIF blocks. Filters are of the process, so one thread at a time changes
    them.
    """
    with _WARNINGS, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
