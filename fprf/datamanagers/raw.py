"""Raw photographs: the sensor's data as cameras write it, told by content and developed by the package rawpy.

Most kinds are TIFF files whose first picture is a thumbnail, or a black one. They are told by what only raw
files have: samples of a colour filter array or linear ones (TIFF/EP, DNG), compressions of makers, or the
first bytes. A file that has a DNGVersion but nothing of these is the TIFF that a program exported.

Developed with the camera's white balance to sRGB, turned upright, 8 bits, without automatic brightening: that
would give each photograph of a scene an exposure of its own.
"""

import re
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BytesIO
from typing import IO, TYPE_CHECKING

import numpy as np
import PIL.Image
from numpy.typing import NDArray
from PIL.ExifTags import IFD
from PIL.ExifTags import Base as Tag
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from ..errors import DataError

if TYPE_CHECKING:
    import rawpy

RAW_SUFFIXES = frozenset(
    {".dng", ".nef", ".nrw", ".cr2", ".cr3", ".crw", ".arw", ".sr2", ".srf", ".raf", ".orf", ".rw2", ".rwl"}
    | {".pef", ".srw", ".3fr", ".fff", ".iiq", ".mos", ".mef", ".mrw", ".erf", ".dcr", ".kdc", ".x3f", ".gpr"}
)
"""Suffixes of raw photographs in a folder's list, in lower case. What a file is, its content says."""

_WARNINGS_LOCK = threading.Lock()
_MAKERS_FIRST_BYTES: dict[str, bytes] = {
    "CR2": rb"(II\*\0|MM\0\*).{4}CR",
    "IIQ": rb"(II\*\0|MM\0\*)(IIII|MMMM)",
    "RW2": rb"IIU\0",
    "ORF": rb"IIR[OS]|MMOR",
    "RAF": rb"FUJIFILMCCD-RAW",
    "CR3": rb".{4}ftypcrx ",
    "CRW": rb"II.{4}HEAPCCDR",
    "MRW": rb"\0MRM",
    "X3F": rb"FOVb",
}
"""First bytes of kinds that are no plain TIFF files."""
_SENSOR_SAMPLES = frozenset({32803, 34892})
"""PhotometricInterpretation of a colour filter array (TIFF/EP) and of linear samples of the sensor (DNG)."""
_MAKERS_COMPRESSIONS = frozenset({32767, 32769, 32770, 34713, 65000, 65535})
"""Compression of Sony, Epson, Samsung, Nikon, Kodak and Pentax: nothing else is stored so (libtiff, tiff.h)."""
_LENS_TAGS = (Tag.Make, Tag.Model, Tag.FocalLength, Tag.FocalLengthIn35mmFilm)
_DNG_VERSION = 50706
"""Tag that every DNG has (DNG 1.7, chapter 4)."""
_NEW_SUBFILE_TYPE = 254
"""Tag that says what part of a file a picture is (TIFF 6.0, section 8)."""
_REDUCED = 1
"""Bit of NewSubfileType: a smaller copy of another picture of the file."""
_MAX_DIRECTORIES = 64
"""Directories of a TIFF file that are looked at: raw files have up to ten, and damage may make a circle."""


def raw_kind(head: bytes, directories: list[ImageFileDirectory_v2]) -> str:
    """The kind of a raw photograph by its first 64 bytes and, of a TIFF, its directories; empty for another
    file.
    """
    for kind, first in _MAKERS_FIRST_BYTES.items():
        if re.match(first, head, re.DOTALL):
            return kind
    if not any(_holds_sensor_data(directory) for directory in directories):
        return ""
    return "DNG" if _DNG_VERSION in directories[0] else "raw TIFF"


def raw_exif(file: IO[bytes]) -> PIL.Image.Exif:
    """Lens and position of a raw photograph that is a TIFF: model, focal lengths and GPS; empty for others."""
    exif = PIL.Image.Exif()
    directories = tiff_directories(file)
    if not directories:
        return exif
    # TIFF/EP has them in the first directory, most makers in the EXIF directory that it names.
    values = {}
    for tag in _LENS_TAGS:
        values[tag] = directories[0].get(tag)
    for offset in _numbers(directories[0], IFD.Exif):
        inner = _directory_at(file, offset)
        values |= {tag: inner[tag] for tag in _LENS_TAGS if tag in inner}
    for tag, value in values.items():
        if value is None:
            continue
        if tag in (Tag.Make, Tag.Model):
            exif[tag] = value
        else:
            exif.get_ifd(IFD.Exif)[tag] = value
    for offset in _numbers(directories[0], IFD.GPSInfo):
        exif.get_ifd(IFD.GPSInfo).update(_directory_at(file, offset))
    return exif


def _tiff_head(file: IO[bytes]) -> bytes:
    """The header of an open TIFF file: 8 bytes, 16 of BigTIFF."""
    file.seek(0)
    head = file.read(8)
    return head + file.read(8) if head[2:3] == b"+" else head


@contextmanager
def silent() -> Iterator[None]:
    """Suppress Pillow's warnings of EXIF blocks. Filters are of the process, so one thread at a time changes
    them.
    """
    with _WARNINGS_LOCK, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def parse_tags(directory: ImageFileDirectory_v2) -> None:
    """Parse all tags of a directory now, within `silent`: Pillow warns of odd ones when they are first asked
    for. Damaged ones raise only where they are needed.
    """
    for tag in list(directory):
        with suppress(Exception):
            directory[tag]


def _directory_at(file: IO[bytes], offset: int) -> ImageFileDirectory_v2:
    """A directory of an open TIFF file; what is damaged in it is absent."""
    directory = ImageFileDirectory_v2(_tiff_head(file))
    file.seek(offset)
    with silent():
        directory.load(file)
        parse_tags(directory)
    return directory


def tiff_directories(file: IO[bytes]) -> list[ImageFileDirectory_v2]:
    """The directories of an open TIFF file, in its order, each followed by those inside of it; what is damaged
    ends the list.
    """
    found: list[ImageFileDirectory_v2] = []
    try:
        left = [ImageFileDirectory_v2(_tiff_head(file)).next]
        seen = {0}
        while left and len(found) < _MAX_DIRECTORIES:
            offset = left.pop(0)
            if offset in seen:
                continue
            seen.add(offset)
            directory = _directory_at(file, offset)
            found.append(directory)
            left = [*_numbers(directory, Tag.SubIFDs), directory.next, *left]
    except Exception:  # whatever the bytes made of it: the decoder will say what is wrong
        return found
    return found


def full_picture(directories: list[ImageFileDirectory_v2]) -> ImageFileDirectory_v2 | None:
    """The largest picture of a TIFF file whose first one is a smaller copy; None where the first one counts."""
    if not directories or not _is_reduced(directories[0]):
        return None
    whole = []
    for each in directories:
        if not _is_reduced(each) and _area(each):
            whole.append(each)
    return max(whole, key=_area, default=None)


def raw_size(file: IO[bytes], name: object, kind: str) -> tuple[int, int]:
    """Width and height of a raw photograph, upright. Raises DataError where it cannot be read."""
    with _developing(file, name, kind) as raw:
        return _upright_size(raw)


def develop(file: IO[bytes], name: object, kind: str, max_pixels: int) -> NDArray[np.uint8]:
    """A raw photograph [H W 3] in sRGB, upright. Raises DataError where it cannot be read or is too large."""
    with _developing(file, name, kind) as raw:
        width, height = _upright_size(raw)
        if width * height > max_pixels:
            raise DataError(
                f"{name}: {width}x{height} pixels; at most {max_pixels:.0e} are read: reduce the image"
            )
        pixels = raw.postprocess(
            use_camera_wb=True,
            no_auto_bright=True,
            output_bps=8,
            gamma=(2.4, 12.92),  # of sRGB: its power, and its slope near black
        )
    # Sensors without colours give one channel.
    return np.ascontiguousarray(np.broadcast_to(pixels, (*pixels.shape[:2], 3)), dtype=np.uint8)


@contextmanager
def _developing(file: IO[bytes], name: object, kind: str) -> "Iterator[rawpy.RawPy]":
    """A raw photograph opened by rawpy. Raises DataError where that cannot be."""
    what = f"{name}: is a raw photograph ({kind})"
    try:
        import rawpy
    except ImportError as error:
        raise DataError(
            f"{what}, which needs the package rawpy: pip install 'fprf[raw]', or export it as JPEG"
        ) from error
    file.seek(0)
    try:
        with rawpy.imread(BytesIO(file.read())) as raw:
            yield raw
    except rawpy.LibRawError as error:
        reason = " ".join(part.decode() if isinstance(part, bytes) else str(part) for part in error.args)
        raise DataError(
            f"{what} that rawpy cannot read: {reason.lower() or type(error).__name__}; export it as JPEG"
        ) from error


def _upright_size(raw: "rawpy.RawPy") -> tuple[int, int]:
    sizes = raw.sizes
    # LibRaw's flip: 5 and 6 are quarter turns.
    if sizes.flip in (5, 6):
        return sizes.iheight, sizes.iwidth
    return sizes.iwidth, sizes.iheight


def _holds_sensor_data(directory: ImageFileDirectory_v2) -> bool:
    samples = _numbers(directory, Tag.PhotometricInterpretation)
    compression = _numbers(directory, Tag.Compression)
    return bool(_SENSOR_SAMPLES & {*samples} or _MAKERS_COMPRESSIONS & {*compression})


def _is_reduced(directory: ImageFileDirectory_v2) -> bool:
    return any(value & _REDUCED for value in _numbers(directory, _NEW_SUBFILE_TYPE))


def _area(directory: ImageFileDirectory_v2) -> int:
    """Pixels of the picture of a directory; 0 where it has none."""
    width = _numbers(directory, Tag.ImageWidth)
    height = _numbers(directory, Tag.ImageLength)
    return sum(width[:1]) * sum(height[:1])


def _numbers(directory: ImageFileDirectory_v2, tag: int) -> list[int]:
    """The whole numbers of a tag; none where it is absent or of another type."""
    value = directory.get(tag)
    if not isinstance(value, tuple):
        value = (value,)
    found: list[int] = []
    for each in value:
        if isinstance(each, int):
            found.append(each)
    return found
