"""Image files to 8-bit arrays [H W 3], sRGB, at the size that a scene's cameras have.

Pixels of captures are taken as stored: EXIF orientation is ignored, as COLMAP does, because the cameras were calibrated so.
Photographs without a camera, such as references, are turned upright.
Transparency is straight (not premultiplied) and composited before any reduction, which averages areas.

Size and transparency come from a file's first bytes (PNG, JPEG, WebP, BMP, TIFF, HEIC and AVIF, told by their content), so that
a bomb costs nothing. OpenCV tells neither before it decodes; Pillow would be one more dependency and reads WebP and AVIF whole.
"""

import os
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from ..memory import out_of_memory

if TYPE_CHECKING:
    from .scene import Scene


IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".heic", ".heif", ".hif", ".avif"})
"""Suffixes of images in a folder's list, in lower case."""

_HEAD = 1 << 18
"""Bytes read at first: more than any camera's EXIF block with its thumbnail."""
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_TIFF_TYPES = {1: "B", 3: "H", 4: "I"}
_AVIF = frozenset({b"avif", b"avis"})
_HEIF = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"})
"""Brands of the ISO base media format that mark still images."""
_ALPHA = (b"auxiliary:alpha", b"hevc:2015:auxid:1")
"""Types of an auxiliary image that is the alpha channel."""


class ImageHeader(NamedTuple):
    """Header of an image file, as stored: EXIF orientation is not applied.

    HEIC and AVIF store rotation in the image itself (`irot`), which decoders apply: width and height are those after it.
    """

    width: int
    height: int
    alpha: bool
    kind: str
    """png, jpeg, webp, bmp, tiff, heic or avif."""


def read_header(path: Path) -> ImageHeader:
    """The header of an image file. Raises DataError where the file is absent, empty, or of no known format."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
            header = header_of(head)
            if header is None and len(head) == _HEAD:
                header = header_of(head + file.read())
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); check the path and its permissions") from error
    if not head:
        raise DataError(f"{path}: the file is empty; restore the image or remove it from the scene")
    if header is None:
        raise DataError(
            f"{path}: no PNG, JPEG, WebP, BMP, TIFF, HEIC or AVIF header; replace the file or convert the image to PNG"
        )
    if header.width < 1 or header.height < 1:
        raise DataError(f"{path}: the header says {header.width}x{header.height} pixels; replace the file")
    return header


def header_of(data: bytes) -> ImageHeader | None:
    """The header in the first bytes of a file; None where they hold no known or no whole one."""
    try:
        if data.startswith(b"\x89PNG\r\n\x1a\n"):
            return _png(data)
        if data.startswith(b"\xff\xd8\xff"):
            return _jpeg(data)
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return _webp(data)
        if data.startswith(b"BM"):
            return _bmp(data)
        if data[:4] in (b"II*\0", b"MM\0*"):
            return _tiff(data)
        if data[4:8] == b"ftyp":
            return _heif(data)
    except (struct.error, IndexError, KeyError):
        return None
    return None


def _png(data: bytes) -> ImageHeader | None:
    if data[12:16] != b"IHDR":
        return None
    width, height, _, colour = struct.unpack_from(">IIBB", data, 16)
    alpha = colour in (4, 6)
    at = 33
    while not alpha and at + 8 <= len(data) and data[at + 4 : at + 8] != b"IDAT":
        alpha = data[at + 4 : at + 8] == b"tRNS"
        at += 12 + int.from_bytes(data[at : at + 4], "big")
    return ImageHeader(width, height, alpha, "png")


def _jpeg(data: bytes) -> ImageHeader | None:
    at = 2
    while True:
        while data[at] == 0xFF and data[at + 1] == 0xFF:
            at += 1
        if data[at] != 0xFF:
            return None
        marker = data[at + 1]
        if marker in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return ImageHeader(width, height, False, "jpeg")
        if marker in (0xD9, 0xDA):
            return None
        at += 2 if marker == 0x01 or 0xD0 <= marker <= 0xD8 else 2 + struct.unpack_from(">H", data, at + 2)[0]


def _webp(data: bytes) -> ImageHeader | None:
    if data[12:16] == b"VP8X":
        width = 1 + int.from_bytes(data[24:27], "little")
        height = 1 + int.from_bytes(data[27:30], "little")
        return ImageHeader(width, height, bool(data[20] & 0x10), "webp") if len(data) >= 30 else None
    if data[12:16] == b"VP8L" and data[20] == 0x2F:
        bits = struct.unpack_from("<I", data, 21)[0]
        return ImageHeader(1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF), bool(bits >> 28 & 1), "webp")
    if data[12:16] == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return ImageHeader(width & 0x3FFF, height & 0x3FFF, False, "webp")
    return None


def _bmp(data: bytes) -> ImageHeader | None:
    width, height, _, bits = struct.unpack_from("<iiHH", data, 18)
    return ImageHeader(width, abs(height), bits == 32, "bmp")


def _tiff(data: bytes) -> ImageHeader | None:
    order = "<" if data[:2] == b"II" else ">"
    start = struct.unpack_from(order + "I", data, 4)[0]
    tags: dict[int, int] = {}
    for k in range(struct.unpack_from(order + "H", data, start)[0]):
        at = start + 2 + 12 * k
        tag, type_, count = struct.unpack_from(order + "HHI", data, at)
        if count == 1 and type_ in _TIFF_TYPES:
            tags[tag] = struct.unpack_from(order + _TIFF_TYPES[type_], data, at + 8)[0]
    if 256 not in tags or 257 not in tags:
        return None
    return ImageHeader(tags[256], tags[257], tags.get(277, 1) in (2, 4), "tiff")


def _heif(data: bytes) -> ImageHeader | None:
    """The primary image of a HEIC or AVIF file (ISO/IEC 23008-12), cropped and rotated by its own properties."""
    brands = {data[at : at + 4] for at in range(8, min(struct.unpack_from(">I", data)[0], 256), 4)}
    if not brands & (_AVIF | _HEIF):
        return None
    whole = {kind: (start, end) for kind, start, end in _boxes(data, 0, len(data))}
    meta = {kind: (start, end) for kind, start, end in _boxes(data, whole[b"meta"][0] + 4, whole[b"meta"][1])}
    parts = {kind: (start, end) for kind, start, end in _boxes(data, *meta[b"iprp"])}
    properties = list(_boxes(data, *parts[b"ipco"]))
    at = meta[b"pitm"][0]
    (primary,) = struct.unpack_from(">H" if data[at] == 0 else ">I", data, at + 4)
    width, height, turned = 0, 0, False
    for index in _properties_of(data, parts[b"ipma"][0], primary):
        kind, start, _ = properties[index - 1]
        if kind == b"ispe":
            width, height = struct.unpack_from(">II", data, start + 4)
        elif kind == b"clap":
            across, by, down, by_too = struct.unpack_from(">4I", data, start)
            width, height = across // max(by, 1), down // max(by_too, 1)
        elif kind == b"irot":
            turned = bool(data[start] & 1)
    alpha = any(kind == b"auxC" and any(name in data[start:end] for name in _ALPHA) for kind, start, end in properties)
    if turned:
        width, height = height, width
    return ImageHeader(width, height, alpha, "avif" if brands & _AVIF else "heic")


def _properties_of(data: bytes, at: int, item: int) -> list[int]:
    """Numbers, from 1, of the properties of an item, by the content of an `ipma` box at `at`."""
    version, long = data[at], data[at + 3] & 1
    (count,) = struct.unpack_from(">I", data, at + 4)
    at += 8
    for _ in range(count):
        (number,) = struct.unpack_from(">I" if version else ">H", data, at)
        at += 4 if version else 2
        size, at = data[at], at + 1
        end = at + size * (1 + long)
        if number == item:
            return [n & (0x7FFF if long else 0x7F) for n in struct.unpack_from(f">{size}{'H' if long else 'B'}", data, at)]
        at = end
    return []


def _boxes(data: bytes, at: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Kind, start and end of the content of each box in a part of an ISO base media file."""
    while at + 8 <= end:
        length, kind = struct.unpack_from(">I4s", data, at)
        if length < 8:  # 0: up to the end of the file, 1: longer than 4 GiB; neither holds what describes an image
            return
        yield kind, at + 8, at + length
        at += length


MAX_PIXELS = 100_000_000
"""Files that claim more are refused before they are decoded."""

Image: TypeAlias = NDArray[np.uint8]
WHITE = (1.0, 1.0, 1.0)
"""Default colour behind transparent pixels."""


def load_image(
    path: Path,
    size: tuple[int, int] | None = None,
    background: Sequence[float] | None = None,
    *,
    upright: bool = False,
) -> Image:
    """An image [H W 3] in sRGB, 0 to 255, resized to `size` (width, height), or as delivered without one.

    16-bit files are rounded to 8 bits, grey ones repeated. Transparent pixels show `background` (RGB in [0, 1]; white
    by default). `upright` obeys EXIF orientation, except in files with transparency. Raises DataError where the file is
    absent, truncated, damaged, of no known format or over 1e8 pixels.
    """
    pixels = _to_rgb(path, _decode(path, upright), WHITE if background is None else background)
    if size is None or size == (pixels.shape[1], pixels.shape[0]):
        return pixels
    smaller = size[0] <= pixels.shape[1] and size[1] <= pixels.shape[0]
    resized = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
    return np.asarray(resized, dtype=np.uint8)


def load_mask(path: Path, size: tuple[int, int]) -> NDArray[np.bool_]:
    """A mask [H W] of `size` (width, height): true where the file's first channel is bright (above a half; of files that hold
    but 0 and 1, where it is 1). The nearest pixel is taken. Raises DataError as `load_image` does.
    """
    pixels = _decode(path)
    height, width = pixels.shape[:2]
    if abs(size[0] * height - size[1] * width) > width + height + size[0] + size[1]:
        raise DataError(f"{path}: {width}x{height} pixels do not fit an image of {size[0]}x{size[1]}; mend it")
    grey = pixels.reshape(height, width, -1)[:, :, 0].astype(np.int64)
    half = 0 if grey.max() <= 1 else 127 if grey.max() <= 255 else 32767
    mask = np.asarray(cv2.resize((grey > half).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST))
    return mask.astype(np.bool_)


def load_images(scene: "Scene", background: Sequence[float] | None = None, views: Sequence[int] | None = None) -> list[Image]:
    """Views of a scene (all, in the scene's order, where none are named) at their cameras' sizes, which may differ.

    Raises DataError as `load_image` does, and where a file's shape has changed since the scene was parsed.
    """

    def load(view: int) -> Image:
        path, (width, height) = scene.paths[view], scene.cameras.size[view].tolist()
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
    """Sorted names of the images directly in a folder, hidden files left out; DataError where there is none."""
    try:
        entries = os.listdir(folder)
    except OSError as error:
        raise DataError(f"{folder}: no such image folder ({error.strerror}); name it or put the images there") from error
    names = sorted(n for n in entries if Path(n).suffix.lower() in IMAGE_SUFFIXES and not n.startswith("."))
    if not names:
        raise DataError(
            f"{folder}: no image among {len(entries)} files; put PNG, JPEG, WebP, BMP, TIFF, HEIC or AVIF images there"
        )
    return names


def photographs(paths: Sequence[Path], report: Callable[[str], None]) -> list[Path]:
    """The files among the paths and the images in the folders, each once; those of a folder in the order of their names.

    An image in a folder that cannot be read is left out, and `report` is given the reason. Raises DataError for a folder
    without a readable image.
    """
    listed: dict[Path, None] = {}
    for path in paths:
        listed |= dict.fromkeys(_readable(path, report) if path.is_dir() else [path])
    return list(listed)


def _readable(folder: Path, report: Callable[[str], None]) -> list[Path]:
    """The images of a folder that can be decoded."""
    images = [folder / name for name in image_names(folder)]

    def fault(path: Path) -> str:
        try:
            load_image(path)
        except DataError as error:
            return str(error)
        return ""

    with ThreadPoolExecutor() as pool:
        faults = dict(zip(images, pool.map(fault, images), strict=True))
    for reason in filter(None, faults.values()):
        report(f"left out: {reason}")
    if all(faults.values()):
        raise DataError(f"{folder}: none of its {len(images)} images can be read; the first one: {faults[images[0]]}")
    return [path for path in images if not faults[path]]


def _decode(path: Path, upright: bool = False) -> NDArray[np.generic]:
    """Pixels as OpenCV orders them, BGR; EXIF orientation is obeyed on request, and not where there is transparency."""
    header = read_header(path)
    if header.width * header.height > MAX_PIXELS:
        raise DataError(f"{path}: {header.width}x{header.height} pixels; at most {MAX_PIXELS:.0e} are read: reduce the image")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); check the path and its permissions") from error
    damage = _damage(data, header)
    if damage:
        raise DataError(f"{path}: {damage}; copy or export the image again")
    if header.kind == "heic":
        return _decode_heic(path, data)
    # OpenCV obeys the orientation only where it may also drop the alpha channel.
    flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH
    if header.alpha or not upright:
        flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    again = "convert the image to PNG or JPEG" if header.kind == "avif" else "copy or export the image again"
    try:
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error as error:
        if out_of_memory(error):
            raise
        raise DataError(f"{path}: the {header.kind} data cannot be decoded; {again}") from error
    if pixels is None:
        np.empty(8 * header.width * header.height, np.uint8)  # raises MemoryError where that is what the decoder lacked
        raise DataError(f"{path}: the {header.kind} data cannot be decoded; {again}")
    return np.asarray(pixels)


def _decode_heic(path: Path, data: bytes) -> NDArray[np.generic]:
    """The image of a HEIC file. Its rotation is part of the format, so it comes upright."""
    try:
        import pillow_heif
    except ImportError:
        raise DataError(
            f"{path}: is HEIC, which needs the package pillow-heif: pip install 'fprf[heic]', or convert the image to JPEG"
        ) from None
    try:
        return np.asarray(pillow_heif.open_heif(data, bgr_mode=True))
    except (ValueError, EOFError, SyntaxError, RuntimeError, OSError, IndexError) as error:
        raise DataError(f"{path}: the heic data cannot be decoded; copy or export the image again") from error


def _damage(data: bytes, header: ImageHeader) -> str:
    """Damage of a file, as far as its structure tells; decoders fill what is missing with grey, silently."""
    if header_of(data) != header:
        return "the file changed while it was read"
    if header.kind == "jpeg":
        scan = _first_scan(data)
        return "" if data.rfind(b"\xff\xd9", scan) >= 0 else "the JPEG is truncated (no end-of-image marker)"
    if header.kind == "png":
        return _png_damage(data)
    return ""


def _first_scan(data: bytes) -> int:
    """Offset of the first scan: an end marker before it belongs to a thumbnail."""
    at = 2
    while at + 4 <= len(data) and data[at + 1] != 0xDA:
        stuffed = data[at + 1] == 0xFF
        bare = data[at + 1] == 0x01 or 0xD0 <= data[at + 1] <= 0xD8
        at += 1 if stuffed else 2 if bare else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return at


def _png_damage(data: bytes) -> str:
    at = 8
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        end = at + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(memoryview(data)[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            return f"the PNG is damaged (checksum of the chunk at byte {at})"
        if data[at + 4 : at + 8] == b"IEND":
            return ""
        at = end + 4
    return "the PNG is truncated (no end chunk)"


def _to_rgb(path: Path, pixels: NDArray[np.generic], background: Sequence[float]) -> Image:
    if pixels.dtype not in (np.uint8, np.uint16):
        raise DataError(f"{path}: pixels of type {pixels.dtype}; 8 or 16 bits a channel are read: convert the image")
    if pixels.ndim == 2:
        pixels = pixels[:, :, None]
    channels = pixels.shape[2]
    if channels not in (1, 2, 3, 4):
        raise DataError(f"{path}: {channels} channels; grey, RGB and either with alpha are read: convert the image")
    colour = pixels[:, :, :1] if channels < 3 else pixels[:, :, 2::-1]
    top = np.float32(255 if pixels.dtype == np.uint8 else 65535)
    if channels in (2, 4):
        alpha = pixels[:, :, -1:].astype(np.float32) / top
        behind = np.asarray(background, dtype=np.float32) * 255
        blended = colour.astype(np.float32) * (255 / top) * alpha + behind * (1 - alpha)
        return np.asarray(np.clip(np.rint(blended), 0, 255), dtype=np.uint8)
    eight = colour if pixels.dtype == np.uint8 else np.rint(colour.astype(np.float32) * (255 / top))
    return np.ascontiguousarray(np.broadcast_to(eight, (*pixels.shape[:2], 3)), dtype=np.uint8)
