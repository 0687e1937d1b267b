"""Image files: what kind one is by its content, its header, and its pixels.

Pillow decodes; of a file with several images the first one counts, of a TIFF that begins with a smaller copy
the largest. What a file's pixels are is decided in `decode`:

- Colours of an embedded ICC profile or of a colour tag (`colour_tags`) become sRGB. A profile that is broken
  or does not fit the pixels is ignored.
- HEIC and AVIF store their rotation in the image itself (`irot`, `imir`), which every decoder applies, and raw
  photographs are developed upright: these are always upright. The EXIF orientation of the others is left to
  who reads them.
- Transparency is straight (not premultiplied).

Opening a file reads its header only, so that sizes are checked before anything is decoded.
"""

import re
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple, TypeAlias

import cv2
import numpy as np
import PIL.Image
from numpy.typing import NDArray
from PIL import ImageCms
from PIL.AvifImagePlugin import AvifImageFile
from PIL.BmpImagePlugin import BmpImageFile
from PIL.ExifTags import IFD
from PIL.ExifTags import Base as Tag
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.TiffImagePlugin import TiffImageFile
from PIL.WebPImagePlugin import WebPImageFile

from ..errors import DataError
from ..io.transfer import picture_of
from .colour_tags import ColourTag, boxes_tag, exif_tag, heif_tag, png_tag
from .raw import (
    develop,
    full_picture,
    parse_tags,
    raw_exif,
    raw_kind,
    raw_size,
    silent,
    tiff_directories,
)

MAX_PIXELS = 100_000_000
"""Files that claim more are refused before they are decoded: a camera's largest, with room for copies."""
RAW = "raw"
"""Kind of raw photographs, whatever their maker."""

Image: TypeAlias = NDArray[np.uint8]
Rounding: TypeAlias = Callable[[NDArray[np.float32]], NDArray[np.float32]]


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
_HEAD_BYTES = 64
"""Bytes that tell every kind: the longest list of brands of HEIC files fits."""
_CAMERA_FORMATS = frozenset({"JPEG", "TIFF", "WebP"})
"""Formats without colour tags of their own, where a camera's EXIF block may say Adobe RGB."""
_UPRIGHT_TURNS = {
    2: PIL.Image.Transpose.FLIP_LEFT_RIGHT,
    3: PIL.Image.Transpose.ROTATE_180,
    4: PIL.Image.Transpose.FLIP_TOP_BOTTOM,
    5: PIL.Image.Transpose.TRANSPOSE,
    6: PIL.Image.Transpose.ROTATE_270,
    7: PIL.Image.Transpose.TRANSVERSE,
    8: PIL.Image.Transpose.ROTATE_90,
}
"""Transpose that turns an image upright, by its EXIF orientation."""
_INVERSE_TURNS = {6: 8, 8: 6}
"""Orientations that are each other's inverse; the others are their own."""
_GREY_SCALES = {"L;2": 85, "L;4": 17}
"""Factor to 8 bits of PNG's grey of 2 and 4 bits, by Pillow's raw mode."""
_SAME_SRGB_LEVELS = 2
"""Levels of 255 up to which a profile moves colours and still is sRGB: profiles of sRGB differ by rounding."""


class ImageHeader(NamedTuple):
    """Header of an image file: of the pixels that `load_image` delivers where they are not turned upright."""

    width: int
    height: int
    alpha: bool
    kind: str
    """JPEG, PNG, WebP, BMP, TIFF, AVIF, HEIC or raw."""


class Decoded(NamedTuple):
    """Pixels of an image file."""

    colour: PIL.Image.Image
    """In mode L, RGB or CMYK; sRGB where the file says what its colours are."""
    alpha: PIL.Image.Image | None
    """In mode L; None where the file has none."""


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
    maker = raw_kind_of(file, name)
    if maker:
        width, height = raw_size(file, name, maker)
        return ImageHeader(width, height, False, RAW)
    kind, image = open_image(file, name)
    width, height = image.size
    if isinstance(image, TiffImageFile):  # Pillow gives the size that they have upright
        width = image.tag_v2[Tag.ImageWidth]
        height = image.tag_v2[Tag.ImageLength]
    elif kind == "AVIF" and exif_orientation(image) > 4:
        width, height = height, width
    return ImageHeader(width, height, image.has_transparency_data, kind)


def raw_kind_of(file: IO[bytes], name: object) -> str:
    """The maker's kind of a raw photograph, such as DNG; empty for another file. Raises DataError where it is
    empty or of no known format.
    """
    head, kind = _sniffed(file, name)
    if kind == RAW:
        return raw_kind(head, [])
    if kind == "TIFF":
        return raw_kind(head, tiff_directories(file))
    return ""


def exif_of(file: IO[bytes], name: object) -> PIL.Image.Exif:
    """The EXIF block of an open file; of a raw photograph what it says of its lens and its position. Raises
    whatever Pillow raises over a damaged one.
    """
    if raw_kind_of(file, name):
        return raw_exif(file)
    image = open_image(file, name)[1]
    with silent():
        exif = image.getexif()
        for part in (IFD.Exif, IFD.GPSInfo):
            exif.get_ifd(part)  # while the file is open: of a TIFF it is read only when asked for
    return exif


def open_image(file: IO[bytes], name: object) -> tuple[str, ImageFile]:
    """The format of an open file and its image, of which only the header was read; raw photographs aside.
    Raises DataError as `header_of`.
    """
    _, kind = _sniffed(file, name)
    if kind == RAW:
        raise DataError(f"{name}: is a raw photograph, which Pillow does not read; export it as JPEG")
    if kind == "TIFF":
        file = _at_full_picture(file)
    file.seek(0)
    with decoding(kind, name), silent():
        image = _READERS[kind][1](file)
        if isinstance(image, TiffImageFile):
            parse_tags(image.tag_v2)
    return kind, image


def _sniffed(file: IO[bytes], name: object) -> tuple[bytes, str]:
    """The first bytes of an open file, and the kind that they say, whatever its name says."""
    file.seek(0)
    head = file.read(_HEAD_BYTES)
    if not head:
        raise DataError(f"{name}: the file is empty; restore the image or remove it from the scene")
    kind = kind_of(head)
    if not kind:
        raise DataError(
            f"{name}: no PNG, JPEG, WebP, BMP, TIFF, HEIC or AVIF header; replace the file or convert the image to PNG"
        )
    return head, kind


def kind_of(head: bytes) -> str:
    """The format of a file by its first 64 bytes: JPEG, PNG, WebP, BMP, TIFF, AVIF, HEIC or raw; empty for
    another. Raw photographs that begin as TIFF are told by `raw_kind_of`.
    """
    for kind, (first, _) in _READERS.items():
        if re.match(first, head, re.DOTALL):
            # Of these only TIFF may be the beginning of a raw photograph.
            if kind == "TIFF" and raw_kind(head, []):
                return RAW
            return kind
    return RAW if raw_kind(head, []) else ""


def _at_full_picture(file: IO[bytes]) -> IO[bytes]:
    """The TIFF file itself; where it begins with a smaller copy, one that begins with the largest picture."""
    directory = full_picture(tiff_directories(file))
    if directory is None:
        return file
    file.seek(0)
    data = bytearray(file.read())
    # The header ends with where the first directory lies; BigTIFF has 8 bytes for it.
    order = "<" if data[:2] == b"II" else ">"
    big = data[2:3] == b"+"
    struct.pack_into(f"{order}{'Q' if big else 'I'}", data, 8 if big else 4, directory.offset or 0)
    return BytesIO(bytes(data))


def decode(path: Path, *, upright: bool, rounded: Rounding = np.rint, convert: bool = True) -> Decoded:
    """The pixels of a file; colours of 16 bits become 8 with `rounded`.

    `convert` false leaves colours as their tag has them, of what is no picture of anything. Raises DataError
    where the file is absent, truncated, damaged, of no known format or over 1e8 pixels.
    """
    with opened(path) as file:
        maker = raw_kind_of(file, path)
        if maker:
            return Decoded(PIL.Image.fromarray(develop(file, path, maker, MAX_PIXELS)), None)
        kind, image = open_image(file, path)
        _check_size(path, kind, image)
        with decoding(kind, path, 8 * image.width * image.height):
            if convert:
                tag = _tag_of(kind, file, image)
            else:
                tag = ColourTag()
            if kind == "PNG":
                image = _verified_png(file, path, image)
            deep = ";16" in str(image.tile)
            if kind == "TIFF":
                stored = exif_orientation(image)
            else:
                stored = 1
            image.load()
            turn = _UPRIGHT_TURNS.get(_left_to_turn(kind, image, stored, upright))
        pixels = _colours(path, file, image, deep, rounded)
        pixels, alpha = _split(pixels, image)
        if tag.over_profile:
            profile = b""
        else:
            profile = image.info.get("icc_profile", b"")
        pixels, done = _by_profile(pixels, profile)
        if tag.changes and not done:
            pixels = _by_tag(pixels, tag, _levels(kind, file, image, tag))
    if turn is not None:
        pixels = pixels.transpose(turn)
        alpha = alpha and alpha.transpose(turn)
    return Decoded(pixels, alpha)


def colour_note(path: Path) -> str:
    """Decision about the colours of a file, in one clause; empty where nothing is. Raises DataError as
    `read_header` does.
    """
    with opened(path) as file:
        maker = raw_kind_of(file, path)
        if maker:
            return f"raw ({maker}): developed with the camera's white balance"
        kind, image = open_image(file, path)
        with decoding(kind, path):
            tag = _tag_of(kind, file, image)
    if tag.unknown:
        return f"its colours ({tag.unknown}) are not known, so they are taken as sRGB"
    if "icc_profile" in image.info and not tag.over_profile:
        return ""
    if tag.space.high_dynamic_range:
        return f"high dynamic range ({tag.space.curve.upper()}): tone-mapped to sRGB"
    return ""


def _check_size(path: Path, kind: str, image: ImageFile) -> None:
    most = MAX_PIXELS
    if kind == "TIFF":  # Pillow has a limit of its own there, above which it warns
        most = min(MAX_PIXELS, PIL.Image.MAX_IMAGE_PIXELS or MAX_PIXELS)
    if image.width * image.height > most:
        raise DataError(
            f"{path}: {image.width}x{image.height} pixels; at most {most:.0e} are read: reduce the image"
        )


def _tag_of(kind: str, file: IO[bytes], image: ImageFile) -> ColourTag:
    """Colours of the file beside an ICC profile, as it says."""
    if kind == "PNG":
        tag = png_tag(file)
    elif kind in ("AVIF", "HEIC"):
        tag = boxes_tag(file)
        if kind == "HEIC" and not (tag.changes or tag.unknown):
            tag = heif_tag(image.info)._replace(bits=tag.bits)
    else:
        tag = ColourTag()
    if kind not in _CAMERA_FORMATS:
        return tag
    with silent():
        return exif_tag(image)


def _verified_png(file: IO[bytes], path: Path, image: ImageFile) -> ImageFile:
    """The PNG opened anew, once its checksums, which loading ignores, are right."""
    image.verify()  # uses the image up
    image = open_image(file, path)[1]
    if "transparency" in image.info:
        # Pillow scales grey of 2 and 4 bits, but not the transparent one.
        image.info["transparency"] *= _GREY_SCALES.get(str(image.tile[0].args), 1)
    return image


def _left_to_turn(kind: str, image: ImageFile, stored: int, upright: bool) -> int:
    """The orientation by which loaded pixels are still to be turned."""
    if kind == "TIFF":
        # Pillow has turned them: they are turned back.
        if upright:
            return 1
        return _INVERSE_TURNS.get(stored, stored)
    if kind == "AVIF" or (upright and kind != "HEIC"):
        return exif_orientation(image)
    return 1


def _colours(path: Path, file: IO[bytes], image: ImageFile, deep: bool, rounded: Rounding) -> PIL.Image.Image:
    """The image with 8 bits a channel. Raises DataError for 32 bits."""
    if image.mode.startswith("I;16"):
        values = np.asarray(image)
        return PIL.Image.fromarray(rounded(values * np.float32(255 / 65535)).astype(np.uint8))
    if image.mode in ("I", "F"):
        raise DataError(f"{path}: pixels of 32 bits; 8 or 16 bits a channel are read: convert the image")
    if not deep:
        return image
    found = _by_opencv(file, image)
    if found is None:
        return image
    return PIL.Image.fromarray(rounded(found * np.float32(255 / 65535)).astype(np.uint8))


def _split(pixels: PIL.Image.Image, image: ImageFile) -> Decoded:
    """Colours in mode L, RGB or CMYK, and what is transparent."""
    alpha = None
    if image.mode.startswith("I;16"):
        if "transparency" in image.info:  # the grey that is transparent, of 16 bits
            alpha = PIL.Image.fromarray(np.uint8(255) * (np.asarray(image) != image.info["transparency"]))
    elif pixels.has_transparency_data:
        grey = pixels.mode in ("1", "L", "LA")
        pixels = pixels.convert("RGBA")
        alpha = pixels.getchannel("A")
        if grey:
            pixels = pixels.getchannel("R")
        else:
            pixels = pixels.convert("RGB")
    if pixels.mode not in ("L", "RGB", "CMYK"):
        pixels = pixels.convert("L" if pixels.mode == "1" else "RGB")
    return Decoded(pixels, alpha)


def _by_profile(pixels: PIL.Image.Image, profile: bytes) -> tuple[PIL.Image.Image, bool]:
    """Colours of an ICC profile in sRGB; false where the profile is none or does not fit."""
    if not profile:
        return pixels, False
    mode, transform = _transform(profile)
    if mode == "RGB" and pixels.mode == "L":
        pixels = pixels.convert("RGB")
    if pixels.mode != mode:
        return pixels, False
    if transform is None:
        return pixels, True
    return transform.apply(pixels), True


def _by_tag(
    pixels: PIL.Image.Image, tag: ColourTag, levels: tuple[NDArray[np.uint16], int] | None
) -> PIL.Image.Image:
    """Colours of a tag in sRGB: of `levels` with the largest of them, where there are more than 8 bits."""
    if pixels.mode == "CMYK":
        return pixels
    if levels is None:
        eight = np.asarray(pixels.convert("RGB"))
        return PIL.Image.fromarray(picture_of(eight, tag.space, largest=255, full_range=tag.full_range))
    values, largest = levels
    return PIL.Image.fromarray(picture_of(values, tag.space, largest=largest, full_range=tag.full_range))


def _levels(
    kind: str, file: IO[bytes], image: ImageFile, tag: ColourTag
) -> tuple[NDArray[np.uint16], int] | None:
    """Colours of more than 8 bits [H W 3], as the file has them, and the largest that there can be; None where
    Pillow's have all.
    """
    if image.mode.startswith("I;16"):
        return np.asarray(image).astype(np.uint16)[:, :, None].repeat(3, 2), 65535
    if kind == "HEIC":
        return _heif_levels(file, tag.bits)
    largest = 65535 if kind in ("PNG", "TIFF") else 2**tag.bits - 1
    values = _by_opencv(file, image, largest)
    return None if values is None else (values[:, :, :3], largest)


def _heif_levels(file: IO[bytes], bits: int) -> tuple[NDArray[np.uint16], int] | None:
    """Colours of a HEIC of more than 8 bits, which libheif delivers at the upper end of 16."""
    if bits <= 8:
        return None
    from pillow_heif import open_heif

    file.seek(0)
    found = np.asarray(open_heif(file, convert_hdr_to_8bit=False))
    if found.dtype != np.uint16 or found.ndim != 3:
        return None
    levels: NDArray[np.uint16] = found[:, :, :3] >> np.uint16(16 - bits)
    return levels, 2**bits - 1


def _by_opencv(file: IO[bytes], image: PIL.Image.Image, largest: int = 65535) -> NDArray[np.uint16] | None:
    """Colours of 16 bits of a file by OpenCV [H W 3 or 4], RGB: Pillow keeps the upper 8 of 16 bits only. None where the
    two disagree.
    """
    file.seek(0)
    flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    found = cv2.imdecode(np.frombuffer(file.read(), dtype=np.uint8), flags)
    if found is None or found.dtype != np.uint16 or found.shape[2:] not in ((3,), (4,)):
        return None
    values = found.astype(np.uint16)[:, :, [2, 1, 0, 3][: found.shape[2]]]
    upper = np.asarray(image.convert("RGB"), dtype=np.int16)
    if values.shape[:2] != upper.shape[:2]:
        return None
    eight = (values[:, :, :3] * np.float32(255 / largest)).astype(np.int16)
    return values if np.abs(eight - upper).max() <= 1 else None


def exif_orientation(image: ImageFile) -> int:
    """The EXIF orientation, 1 to 8; 1 where the file says none, or nothing that can be understood."""
    try:
        with silent():
            found = image.getexif().get(Tag.Orientation, 1)
    except Exception:  # whatever is wrong with the block, the pixels are whole
        return 1
    return int(found) if found in _UPRIGHT_TURNS else 1


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
    same = np.abs(np.asarray(moved) - cube).max() <= _SAME_SRGB_LEVELS
    return mode, None if same else transform


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
def decoding(kind: str, name: object, room: int = 0) -> Iterator[None]:
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
        # Raises MemoryError where that is what the decoder lacked: few of them say so.
        np.empty(room, np.uint8)
        reason = " ".join(str(error).lower().split()) or type(error).__name__
        raise DataError(
            f"{name}: the {kind} data cannot be decoded: {reason}; copy or export the image again"
        ) from error
