"""Colour tags of image files that have no ICC profile: what their RGB signals mean.

- PNG (third edition, section 4.3): cICP counts before iCCP, that before sRGB, that before gAMA and cHRM. A
  cICP that is not understood counts as absent.
- AVIF and HEIC: an ICC profile counts before nclx, the `colr` property of the primary item or, where that is
  put together from tiles, of the first one.
- EXIF of cameras (DCF 2.0): the interoperability index R03 is Adobe RGB.

Files without any of these are sRGB.
"""

import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import IO, Any, NamedTuple

from PIL.ExifTags import IFD
from PIL.ExifTags import Base as Tag
from PIL.ImageFile import ImageFile

from ..io.transfer import ADOBE_GAMMA, ADOBE_RGB, BT709, SRGB, Chromaticities, ColourSpace, colour_space


class ColourTag(NamedTuple):
    """Colours of a file, as it says."""

    space: ColourSpace = SRGB
    full_range: bool = True
    """False: black and white lie at 16 and 235 of 255."""
    over_profile: bool = False
    """True for what counts before an ICC profile."""
    bits: int = 8
    """Bits of a channel, where the file's boxes say so."""
    unknown: str = ""
    """Tags that no colours are known for, in words; it is read as sRGB."""

    @property
    def changes(self) -> bool:
        """False where signals are sRGB's already."""
        return self.space != SRGB or not self.full_range


_SAME_CHROMATICITY = 0.002
"""Difference of x or y up to which primaries are those of sRGB: files round to three digits, by eye."""
_SAME_GAMMA = 0.05
"""Share by which a gamma may differ from sRGB's 2.2, as libpng has it (PNG_GAMMA_THRESHOLD)."""
_SRGB_GAMMA = 2.2
"""Exponent that stands for the curve of sRGB in gAMA (PNG, section 11.3.2.5: sRGB is written as 45455)."""
_PNG_UNIT = 100_000
"""Unit of gAMA and cHRM."""
_MAX_BOXES = 20_000
"""Boxes of an AVIF or HEIC file that are read; pictures of 100 million pixels have hundreds."""
_MAX_HEADER_BYTES = 64 << 20
"""Bytes of a `meta` box that are read."""


def png_tag(file: IO[bytes]) -> ColourTag:
    """The colour tag of an open PNG file by its cICP, sRGB, gAMA and cHRM chunks."""
    chunks: dict[bytes, bytes] = {}
    for kind, body in _png_chunks(file):
        chunks.setdefault(kind, body)
    unknown = ""
    cicp = chunks.get(b"cICP", b"")
    if len(cicp) == 4:
        primaries, curve, matrix, full_range = cicp
        space = colour_space(primaries, curve)
        if space is not None and matrix == 0:
            return ColourTag(space, bool(full_range), over_profile=True)
        unknown = f"cICP {primaries}/{curve}/{matrix}"
    if b"sRGB" in chunks:
        return ColourTag(unknown=unknown)
    return ColourTag(_calibrated(chunks.get(b"gAMA", b""), chunks.get(b"cHRM", b"")), unknown=unknown)


def _png_chunks(file: IO[bytes]) -> Iterator[tuple[bytes, bytes]]:
    """Kind and content of the small chunks before the pixels."""
    file.seek(8)
    while len(head := file.read(8)) == 8:
        size, kind = struct.unpack(">I4s", head)
        if kind in (b"IDAT", b"IEND"):
            return
        if kind in (b"cICP", b"sRGB", b"gAMA", b"cHRM"):
            yield kind, file.read(size)
            file.seek(4, 1)
        else:
            file.seek(size + 4, 1)


def _calibrated(gamma_chunk: bytes, primaries_chunk: bytes) -> ColourSpace:
    """The colour space of gAMA and cHRM; sRGB's where they are absent, hardly differ from it or make no sense."""
    primaries = BT709
    if len(primaries_chunk) == 32:
        white_x, white_y, *rest = (value / _PNG_UNIT for value in struct.unpack(">8I", primaries_chunk))
        corners = [*zip(rest[::2], rest[1::2], strict=True), (white_x, white_y)]
        found: Chromaticities = (corners[0], corners[1], corners[2], corners[3])
        if _usable(found) and _apart(found, BT709) > _SAME_CHROMATICITY:
            primaries = found
    if len(gamma_chunk) == 4:
        (stored,) = struct.unpack(">I", gamma_chunk)
        if stored and abs(_PNG_UNIT / stored / _SRGB_GAMMA - 1) > _SAME_GAMMA:
            return ColourSpace(primaries=primaries, curve="power", gamma=_PNG_UNIT / stored)
    return ColourSpace(primaries=primaries)


def _usable(primaries: Chromaticities) -> bool:
    """True for chromaticities that a triangle can be made of, with the white inside."""
    (red, green, blue, white) = primaries

    def side(a: tuple[float, float], b: tuple[float, float]) -> float:
        return (b[0] - a[0]) * (white[1] - a[1]) - (b[1] - a[1]) * (white[0] - a[0])

    turns = (side(red, green), side(green, blue), side(blue, red))
    ranged = all(0 <= x <= 1 and 0 <= y <= 1 for x, y in primaries)
    return ranged and white[1] > 0 and (min(turns) > 0 or max(turns) < 0)


def _apart(one: Chromaticities, other: Chromaticities) -> float:
    """Largest difference of two sets of chromaticities."""
    most = 0.0
    for a, b in zip(one, other, strict=True):
        most = max(most, abs(a[0] - b[0]), abs(a[1] - b[1]))
    return most


def exif_tag(image: ImageFile) -> ColourTag:
    """The colour tag of a camera's EXIF block: Adobe RGB or sRGB."""
    try:
        index = image.getexif().get_ifd(IFD.Interop).get(Tag.InteropIndex, "")
    except Exception:  # whatever is wrong with the block, it says nothing then
        return ColourTag()
    if str(index).strip("\0 ") != "R03":
        return ColourTag()
    return ColourTag(ColourSpace(primaries=ADOBE_RGB, curve="power", gamma=ADOBE_GAMMA))


def boxes_tag(file: IO[bytes]) -> ColourTag:
    """The colour tag of an open AVIF or HEIC file by its nclx; sRGB where it has none, or is damaged."""
    try:
        return _tag_of_items(_meta_box(file))
    except (struct.error, IndexError, ValueError):
        return ColourTag()


def _tag_of_items(meta: bytes) -> ColourTag:
    """The colour tag of the primary item of a `meta` box (ISO 23008-12)."""
    boxes = dict(_boxes(meta, 4))
    primary = _item_number(boxes.get(b"pitm", b""))
    inside = dict(_boxes(boxes.get(b"iprp", b""), 0))
    properties = [*_boxes(inside.get(b"ipco", b""), 0)]
    of_items = _associations(inside.get(b"ipma", b""))
    # A picture of tiles may leave its colours to them.
    items = [primary, *_tiles(boxes.get(b"iref", b""), primary)[:1]]
    bits = 8
    found: ColourTag | None = None
    for item in items:
        for number in of_items.get(item, ()):
            if not 0 < number <= len(properties):
                continue
            kind, body = properties[number - 1]
            if kind == b"pixi":
                bits = max(bits, *body[5:])
            if kind == b"colr" and body[:4] == b"nclx" and found is None:
                found = _nclx(body)
    return (found or ColourTag())._replace(bits=bits)


def _nclx(body: bytes) -> ColourTag:
    """The colour tag of an nclx; its matrix and range are undone by the decoder."""
    primaries, curve = struct.unpack(">HH", body[4:8])
    space = colour_space(primaries, curve)
    if space is None:
        return ColourTag(unknown=f"nclx {primaries}/{curve}")
    return ColourTag(space)


def _meta_box(file: IO[bytes]) -> bytes:
    """The content of the `meta` box of a file; empty where it has none."""
    file.seek(0, 2)
    end = file.tell()
    at = 0
    for _ in range(_MAX_BOXES):
        file.seek(at)
        head = file.read(16)
        if len(head) < 8:
            return b""
        size, kind = struct.unpack(">I4s", head[:8])
        begin = 8
        if size == 1:
            (size,) = struct.unpack(">Q", head[8:])
            begin = 16
        size = size or end - at
        if size < begin:
            return b""
        if kind == b"meta":
            file.seek(at + begin)
            return file.read(min(size - begin, _MAX_HEADER_BYTES))
        at += size
    return b""


def _boxes(data: bytes, at: int) -> Iterator[tuple[bytes, bytes]]:
    """Kind and content of the boxes in some bytes from a place on."""
    for _ in range(_MAX_BOXES):
        if at + 8 > len(data):
            return
        size, kind = struct.unpack(">I4s", data[at : at + 8])
        begin = 8
        if size == 1:
            (size,) = struct.unpack(">Q", data[at + 8 : at + 16])
            begin = 16
        size = size or len(data) - at
        if size < begin:
            return
        yield kind, data[at + begin : at + size]
        at += size


def _item_number(body: bytes) -> int:
    """The item that a `pitm` box names."""
    return int.from_bytes(body[4:8] if body[:1] == b"\1" else body[4:6], "big")


def _associations(body: bytes) -> dict[int, list[int]]:
    """Numbers of properties, from 1, by item, of an `ipma` box."""
    if not body:
        return {}
    item_bytes = 4 if body[0] else 2
    number_bytes = 2 if body[3] & 1 else 1
    (count,) = struct.unpack(">I", body[4:8])
    at = 8
    found: dict[int, list[int]] = {}
    for _ in range(min(count, _MAX_BOXES)):
        item = int.from_bytes(body[at : at + item_bytes], "big")
        at += item_bytes
        numbers = found.setdefault(item, [])
        for _ in range(body[at]):
            # The highest bit says whether the property is essential.
            number = int.from_bytes(body[at + 1 : at + 1 + number_bytes], "big")
            numbers.append(number & (2 ** (8 * number_bytes - 1) - 1))
            at += number_bytes
        at += 1
    return found


def _tiles(body: bytes, item: int) -> Sequence[int]:
    """The items that an item is derived from, by an `iref` box."""
    if not body:
        return ()
    number_bytes = 4 if body[0] else 2
    for kind, reference in _boxes(body, 4):
        source = int.from_bytes(reference[:number_bytes], "big")
        if kind != b"dimg" or source != item:
            continue
        rest = reference[number_bytes + 2 :]
        found = []
        for at in range(0, len(rest), number_bytes):
            found.append(int.from_bytes(rest[at : at + number_bytes], "big"))
        return found
    return ()


def heif_tag(information: Mapping[Any, Any]) -> ColourTag:
    """The colour tag that libheif found where the boxes hold none: that of the coded picture itself."""
    nclx = information.get("nclx_profile") or {}
    space = colour_space(nclx.get("color_primaries", 2), nclx.get("transfer_characteristics", 2))
    return ColourTag() if space is None else ColourTag(space)
