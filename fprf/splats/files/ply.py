"""The PLY files of 3D Gaussian Splatting: one vertex a Gaussian (INRIA), and SuperSplat's compressed chunks of 256.

INRIA       float32 x y z, f_dc_0..2, f_rest_* channel by channel, opacity (logit), scale_0..2 (ln), rot_0..3 (w x y z), and
            any other property and element, which are kept. Header comments: `SplatRenderMode: default|mip|2dgs` (Brush),
            `antialiased 0|1` (Postshot).
compressed  element `chunk`: bounds of positions, ln-scales and, mostly, colours; `vertex`: four 32-bit words, position and
            scale of 11, 10 and 11 bits, rotation of 2 + 3 x 10, RGBA of 8 each; `sh`: bytes, (v + 0.5) / 256 of [-4, 4].
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ...errors import DataError
from ...types import Origin
from ..gaussians import COUNTS, Gaussians, from_arrays
from .base import (
    Bools,
    Capture,
    Floats,
    centred,
    colours_of,
    constants_of,
    finite,
    logit,
    short,
    sigmoid,
    smallest_three,
    spatial_order,
    steps,
    three_to_four,
)

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip
_NAMES = {"u1": "uchar", "u4": "uint", "i4": "int", "f4": "float", "f8": "double"}
_HEADER = 1 << 16
"""Bytes within which a header ends."""
_CHUNK = 256
_POSITION, _SCALE, _COLOUR = (
    (tuple(f"min_{v}" for v in of), tuple(f"max_{v}" for v in of))
    for of in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
)
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_SPAN = 8.0
"""Harmonics of compressed files lie in [-4, 4]."""


class _Element(NamedTuple):
    table: NDArray[np.void]
    offset: int
    """Of its first byte in the file."""


def read_ply(path: Path, data: bytes) -> Capture:
    """A PLY of either layout. Raises DataError for others, 2D Gaussians among them."""
    comments, elements = _parse(path, data)
    text = "\n".join(comments)
    antialiased = bool(re.search(r"SplatRenderMode:\s*mip|antialiased\s+1", text))
    if is_compressed(data):
        return _read_compressed(path, data, elements, antialiased)
    if re.search(r"SplatRenderMode:\s*2dgs", text):
        raise DataError(f"{path}: 2D Gaussians (SplatRenderMode: 2dgs); only 3D Gaussians are read")
    vertex = elements.get("vertex")
    if vertex is None:
        raise DataError(f"{path}: no element `vertex`; not a file of 3D Gaussians")
    table, known = vertex.table, set(vertex.table.dtype.names or ())
    if {"scale_0", "scale_1"} <= known and "scale_2" not in known:
        raise DataError(f"{path}: 2D Gaussians (no scale_2); only 3D Gaussians are read")
    rest = sum(bool(re.fullmatch(r"f_rest_\d+", name)) for name in known)
    colours = [*(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(rest))]
    count = 1 + rest // 3
    wanted = [*"xyz", "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4)), *colours]
    for name in wanted:
        if name not in known or table.dtype[name].kind != "f":
            raise DataError(f"{path}: no property {name} of floats; not a file of 3D Gaussians")
    if rest % 3 or count not in COUNTS:
        raise DataError(f"{path}: {rest} properties f_rest_*; 0, 9, 24, 45 or 72 belong to degrees 0 to 4")

    def columns(*names: str) -> Floats:
        return np.stack([table[name].astype(np.float32) for name in names], 1)

    harmonics = columns(*colours[:3])[:, None]
    if rest:
        harmonics = np.concatenate([harmonics, columns(*colours[3:]).reshape(-1, 3, count - 1).transpose(0, 2, 1)], 1)
    means, shift = centred(np.stack([table[name] for name in "xyz"], 1))
    gaussians = from_arrays(
        means,
        columns("rot_0", "rot_1", "rot_2", "rot_3"),
        columns("scale_0", "scale_1", "scale_2"),
        columns("opacity")[:, 0],
        harmonics,
    )

    def recolour(harmonics: Floats, changed: Bools) -> bytes:
        out = bytearray(data)
        target = np.frombuffer(out, table.dtype, len(table), vertex.offset)
        for name, column in zip(colours, _flat(harmonics).T, strict=True):
            target[name][changed] = column[changed]
        return bytes(out)

    return Capture(path, gaussians, antialiased, data, recolour, shift)


def ply_bytes(
    gaussians: Gaussians, antialiased: bool, normals: Floats | None = None, origin: Origin = (0.0, 0.0, 0.0)
) -> bytes:
    """The INRIA file, exact. Normals [N 3] are 0 unless given; with an origin positions are in the world, float64."""
    return ply_file({"vertex": ply_rows(gaussians, normals, origin)}, _comments(antialiased))


def ply_head(of: Gaussians, antialiased: bool, count: int, origin: Origin) -> bytes:
    """What stands before the rows of an INRIA file of `count` Gaussians such as these."""
    return _head({"vertex": ply_rows(of, origin=origin)}, _comments(antialiased), [count])


def ply_rows(gaussians: Gaussians, normals: Floats | None = None, origin: Origin = (0.0, 0.0, 0.0)) -> NDArray[np.void]:
    """Rows of the INRIA file, as `ply_bytes` has them."""
    names = [*"xyz", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3))]
    names += [f"f_rest_{i}" for i in range(3 * gaussians.harmonics.shape[1] - 3)]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    means, turns, scales, logits, harmonics = _arrays(gaussians)
    parts = [means, np.zeros_like(means) if normals is None else normals, _flat(harmonics), logits[:, None], scales, turns]
    return in_world(
        np.ascontiguousarray(np.concatenate(parts, 1), "<f4").view([(name, "<f4") for name in names])[:, 0], means, origin
    )


def in_world(table: NDArray[np.void], local: Floats, origin: Origin) -> NDArray[np.void]:
    """Rows with local x y z [N 3] about an origin as float64 of the world; as they are where the origin is 0."""
    if not any(origin):
        return table
    kinds = {name: "<f8" if name in ("x", "y", "z") else table.dtype[name] for name in table.dtype.names or ()}
    out = table.astype([*kinds.items()])
    for name, column, of in zip("xyz", local.astype(np.float64).T, origin, strict=True):
        out[name] = column + of
    return out


def _comments(antialiased: bool) -> list[str]:
    return ["SplatRenderMode: mip"] if antialiased else []


def is_compressed(data: bytes) -> bool:
    """True for a PLY with SuperSplat's layout."""
    return b"packed_position" in data[:_HEADER].partition(b"end_header")[0]


def compressed_bytes(gaussians: Gaussians, antialiased: bool) -> bytes:
    """SuperSplat's file. Gaussians are put in spatial order, so that the bounds of chunks are narrow."""
    gaussians = gaussians.select(torch.from_numpy(spatial_order(gaussians.means.numpy())))
    means, turns, scales, logits, harmonics = _arrays(gaussians)
    bounds: list[Floats] = []
    words = np.zeros((len(means), 4), np.uint32)
    for column, values in ((0, means), (2, np.clip(scales, -20, 20))):
        share, low, high = _in_chunks(values)
        words[:, column] = _pack(share, (11, 10, 11))
        bounds += [low, high]
    largest, three = smallest_three(turns)
    words[:, 1] = largest << 30 | _pack(three / 2 + 0.5, (10, 10, 10))
    share, low, high = _in_chunks(colours_of(harmonics))
    words[:, 3] = _pack(np.concatenate([share, sigmoid(logits)[:, None]], 1), (8, 8, 8, 8))
    bounds += [low, high]
    names = [name for pair in (_POSITION, _SCALE, _COLOUR) for of in pair for name in of]
    chunk = np.concatenate(bounds, 1).astype("<f4").view([(name, "<f4") for name in names])[:, 0]
    tables = {"chunk": chunk, "vertex": words.astype("<u4").view([(name, "<u4") for name in _PACKED])[:, 0]}
    if harmonics.shape[1] > 1:
        rest = _rest_bytes(_flat(harmonics)[:, 3:])
        tables["sh"] = rest.view([(f"f_rest_{i}", "u1") for i in range(rest.shape[1])])[:, 0]
    return ply_file(tables, _comments(antialiased))


def _read_compressed(path: Path, data: bytes, elements: dict[str, _Element], antialiased: bool) -> Capture:
    chunk, vertex, sh = (elements.get(name) for name in ("chunk", "vertex", "sh"))
    tinted = chunk is not None and _COLOUR[0][0] in (chunk.table.dtype.names or ())
    bounds = [name for pair in (_POSITION, _SCALE, *([_COLOUR] if tinted else [])) for of in pair for name in of]
    for element, names, kind in ((chunk, bounds, "<f4"), (vertex, _PACKED, "<u4")):
        for name in names:
            if element is None or name not in (element.table.dtype.names or ()) or element.table.dtype[name] != kind:
                raise DataError(f"{path}: no property {name}; not the compressed layout of SuperSplat")
    assert chunk is not None and vertex is not None
    count, of = len(vertex.table), np.arange(len(vertex.table)) // _CHUNK
    rest = [] if sh is None else list(sh.table.dtype.names or ())
    names = [f"f_rest_{i}" for i in range(len(rest))]
    wrong = 1 + len(rest) // 3 not in COUNTS or len(rest) % 3 or rest != names
    if sh is not None and (wrong or len(sh.table) != count or any(sh.table.dtype[name] != "u1" for name in rest)):
        raise DataError(f"{path}: element `sh` with {len(rest)} properties and {len(sh.table)} rows; not SuperSplat's layout")
    if len(chunk.table) != -(-count // _CHUNK):
        raise DataError(f"{path}: {len(chunk.table)} chunks for {count} Gaussians; there is one for each {_CHUNK}")

    def unpacked(share: Floats, pair: tuple[tuple[str, ...], tuple[str, ...]]) -> Floats:
        low, high = (np.stack([chunk.table[name][of] for name in names], 1).astype(np.float64) for names in pair)
        return np.asarray(low * (1 - share) + high * share)

    words = {name: vertex.table[name] for name in _PACKED}
    rgba = _unpack(words["packed_color"], (8, 8, 8, 8))
    colours = unpacked(rgba[:, :3], _COLOUR) if tinted else rgba[:, :3]
    harmonics = constants_of(colours)
    if sh is not None:
        raw = np.stack([sh.table[name] for name in rest], 1)
        share = np.where(raw == 0, 0.0, np.where(raw == 255, 1.0, (raw + 0.5) / 256))
        harmonics = np.concatenate([harmonics, ((share - 0.5) * _SPAN).reshape(count, 3, -1).transpose(0, 2, 1)], 1)
    turned = words["packed_rotation"]
    means, shift = centred(unpacked(_unpack(words["packed_position"], (11, 10, 11)), _POSITION))
    gaussians = from_arrays(
        means,
        three_to_four((turned >> 30).astype(np.int64), 2 * _unpack(turned, (10, 10, 10)) - 1),
        unpacked(_unpack(words["packed_scale"], (11, 10, 11)), _SCALE),
        logit(rgba[:, 3]),
        harmonics,
    )

    def recolour(harmonics: Floats, changed: Bools) -> bytes:
        out = bytearray(data)
        target = np.frombuffer(out, vertex.table.dtype, count, vertex.offset)
        share = colours_of(harmonics)
        if tinted:  # a chunk in which anything changes gets new bounds, and all of its colours are rounded again
            share, *limits = _in_chunks(share)
            there = np.unique(of[changed])
            changed_here = np.isin(of, there)
            bounds = np.frombuffer(out, chunk.table.dtype, len(chunk.table), chunk.offset)
            for names, values in zip(_COLOUR, limits, strict=True):
                for name, column in zip(names, values.T, strict=True):
                    bounds[name][there] = column[there]
        else:
            changed_here = changed
        colour = _pack(share, (8, 8, 8)).astype(np.uint32) << 8 | (words["packed_color"] & 255)
        target["packed_color"][changed_here] = colour[changed_here]
        if sh is not None:
            into = np.frombuffer(out, sh.table.dtype, count, sh.offset)
            for name, column in zip(rest, _rest_bytes(_flat(harmonics)[:, 3:]).T, strict=True):
                into[name][changed] = column[changed]
        return bytes(out)

    return Capture(path, gaussians, antialiased, data, recolour, shift)


def _parse(path: Path, data: bytes) -> tuple[list[str], dict[str, _Element]]:
    """Comments, and the elements up to the first of variable length."""
    end = re.search(rb"\nend_header\r?\n", data[:_HEADER])
    if not data.startswith(b"ply") or end is None:
        raise DataError(f"{path}: no PLY header; the file is damaged or of another kind")
    lines = data[: end.start()].decode("ascii", "replace").splitlines()
    if "format binary_little_endian 1.0" not in lines:
        raise DataError(f"{path}: no binary little-endian PLY; export it again as one")
    comments, offset, elements = [line[8:] for line in lines if line.startswith("comment ")], end.end(), {}
    starts = [i for i, line in enumerate(lines) if line.startswith("element ")]
    for start, stop in zip(starts, [*starts[1:], len(lines)], strict=False):
        words, properties = lines[start].split(), [line.split() for line in lines[start + 1 : stop] if line[:9] == "property "]
        if any(each[1] == "list" for each in properties if len(each) > 1):
            break
        names = [each[2] for each in properties if len(each) == 3 and each[1] in _TYPES]
        if len(words) != 3 or not re.fullmatch(r"\d{1,12}", words[2]) or len({*names}) != len(properties) or not names:
            raise DataError(f"{path}: {lines[start]!r} or its properties are no valid PLY; export the file again")
        kind, count = np.dtype([(each[2], _TYPES[each[1]]) for each in properties]), int(words[2])
        if offset + count * kind.itemsize > len(data):
            raise short(path, len(data), offset + count * kind.itemsize, f"element {words[1]} of {count} rows")
        elements[words[1]] = _Element(np.frombuffer(data, kind, count, offset), offset)
        offset += count * kind.itemsize
    return comments, elements


def ply_file(tables: dict[str, NDArray[np.void]], comments: Sequence[str] = ()) -> bytes:
    """A little-endian binary PLY of elements by name, a property a field; a field of (count, values) is a list.

    trimesh would write meshes too, but keeps neither comments nor colours without alpha.
    """
    head = _head(tables, comments, [len(table) for table in tables.values()])
    return head + b"".join(table.tobytes() for table in tables.values())


def _head(tables: dict[str, NDArray[np.void]], comments: Sequence[str], counts: Sequence[int]) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    for (name, table), count in zip(tables.items(), counts, strict=True):
        lines.append(f"element {name} {count}")
        for field in table.dtype.names or ():
            kind = table.dtype[field]
            of = [kind] if kind.names is None else [kind[part].base for part in kind.names]
            lines.append(f"property {'list ' * (len(of) > 1)}{' '.join(_NAMES[each.str[1:]] for each in of)} {field}")
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def _arrays(gaussians: Gaussians) -> tuple[Floats, ...]:
    parts = (gaussians.means, gaussians.quaternions, gaussians.log_scales, gaussians.logits, gaussians.harmonics)
    return tuple(part.detach().cpu().numpy() for part in parts)


def _flat(harmonics: Floats) -> Floats:
    """Columns as files have them [N 3 K]: the three constants, then channel by channel."""
    rest = harmonics[:, 1:].transpose(0, 2, 1).reshape(len(harmonics), -1)
    return np.concatenate([harmonics[:, 0], rest], 1)


def _rest_bytes(rest: Floats) -> NDArray[np.uint8]:
    return np.asarray(np.clip(np.floor((finite(rest) / _SPAN + 0.5) * 256), 0, 255), np.uint8)


def _in_chunks(values: Floats) -> tuple[Floats, Floats, Floats]:
    """Values [N C] as shares of the bounds of their chunks, and these bounds [chunks C]."""
    starts, values = np.arange(0, len(values), _CHUNK), finite(values)
    low, high = (what.reduceat(values, starts, axis=0).astype(np.float32) for what in (np.minimum, np.maximum))
    at = np.arange(len(values)) // _CHUNK
    span = (high - low).astype(np.float64)[at]
    return np.where(span > 0, (values - low[at]) / np.where(span > 0, span, 1.0), 0.0), low, high


def _pack(shares: Floats, bits: Sequence[int]) -> NDArray[np.int64]:
    """Columns in [0, 1] in one word each row, the first one highest."""
    word = np.zeros(len(shares), np.int64)
    for column, width in zip(shares.T, bits, strict=True):
        word = word << width | steps(column, (1 << width) - 1)
    return word


def _unpack(word: NDArray[np.uint32], bits: Sequence[int]) -> Floats:
    """The columns of `_pack`, in [0, 1]."""
    columns, shift = [], 0
    for width in reversed(bits):
        most = (1 << width) - 1
        columns.append((word >> shift & most) / most)
        shift += width
    return np.stack(columns[::-1], 1)
