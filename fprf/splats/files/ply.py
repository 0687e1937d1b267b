"""The PLY files of 3D Gaussian Splatting: one vertex a Gaussian (INRIA), and SuperSplat's compressed chunks
of 256.

INRIA       float32 x y z, f_dc_0..2, f_rest_* channel by channel, opacity (logit), scale_0..2 (ln), rot_0..3 (w x y z), and
            any other property and element, which are kept. Header comments: `SplatRenderMode:
            default|mip|2dgs` and `Vertical axis: x|y|z|X Y Z` (Brush), `antialiased 0|1` (Postshot). Elements
            `extrinsic`, `intrinsic` and `image_size`: the camera of the one photograph that a capture was
            made of (SHARP). Variants: red green blue as bytes in the place of f_dc (Nerfstudio), no scale_2
            (2D Gaussians), either byte order, ASCII.
compressed  element `chunk`: bounds of positions, ln-scales and, mostly, colours; `vertex`: four 32-bit words,
            position and scale of 11, 10 and 11 bits, rotation of 2 + 3 x 10, RGBA of 8 each; `sh`: bytes, (v
            + 0.5) / 256 of [-4, 4].
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ...errors import DataError
from ...rendering.cameras import Cameras, ideal_cameras
from ...types import Origin
from ..gaussians import COUNTS, GaussianRows, Gaussians
from . import base
from .base import Bools, Capture, CaptureFormat, Data, Floats

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip
_NAMES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}
_COMMENT = re.compile(r"(splatrendermode|antialiased|vertical axis)\b[\s:=]*(.*)", re.IGNORECASE)
_UP = {"x": (1.0, 0.0, 0.0), "y": (0.0, -1.0, 0.0), "z": (0.0, 0.0, -1.0)}
"""What points up where a vertical axis is named by its letter, as Brush reads it: up is -y and -z."""
_COLOURS = (-1.5, 2.5)
"""Mean colours of compressed files: beyond, they are white or black from everywhere, and would spoil those of
their chunk.
"""
_CHUNK = 256
_FEW = 32
"""Outliers that are left out of compressed files; more are surroundings."""
_POSITION, _SCALE, _COLOUR = (
    (tuple(f"min_{v}" for v in of), tuple(f"max_{v}" for v in of))
    for of in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
)
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_SPAN = 8.0
"""Harmonics of compressed files lie in [-4, 4]."""


class _Element(NamedTuple):
    """Rows of a file that have the same properties."""

    kind: np.dtype[np.void]
    rows: int
    offset: int

    def table(self, data: Data | bytearray) -> NDArray[np.void]:
        """The rows, in the file's own memory."""
        return np.frombuffer(data, self.kind, self.rows, self.offset)

    def names(self) -> tuple[str, ...]:
        """Properties in the order of the file."""
        return self.kind.names or ()


@dataclass(frozen=True, kw_only=True)
class Ply(CaptureFormat):
    """INRIA's layout; SuperSplat's is read as well."""

    exact: ClassVar[bool] = True

    def recognises(self, head: bytes, size: int) -> bool:
        return head.removeprefix(b"\xef\xbb\xbf").startswith(b"ply")

    def read(self, path: Path, data: Data) -> Capture:
        """A PLY of either layout. Raises DataError for others. ASCII files become binary ones of the same
        elements.
        """
        header = _header(data)
        if header is None:
            raise DataError(
                f"{path}: no PLY header from `ply` to `end_header`; the file is damaged or of another kind"
            )
        elements = _elements(path, data, header)
        if header.form == ["ascii", "1.0"]:
            data, elements = _from_ascii(path, data, header, elements)
        # What comments say; of several on how opacities are meant the last counts.
        texts = (" ".join(words[1:]) for words in header.lines if words[0] in ("comment", "obj_info"))
        said = {found[1].lower(): found[2].lower() for text in texts if (found := _COMMENT.match(text))}
        modes = [key for key in said if key != "vertical axis"]
        mode = said[modes[-1]] if modes else ""
        read = _read_compressed if header.packed else _read_inria
        up = _up(said.get("vertical axis", ""))
        camera = _camera(data, elements)
        if up is None and camera is not None:
            up = (float(camera.pose[0, 0, 1]), float(camera.pose[0, 1, 1]), float(camera.pose[0, 2, 1]))
        return replace(read(path, data, elements), antialiased=mode in ("mip", "1"), up=up, camera=camera)

    def pack(self, gaussians: Gaussians, antialiased: bool, origin: Origin) -> Iterable[bytes]:
        """Exact; with an origin positions are in the world, float64."""
        return self.pack_rows(GaussianRows(len(gaussians), gaussians.select, antialiased), origin)

    def pack_rows(self, rows: GaussianRows, origin: Origin) -> Iterator[bytes]:
        """In pieces, of which one at a time is in memory."""
        yield ply_head({"vertex": ply_rows(rows.part(slice(0, 1)), origin)}, rows.antialiased, rows.count)
        for some in base.pieces(rows.count):
            yield ply_rows(rows.part(some), origin).tobytes()

    def holds(self, capture: Capture, read_as: CaptureFormat) -> bool:
        """A compressed file may be called .ply: under the same ending it stays what it is."""
        return type(read_as) is Ply


@dataclass(frozen=True, kw_only=True)
class CompressedPly(Ply):
    """SuperSplat's .compressed.ply."""

    exact: ClassVar[bool] = False

    def pack(self, gaussians: Gaussians, antialiased: bool, origin: Origin) -> list[bytes]:
        """Gaussians are put in spatial order, so that the bounds of chunks are narrow.

        No chunk holds both the bulk and what is far from it: before the latter transparent Gaussians fill up
        the last one.
        """
        # Neighbours share a chunk; what is far from the bulk begins a chunk of its own.
        order = base.spatial_order(gaussians.means.numpy())
        level = base.levels_of(gaussians.means.numpy())
        parts = []
        for k in range(int(level.max(initial=0)) + 1):
            parts.append(order[level[order] == k])
        parts = [np.append(part, np.full(-len(part) % _CHUNK, part[-1])) for part in parts[:-1]] + parts[-1:]
        index = np.concatenate(parts)
        filled = index[1:] == index[:-1]
        means, turns, scales, logits, harmonics = base.arrays(gaussians.select(torch.from_numpy(index)))
        # Each property as shares of the bounds of its chunk, several in one word.
        bounds: list[Floats] = []
        words = np.zeros((len(means), 4), np.uint32)
        for column, values in ((0, means), (2, np.clip(scales, -20, 20))):
            share, low, high = _in_chunks(values)
            words[:, column] = base.pack_bits(share, (11, 10, 11))
            bounds += [low, high]
        largest, three = base.smallest_three(turns)
        words[:, 1] = largest << 30 | base.pack_bits(three / 2 + 0.5, (10, 10, 10))
        share, low, high = _in_chunks(base.colours_of(harmonics).clip(*_COLOURS))
        opacity = base.sigmoid(logits)
        opacity[1:][filled] = 0
        words[:, 3] = base.pack_bits(np.concatenate([share, opacity[:, None]], 1), (8, 8, 8, 8))
        bounds += [low, high]
        # Three tables: bounds of chunks, words of Gaussians and bytes of harmonics.
        names = []
        for pair in (_POSITION, _SCALE, _COLOUR):
            for of in pair:
                for name in of:
                    names.append(name)
        chunk = np.concatenate(bounds, 1).astype("<f4").view([(name, "<f4") for name in names])[:, 0]
        tables = {
            "chunk": chunk,
            "vertex": words.astype("<u4").view([(name, "<u4") for name in _PACKED])[:, 0],
        }
        if harmonics.shape[1] > 1:
            rest = _rest_bytes(harmonics)
            tables["sh"] = rest.view([(f"f_rest_{i}", "u1") for i in range(rest.shape[1])])[:, 0]
        return [ply_file(tables, antialiased)]

    def keeps(self, gaussians: Gaussians) -> Bools:
        """All but a few outliers, which would need chunks of their own."""
        level = base.levels_of(gaussians.means.numpy())
        beyond = len(level) - np.cumsum(np.bincount(level, minlength=1))
        return level <= int((beyond <= _FEW).argmax())

    def holds(self, capture: Capture, read_as: CaptureFormat) -> bool:
        header = None
        if isinstance(read_as, Ply):
            header = _header(capture.data)
        return header is not None and header.packed


def ply_rows(gaussians: Gaussians, origin: Origin) -> NDArray[np.void]:
    """Rows of the INRIA file. Normals, which nobody reads and some demand, are 0."""
    means, turns, scales, logits, harmonics = base.arrays(gaussians)
    names = [*"xyz", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3))]
    names += [f"f_rest_{i}" for i in range(3 * harmonics.shape[1] - 3)]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    columns = np.concatenate(
        [means, np.zeros_like(means), _flat(harmonics), logits[:, None], scales, turns], 1
    )
    return base.in_world(
        np.ascontiguousarray(columns, "<f4").view([(name, "<f4") for name in names])[:, 0], means, origin
    )


def ply_file(
    tables: Mapping[str, NDArray[np.void]], antialiased: bool = False, comments: Sequence[str] = ()
) -> bytes:
    """A little-endian binary PLY of elements by name, a property a field; a field of (count, values) is a
    list.

    trimesh would write meshes too, but keeps neither comments nor colours without alpha.
    """
    return ply_head(tables, antialiased, comments=comments) + b"".join(
        table.tobytes() for table in tables.values()
    )


def ply_head(
    tables: Mapping[str, NDArray[np.void]],
    antialiased: bool,
    count: int | None = None,
    *,
    comments: Sequence[str] = (),
) -> bytes:
    """The header of `ply_file`, with lines of `comments`. `count` is the number of rows where the tables are
    samples.
    """
    lines = ["ply", "format binary_little_endian 1.0", *comments]
    lines += ["comment SplatRenderMode: mip"] if antialiased else []
    for name, table in tables.items():
        lines.append(f"element {name} {len(table) if count is None else count}")
        for field in table.dtype.names or ():
            kind = table.dtype[field]
            if kind.names is None:
                of = [kind]
            else:
                of = [kind[part].base for part in kind.names]
            lines.append(
                f"property {'list ' * (len(of) > 1)}{' '.join(_NAMES[each.str[1:]] for each in of)} {field}"
            )
    return "\n".join([*lines, "end_header", ""]).encode("latin-1")  # as headers are read


class _Header(NamedTuple):
    lines: list[list[str]]
    """Words of each line but the first and the last."""
    size: int
    """Bytes before the first row."""

    @property
    def packed(self) -> bool:
        """SuperSplat's layout."""
        return any(words[0] == "property" and words[-1] == _PACKED[0] for words in self.lines)

    @property
    def form(self) -> list[str]:
        """Words of the format and its version; none where no line says them."""
        return next((words[1:] for words in self.lines if words[0] == "format"), [])


def _read_inria(path: Path, data: Data, elements: Mapping[str, _Element]) -> Capture:
    # First every property that is needed is looked for; then rows are read, and later recoloured, in pieces.
    vertex = elements.get("vertex")
    if vertex is None:
        raise DataError(f"{path}: no element `vertex`; not a file of 3D Gaussians")
    known = set(vertex.names())
    # Properties may stand in any order, among any others. 2D Gaussians have no third size, and lie in the
    # plane of the others.
    rest = sum(bool(re.fullmatch(r"f_rest_\d+", name)) for name in known)
    byte_colours = "f_dc_0" not in known and {"red", "green", "blue"} <= known
    if byte_colours:
        constants = ("red", "green", "blue")
    else:
        constants = ("f_dc_0", "f_dc_1", "f_dc_2")
    colours = [*constants, *(f"f_rest_{i}" for i in range(rest))]
    sizes = ["scale_0", "scale_1", *(["scale_2"] if "scale_2" in known or "scale_1" not in known else [])]
    count = 1 + rest // 3
    for name in [*"xyz", "opacity", *sizes, *(f"rot_{i}" for i in range(4)), *colours]:
        if name not in known:
            raise DataError(f"{path}: no property {name}; not a file of 3D Gaussians")
        if byte_colours and name in constants and vertex.kind[name] != "u1":
            raise DataError(
                f"{path}: property {name} is no byte; colours are bytes, or f_dc_0 to f_dc_2 of float"
            )
        if vertex.kind[name].kind != "f" and name not in "xyz" and not (byte_colours and name in constants):
            raise DataError(
                f"{path}: property {name} is of whole numbers; 3D Gaussians have float or double there"
            )
    if rest % 3 or count not in COUNTS:
        raise DataError(f"{path}: {rest} properties f_rest_*; 0, 9, 24, 45 or 72 belong to degrees 0 to 4")
    # The harmonic and the channel that each property of a colour is.
    places = {name: (0, i) for i, name in enumerate(constants)}
    places |= {f"f_rest_{i}": (1 + i % (count - 1), i // (count - 1)) for i in range(rest)}
    whole = vertex.table(data)

    def part(rows: slice) -> tuple[Floats, ...]:
        table = whole[rows]
        harmonics = np.empty((len(table), count, 3))
        scales = np.full((len(table), 3), -np.inf)
        for name, (band, channel) in places.items():
            harmonics[:, band, channel] = table[name]
        if byte_colours:
            harmonics[:, :1] = base.constants_of(harmonics[:, 0] / 255)
        for axis, name in enumerate(sizes):
            scales[:, axis] = table[name]
        # Positions may be of any type; far from 0 they lose nothing by their local origin.
        means = np.stack([table[name] for name in "xyz"], 1)
        turns = np.stack([table[name] for name in [f"rot_{i}" for i in range(4)]], 1)
        return means, turns, scales, table["opacity"], harmonics

    def recolour(harmonics: Floats, changed: Bools) -> Iterator[bytes]:
        """The file's own bytes, with other numbers in the columns of colours of the rows that change."""
        yield data[: vertex.offset]
        for rows in base.pieces(vertex.rows):
            table = whole[rows].copy()
            here = changed[rows]
            new = harmonics[rows]
            for name, (band, channel) in places.items():
                column = new[here, band, channel]
                if byte_colours and band == 0:
                    column = base.steps(base.colours_of(new[here]), 255)[:, channel]
                table[name][here] = column
            yield table.tobytes()
            base.release(data)
        yield data[vertex.offset + vertex.rows * vertex.kind.itemsize :]

    gaussians, shift = base.decoded(count, (vertex.rows, part))
    return Capture(path, gaussians, False, data, recolour, shift=shift)


def _read_compressed(path: Path, data: Data, elements: Mapping[str, _Element]) -> Capture:
    # All properties that SuperSplat writes must be there, of its types; only bounds of colours are missing in
    # early files.
    known = {name: element.names() for name, element in elements.items()}
    tinted = _COLOUR[0][0] in known.get("chunk", ())
    bounds = [
        name for pair in (_POSITION, _SCALE, *([_COLOUR] if tinted else [])) for of in pair for name in of
    ]
    for element, names, kind in (("chunk", bounds, "<f4"), ("vertex", _PACKED, "<u4")):
        for name in names:
            if name not in known.get(element, ()) or elements[element].kind[name] != kind:
                raise DataError(f"{path}: no property {name}; not the compressed layout of SuperSplat")
    chunk = elements["chunk"].table(data)
    vertex = elements["vertex"].table(data)
    # `of` is the chunk of each Gaussian. Harmonics, where there are any, are one row of bytes a Gaussian.
    count = len(vertex)
    of = np.arange(len(vertex)) // _CHUNK
    sh = elements["sh"].table(data) if "sh" in elements else None
    rest = known.get("sh", ())
    wrong = (
        1 + len(rest) // 3 not in COUNTS
        or len(rest) % 3
        or [*rest] != [f"f_rest_{i}" for i in range(len(rest))]
    )
    if sh is not None and (wrong or len(sh) != count or any(sh.dtype[name] != "u1" for name in rest)):
        raise DataError(
            f"{path}: element `sh` with {len(rest)} properties and {len(sh)} rows; not SuperSplat's layout"
        )
    if len(chunk) != -(-count // _CHUNK):
        raise DataError(f"{path}: {len(chunk)} chunks for {count} Gaussians; there is one for each {_CHUNK}")

    def part(rows: slice) -> tuple[Floats, ...]:
        """Some of the Gaussians as `base.decoded` wants them."""

        def unpacked(share: Floats, pair: tuple[tuple[str, ...], tuple[str, ...]]) -> Floats:
            low, high = (
                np.stack([chunk[name][of[rows]] for name in names], 1).astype(np.float64) for names in pair
            )
            return np.asarray(low * (1 - share) + high * share)

        position, turned, scale, colour = (vertex[name][rows] for name in _PACKED)
        rgba = base.unpack_bits(colour, (8, 8, 8, 8))
        harmonics = base.constants_of(unpacked(rgba[:, :3], _COLOUR) if tinted else rgba[:, :3])
        if sh is not None:
            # The two outermost bytes stand for the very ends of the range.
            raw = np.stack([sh[name][rows] for name in rest], 1)
            share = np.where(raw == 0, 0.0, np.where(raw == 255, 1.0, (raw + 0.5) / 256))
            bands = ((share - 0.5) * _SPAN).reshape(len(raw), 3, -1).transpose(0, 2, 1)
            harmonics = np.concatenate([harmonics, bands], 1)
        return (
            unpacked(base.unpack_bits(position, (11, 10, 11)), _POSITION),
            base.three_to_four(
                (turned >> 30).astype(np.int64), 2 * base.unpack_bits(turned, (10, 10, 10)) - 1
            ),
            unpacked(base.unpack_bits(scale, (11, 10, 11)), _SCALE),
            base.logit(rgba[:, 3]),
            harmonics,
        )

    def recolour(harmonics: Floats, changed: Bools) -> list[bytes]:
        out = bytearray(data)
        target = {name: element.table(out) for name, element in elements.items()}
        share = base.colours_of(base.finite(harmonics))
        changed_here = changed
        if (
            tinted
        ):  # a chunk in which anything changes gets new bounds, and all of its colours are rounded again
            share, *limits = _in_chunks(share.clip(*_COLOURS))
            there = np.unique(of[changed])
            changed_here = np.isin(of, there)
            for names, values in zip(_COLOUR, limits, strict=True):
                for name, column in zip(names, values.T, strict=True):
                    target["chunk"][name][there] = column[there]
        colour = base.pack_bits(share, (8, 8, 8)).astype(np.uint32) << 8 | (vertex["packed_color"] & 255)
        target["vertex"]["packed_color"][changed_here] = colour[changed_here]
        for name, column in zip(rest, _rest_bytes(harmonics).T, strict=True):
            target["sh"][name][changed] = column[changed]
        return [bytes(out)]

    gaussians, shift = base.decoded(1 + len(rest) // 3, (count, part))
    return Capture(path, gaussians, False, data, recolour, shift=shift)


def _header(data: Data) -> _Header | None:
    """The header, whose lines end as the first one does: with LF, CR LF or CR. None where it has no begin or
    no end.
    """
    first = re.match(rb"(?:\xef\xbb\xbf)?ply[ \t]*(\r\n|\n|\r)", data)
    if first is None:
        return None
    newline = rb"\r" if first[1] == b"\r" else rb"\r?\n"
    end = re.compile(newline + rb"[ \t]*end_header[ \t]*" + newline).search(data, first.start(1))
    if end is None:
        return None
    lines = re.split(newline, data[first.end() : max(first.end(), end.start())])
    words = []
    for line in lines:
        words.append(re.split(r"[ \t]+", line.decode("latin-1").strip(" \t")))
    return _Header([each for each in words if each[0]], end.end())


def _elements(path: Path, data: Data, header: _Header) -> dict[str, _Element]:
    """Elements by name, where they lie; those with lists are passed over. Those of ASCII files lie nowhere
    yet.
    """
    form = header.form
    ascii_rows = header.form == ["ascii", "1.0"]
    if form not in (["binary_little_endian", "1.0"], ["binary_big_endian", "1.0"]) and not ascii_rows:
        raise DataError(
            f"{path}: a PLY of format {' '.join(form) or 'unknown'}; export it again as ascii or binary 1.0"
        )
    # Elements lie one after the other: each is passed over to find the next.
    types = {}
    for name, kind in _TYPES.items():
        types[name] = kind.replace("<", ">") if "big" in form[0] else kind
    lines = [words for words in header.lines if words[0] in ("element", "property")]
    starts = [i for i, words in enumerate(lines) if words[0] == "element"]
    offset = header.size
    elements = {}
    for start, stop in zip(starts, [*starts[1:], len(lines)], strict=False):
        words = lines[start]
        properties = lines[start + 1 : stop]
        kinds = []
        for each in properties:
            kinds.append([types[kind] for kind in _kinds(each) if kind in types])
        names = set()
        for each, of in zip(properties, kinds, strict=True):
            if of and len(of) == len(_kinds(each)):
                names.add(each[-1])
        if (
            len(words) != 3
            or not re.fullmatch(r"\d{1,12}", words[2])
            or len(names) != len(properties)
            or not names
        ):
            raise DataError(
                f"{path}: {' '.join(words)!r} or its properties are no valid PLY; export the file again"
            )
        count = int(words[2])
        what = f"element {words[1]} of {words[2]} rows"
        if any(len(of) > 1 for of in kinds):
            if ascii_rows:
                elements[words[1]] = _Element(np.dtype([]), count, offset)
                continue
            if "vertex" in elements:
                # lists that follow the Gaussians may be cut, and the million faces of a mesh take seconds
                break
            if (after := _after_lists(data, offset, count, kinds)) is None:
                raise DataError(
                    f"{path}: {what} runs beyond the end of the file; copy it again, it is cut off or damaged"
                )
            offset = after
            continue
        table = np.dtype([(each[-1], of[0]) for each, of in zip(properties, kinds, strict=True)])
        # A number of ASCII takes two bytes at least.
        end = offset + count * (2 * len(kinds) if ascii_rows else table.itemsize)
        if end > len(data) + ascii_rows:
            raise base.short(path, len(data), end, what)
        elements[words[1]] = _Element(table, count, offset)
        offset = end
    return elements


def _from_ascii(
    path: Path, data: Data, header: _Header, elements: Mapping[str, _Element]
) -> tuple[bytes, dict[str, _Element]]:
    """A little-endian file of the elements of an ASCII one, a line a row; those with lists are left out."""
    lines = iter(data[header.size :].splitlines())
    tables: dict[str, NDArray[np.void]] = {}
    for name, element in elements.items():
        try:
            if element.names() and element.rows:
                # A row is a line; numbers are read as float64 and then rounded to their own type.
                numbers = np.loadtxt(lines, np.float64, comments=None, max_rows=element.rows, ndmin=2)
                if len(numbers) != element.rows:
                    raise ValueError(f"{len(numbers)} of {element.rows} rows")
                table = np.empty(element.rows, element.kind)
                for field, column in zip(element.names(), numbers.T, strict=True):
                    table[field] = column
                tables[name] = table
            elif not element.names():
                for _ in range(element.rows):
                    next(lines)
        except (ValueError, StopIteration) as error:
            raise DataError(
                f"{path}: the rows of element {name} are no numbers for its properties ({error})"
            ) from error
    # Comments go along, which may say what points up.
    whole = ply_file(
        tables, comments=[" ".join(words) for words in header.lines if words[0] in ("comment", "obj_info")]
    )
    binary = _header(whole)
    assert binary is not None
    return whole, _elements(path, whole, binary)


def _kinds(words: list[str]) -> list[str]:
    """Types of a property: one, or those of a list's length and values; none where the line is neither."""
    if len(words) == 5 and words[1] == "list" and words[2] not in ("float", "float32", "double", "float64"):
        return words[2:4]
    return words[1:2] if len(words) == 3 else []


def _after_lists(data: Data, offset: int, count: int, fields: Sequence[Sequence[str]]) -> int | None:
    """Where rows with lists end; None where that is beyond the end of the file."""
    for _ in range(count):
        for first, *values in fields:
            kind = np.dtype(first)
            if offset + kind.itemsize > len(data):
                return None
            if values:
                length = int(np.frombuffer(data, kind, 1, offset)[0])
            else:
                length = 0
            offset += kind.itemsize + max(length, 0) * (np.dtype(values[0]).itemsize if values else 0)
        if offset > len(data):
            return None
    return offset


def _up(text: str) -> tuple[float, float, float] | None:
    """The direction up of `Vertical axis: z` or `0 0 1`; a letter with a sign is that direction."""
    numbers = text.replace(",", " ").strip("[]() ").split()
    letter = numbers[0].lstrip("+-") if numbers else ""
    if letter in _UP:
        if numbers[0] == letter:
            return _UP[letter]
        sign = -1.0 if numbers[0][0] == "-" else 1.0
        numbers = [str(sign * (letter == axis)) for axis in _UP]
    try:
        x, y, z = map(float, numbers)
    except ValueError:
        return None
    return (x, y, z) if 0 < x * x + y * y + z * z < np.inf else None


def _camera(data: Data, elements: Mapping[str, _Element]) -> Cameras | None:
    """The camera of `extrinsic` (world to camera, OpenCV axes), `intrinsic` and `image_size`; None where
    there is no sound one.

    Older files have 12 numbers of `extrinsic`, its rotation transposed, and fx, fy, width and height as
    `intrinsic`.
    """
    numbers = {}
    for name in ("extrinsic", "intrinsic", "image_size"):
        if name in elements:
            table = elements[name].table(data)
            numbers[name] = np.stack(
                [table[each].astype(np.float64) for each in elements[name].names()], 1
            ).ravel()
    # Without a pose the camera is at the origin and looks along z.
    matrix = numbers.get("extrinsic", np.eye(4).ravel())
    lens = numbers.get("intrinsic", np.zeros(0))
    size = numbers.get("image_size", lens[2:4] if len(lens) == 4 else np.zeros(0))
    if len(matrix) not in (12, 16) or len(lens) not in (4, 9) or len(size) != 2:
        return None
    world = matrix[:12].reshape(3, 4)
    rotation = world[:, :3].T if len(matrix) == 16 else world[:, :3]  # camera to world
    focal = lens[[0, 1] if len(lens) == 4 else [0, 4]]
    centre = size / 2 if len(lens) == 4 else lens[[2, 5]]
    sound = (
        all(np.isfinite(each).all() for each in (world, focal, centre)) and np.abs(world[:, 3]).max() < 1e15
    )
    if not sound or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-2 or np.linalg.det(rotation) < 0:
        return None
    if focal.min() <= 0 or size.min() < 1 or size.max() > 1 << 16:
        return None
    # The file has world to camera; ours is the inverse.
    pose = np.concatenate([rotation * [1.0, -1.0, -1.0], -rotation @ world[:, 3:]], 1)  # OpenGL axes
    cameras = ideal_cameras(torch.from_numpy(pose)[None], 1.0, (int(size[0]), int(size[1])))
    return replace(cameras, focal=torch.from_numpy(focal)[None], centre=torch.from_numpy(centre)[None])


def _flat(harmonics: Floats) -> Floats:
    """Columns as files have them [N 3 K]: the three constants, then channel by channel."""
    rest = harmonics[:, 1:].transpose(0, 2, 1).reshape(len(harmonics), 3 * harmonics.shape[1] - 3)
    return np.concatenate([harmonics[:, 0], rest], 1)


def _rest_bytes(harmonics: Floats) -> NDArray[np.uint8]:
    """All but the constants as compressed files have them."""
    rest = _flat(harmonics)[:, 3:]
    return np.asarray(np.clip(np.floor((base.finite(rest) / _SPAN + 0.5) * 256), 0, 255), np.uint8)


def _in_chunks(values: Floats) -> tuple[Floats, Floats, Floats]:
    """Values [N C] as shares of the bounds of their chunks, and these bounds [chunks C]."""
    starts = np.arange(0, len(values), _CHUNK)
    low = np.minimum.reduceat(values, starts, axis=0).astype(np.float32)
    high = np.maximum.reduceat(values, starts, axis=0).astype(np.float32)
    at = np.arange(len(values)) // _CHUNK
    return base.shares(values, low[at], high[at]), low, high
