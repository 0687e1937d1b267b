"""glTF 2.0 with `KHR_gaussian_splatting`: a binary .glb, or a .gltf, which is written with its buffer inside.

Primitives of points with POSITION, ROTATION (x y z w), SCALE, OPACITY in [0, 1] and SH_DEGREE_l_COEF_n,
beside any other nodes, cameras and meshes, which are kept. SCALE is a size in the final text of the extension
and its logarithm in the review draft (`_logarithmic` tells them apart). Colours are sRGB or linear
(`colorSpace`). Axes are right up back; what this module writes has those of PLY files, right down front,
under a node that turns them by 180 degrees about x.
"""

import base64
import itertools
import json
import math
import re
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np
import torch
from numpy.typing import NDArray

from ...errors import DataError
from ...io.images import srgb_to_linear
from ...rendering.north import Bearings
from ...rendering.splines import quaternions, rotations
from ...types import Origin
from ..activation import TYPICAL_LN_SIZE, nearest_distance
from ..gaussians import COUNTS, Gaussians
from . import base
from .base import Bools, Capture, CaptureFormat, Data, Floats

_EXTENSION_NAME = "KHR_gaussian_splatting"
"""As it stands in files, before each of its attributes."""
_POSITION = "POSITION"
"""Relative to the node."""
_ROTATION = f"{_EXTENSION_NAME}:ROTATION"
"""x y z w."""
_SCALE_ATTRIBUTE = f"{_EXTENSION_NAME}:SCALE"
"""Sizes, or their logarithms."""
_OPACITY = f"{_EXTENSION_NAME}:OPACITY"
"""A share, 0 to 1."""
_SHAPE_WIDTHS = {_POSITION: 3, _ROTATION: 4, _SCALE_ATTRIBUTE: 3, _OPACITY: 1}
"""Attributes of every primitive of Gaussians, and the numbers of each."""
_COMPONENT_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
"""Types by their numbers in glTF, which are OpenGL's."""
_FLOAT = 5126
"""Number of float32."""
_BYTE = 5121
"""Number of bytes."""
_WIDTH_OF_TYPE = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
"""Numbers of a row, of the types that are read."""
_TYPE_OF_WIDTH = {width: name for name, width in _WIDTH_OF_TYPE.items()}
"""The same for writing."""
_LN_SIZE_LIMITS = (-80.0, 80.0)
"""ln-scales that are written: their sizes are finite in float32, and not 0."""
_MAX_NODE_SHEAR = 1e-3
"""Of a node's matrix from a turn and one scale: float32 and rounded text are closer."""
_MAX_BUFFER_BYTES = (1 << 32) - (1 << 20)
"""Bytes of a .glb's buffer, whose lengths are 32-bit; the rest is for its document."""
_MIN_SIZE_OF_GLTF = 1e-30
"""Sizes are at least this, so that their logarithm is finite."""
_DRAFT_COLOUR_SPACES = ("BT.", "Display-P3", "linear")
"""Beginnings of colour-space names of drafts before the review draft, when SCALE was a logarithm; later texts
share theirs.
"""
_LINEAR_SINCE = (2, 7)
"""Version of splat-transform from which on its .glb has linear sizes (playcanvas/splat-transform#268)."""
_ASKED_SIZES = 64
"""Gaussians whose sizes are held against the distances between neighbours."""


class _Part(NamedTuple):
    """A primitive of Gaussians as a node shows it: scale * rotation @ point + translation is right down
    front.
    """

    columns: dict[str, NDArray[Any]]
    """Attributes [N C] in the file's own memory."""
    rotation: Floats
    scale: float
    translation: Floats
    extension: dict[str, Any]
    whole: bool
    """Its SCALE is whole numbers as they are, not shares."""

    @property
    def linear(self) -> bool:
        """Its colours are those of linear light."""
        return str(self.extension.get("colorSpace")).startswith("lin")

    def sizes(self, rows: slice | NDArray[np.int64]) -> Floats:
        """SCALE of some rows, as it stands in the file."""
        column = self.columns[_SCALE_ATTRIBUTE][rows]
        if self.whole:
            return column.astype(np.float64)
        return _values(column)

    def decoded(self, rows: slice, names: list[str], logarithmic: bool) -> tuple[Floats, ...]:
        """Means, quaternions, ln-scales, logits and harmonics of some rows; SCALE is those ln-scales, or
        sizes.
        """
        # Attributes may be whole numbers that stand for shares, except of harmonics.
        points = _values(self.columns[_POSITION][rows])
        turns = _values(self.columns[_ROTATION][rows])
        opacity = _values(self.columns[_OPACITY][rows])
        scale = self.sizes(rows)
        if not logarithmic:
            scale = np.log(np.maximum(scale, _MIN_SIZE_OF_GLTF))
        # The quaternion product of the node's rotation and the Gaussians' own.
        a, b, c, d = quaternions(torch.from_numpy(self.rotation)[None])[0].tolist()
        product = np.array([[a, -b, -c, -d], [b, a, -d, c], [c, d, a, -b], [d, -c, b, a]])
        parts = []
        for name in names:
            parts.append(_values(self.columns[name][rows]))
        harmonics = np.stack(parts, 1)
        if self.linear:
            harmonics = _in_other_light(harmonics, to_linear=False)
        return (
            self.scale * points @ self.rotation.T + self.translation,
            np.roll(turns, 1, 1) @ product.T,
            scale + np.log(self.scale),
            base.logit(opacity[:, 0]),
            np.matmul(base.turned_harmonics(self.rotation, len(names)), harmonics),
        )

    def recolour(self, names: list[str], harmonics: Floats, changed: Bools) -> None:
        """Overwrite columns of colours, and what programs without the extension show, of rows that
        changed.
        """
        back = base.turned_harmonics(self.rotation, len(names)).T
        for rows in base.pieces(len(self.columns[_POSITION])):
            which = changed[rows]
            new = np.matmul(back, base.finite(harmonics[rows]))
            if self.linear:
                new = _in_other_light(new, to_linear=True)
            for name, column in zip(names, new.transpose(1, 0, 2), strict=True):
                self.columns[name][rows][which] = column[which]
            plain = self.columns.get("COLOR_0")
            if plain is not None and plain.dtype == np.uint8:
                plain[rows, :3][which] = base.steps(base.colours_of(new), 255)[which]


@dataclass(frozen=True, kw_only=True)
class Gltf(CaptureFormat):
    """Khronos' .glb and .gltf."""

    def recognises(self, head: bytes, size: int) -> bool:
        return head.startswith(b"glTF") or head.lstrip()[:1] == b"{"

    def read(self, path: Path, data: Data) -> Capture:
        """All primitives of Gaussians of the file's scene. Raises DataError where there is none."""
        try:
            # Both kinds are handled as a .glb: a .gltf is packed into one first.
            if data[:4] != b"glTF":
                data = _binary(path, json.loads(bytes(data)))
            document, start = _document(data)
            parts = _parts(path, document, data, start)
            names = _colours_of_all(parts)
        except base.UNSOUND as error:
            raise DataError(
                f"{path}: no sound glTF ({error!r}); copy it again, it is damaged or of another kind"
            ) from error
        if not parts:
            raise DataError(
                f"{path}: a glTF without {_EXTENSION_NAME} in its scene; it holds no 3D Gaussians"
            )

        def recolour(harmonics: Floats, changed: Bools) -> list[bytes]:
            # The document stays byte for byte; columns of colours are overwritten in a copy of the buffer.
            out = bytearray(data)
            begin = 0
            for part in _parts(path, document, out, start):
                end = begin + len(part.columns[_POSITION])
                part.recolour(names, harmonics[begin:end], changed[begin:end])
                begin = end
            return [bytes(out)]

        logarithmic, reason = _logarithmic(document, parts)
        # One section a primitive: each has its own node, and so its own axes.
        sections = []
        for part in parts:
            decode = partial(part.decoded, names=names, logarithmic=logarithmic)
            sections.append((len(part.columns[_POSITION]), decode))
        gaussians, shift = base.decoded(len(names), *sections)
        kind = "linear, as in the final text"
        if logarithmic:
            kind = "logarithms, as in the review draft"
        compensated = parts[0].extension.get("extras") == {"antialiased": True}
        notes = (f"sizes are {kind} of {_EXTENSION_NAME}: {reason}",)
        capture = Capture(path, gaussians, compensated, data, recolour, shift=shift, notes=notes)
        return _with_bearings_of(document, capture)

    def pack(self, gaussians: Gaussians, antialiased: bool, origin: Origin) -> list[bytes]:
        """A .glb of one node; harmonics of degree 4 are left out."""
        columns = _written_columns(gaussians)
        # Each column has a view of the buffer and an accessor of that view.
        views = []
        accessors: list[dict[str, Any]] = []
        size = 0
        for number, values in enumerate(columns.values()):
            views.append({"buffer": 0, "byteOffset": size, "byteLength": values.nbytes, "target": 34962})
            accessors.append({
                "bufferView": number,
                "componentType": _FLOAT if values.dtype == "<f4" else _BYTE,
                "count": len(values),
                "type": _TYPE_OF_WIDTH[values.shape[1]],
            })  # fmt: skip
            size += values.nbytes
        # The specification demands the bounds of positions; bytes of colours stand for shares.
        means = columns[_POSITION]
        accessors[0] |= {"min": means.min(0).tolist(), "max": means.max(0).tolist()}
        accessors[-1]["normalized"] = True
        extension: dict[str, Any] = {
            "kernel": "ellipse",
            "colorSpace": "srgb_rec709_display",
            "projection": "perspective",
            "sortingMethod": "cameraDistance",
        }
        if antialiased:
            extension["extras"] = {"antialiased": True}
        primitive = {
            "attributes": {name: number for number, name in enumerate(columns)},
            "mode": 0,
            "extensions": {_EXTENSION_NAME: extension},
        }
        document = {
            "asset": {"version": "2.0", "generator": "fprf"},
            "extensionsUsed": [_EXTENSION_NAME],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "rotation": [1, 0, 0, 0]}],
            "meshes": [{"primitives": [primitive]}],
            "accessors": accessors,
            "bufferViews": views,
            "buffers": [{"byteLength": size}],
        }
        return _glb(document, [values.tobytes() for values in columns.values()])

    def with_bearings(self, pieces: Iterable[bytes], bearings: Bearings) -> list[bytes]:
        """With extras of the node, in its axes."""
        _, text, _, *body = pieces
        document = json.loads(text)
        document["nodes"][0]["extras"] = {base.OWN_KEY: bearings._asdict()}
        return _glb(document, body)

    def write(self, path: Path, pieces: Iterable[bytes]) -> None:
        """A .glb; for a .gltf its document, with the buffer as base64."""
        if path.suffix.lower() == ".gltf":
            data = b"".join(pieces)
            document, start = _document(data)
            content = base64.b64encode(data[start : start + document["buffers"][0]["byteLength"]]).decode()
            document["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{content}"
            pieces = [json.dumps(document, ensure_ascii=False).encode()]
        super().write(path, pieces)


def _colour_attributes() -> list[str]:
    """Names of the attributes of harmonics, in order."""
    names = []
    for degree in range(4):
        for number in range(2 * degree + 1):
            names.append(f"{_EXTENSION_NAME}:SH_DEGREE_{degree}_COEF_{number}")
    return names


def _written_columns(gaussians: Gaussians) -> dict[str, NDArray[Any]]:
    """The attributes of a file, in the order of its buffer; quaternions have w last."""
    means, turns, scales, logits, harmonics = base.arrays(gaussians)
    opacity = base.sigmoid(logits)[:, None]
    columns: dict[str, NDArray[Any]] = {
        _POSITION: means,
        _ROTATION: np.roll(base.unit_quaternions(turns), -1, 1),
        _SCALE_ATTRIBUTE: np.exp(scales.clip(*_LN_SIZE_LIMITS)),
        _OPACITY: opacity,
    }
    columns |= zip(_colour_attributes(), harmonics.transpose(1, 0, 2), strict=False)
    columns = {name: values.astype("<f4") for name, values in columns.items()}
    colours = np.concatenate([base.colours_of(harmonics), opacity], 1)
    columns["COLOR_0"] = base.steps(colours, 255).astype(np.uint8)
    return columns


def _glb(document: dict[str, Any], body: Iterable[bytes]) -> list[bytes]:
    """The pieces of a .glb: its header, its document and its one buffer."""
    if (needed := document["buffers"][0]["byteLength"]) > _MAX_BUFFER_BYTES:
        raise DataError(
            f"Gaussians of {needed} bytes, where a .glb holds {_MAX_BUFFER_BYTES} at most; export them as .ply or .spz"
        )
    text = json.dumps(document, separators=(",", ":"), ensure_ascii=False).encode()
    chunks = [*body]
    text += b" " * (-len(text) % 4)
    chunks.append(bytes(-sum(map(len, chunks)) % 4))
    size = sum(map(len, chunks))
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + size) + struct.pack("<I4s", len(text), b"JSON")
    return [head, text, struct.pack("<I4s", size, b"BIN\0"), *chunks]


def _document(data: Data) -> tuple[dict[str, Any], int]:
    """The document of a .glb, and where its buffer begins."""
    _, version, _, size, kind = struct.unpack_from("<4sIII4s", data)
    if version != 2 or kind != b"JSON" or 20 + size > len(data):
        raise ValueError(f"version {version} with {size} bytes of JSON in {len(data)}")
    document = json.loads(data[20 : 20 + size])
    if document["asset"]["version"][:2] != "2.":
        raise ValueError(f"asset of version {document['asset']['version']}")
    return document, 28 + size


def _binary(path: Path, document: dict[str, Any]) -> bytes:
    """The .glb of a .gltf: with its buffers, from base64 or from files in its folder, as one."""
    body = bytearray()
    starts = []
    for about in document["buffers"]:
        uri = about["uri"]
        inside = uri.startswith("data:")
        if inside:
            content = base64.b64decode(uri.partition(",")[2], validate=True)
        else:
            content = base.beside(path, unquote(uri))
        starts.append(len(body))
        body += content + bytes(-len(content) % 4)
    # Views keep their order; where each begins counts from the start of the joined buffer.
    for view in document["bufferViews"]:
        view["byteOffset"] = view.get("byteOffset", 0) + starts[view["buffer"]]
        view["buffer"] = 0
    document["buffers"] = [{"byteLength": len(body)}]
    return b"".join(_glb(document, [bytes(body)]))


def _parts(path: Path, document: dict[str, Any], data: Data | bytearray, start: int) -> list[_Part]:
    """The primitives of Gaussians that nodes of the scene show; `data` has the buffer from `start` on."""
    found = []
    for node, matrix in _shown_nodes(document):
        if "mesh" not in node:
            continue
        for primitive in document["meshes"][node["mesh"]]["primitives"]:
            if _EXTENSION_NAME in primitive.get("extensions", {}):
                columns = {}
                for name, at in primitive["attributes"].items():
                    columns[name] = _column(document, data, start, at)
                found.append(_part(path, document, primitive, columns, matrix))
    # Gaussians shown several times would multiply a small file, and have but one place for several new
    # colours.
    colours = []
    for part in found:
        colours.append(part.columns[_colour_attributes()[0]])
    colours.sort(key=lambda column: column.ctypes.data)
    if any(itertools.starmap(np.may_share_memory, itertools.pairwise(colours))):
        raise DataError(
            f"{path}: several nodes or primitives show the same Gaussians; export each with its own"
        )
    return found


def _shown_nodes(document: dict[str, Any]) -> Iterator[tuple[dict[str, Any], Floats]]:
    """Nodes of the scene, each with the matrix [4 4] from its frame to right down front."""
    nodes = document.get("nodes", [])
    seen = set[int]()
    scene = document.get("scenes", [{"nodes": range(len(nodes))}])[document.get("scene", 0)]
    # From right up back, in which a scene is, to right down front.
    waiting = []
    for index in scene.get("nodes", []):
        waiting.append((index, np.diag([1.0, -1.0, -1.0, 1.0])))
    for index, above in waiting:
        if index in seen:
            raise ValueError(f"node {index} is reached twice")
        seen.add(index)
        node = nodes[index]
        matrix = above @ _matrix_of(node)
        for child in node.get("children", []):
            waiting.append((child, matrix))
        yield node, matrix


def _with_bearings_of(document: dict[str, Any], capture: Capture) -> Capture:
    """A capture with the directions that a node of its document names."""
    for node, matrix in _shown_nodes(document):
        extras = node.get("extras")
        said = extras.get(base.OWN_KEY) if isinstance(extras, dict) else None
        if isinstance(said, dict):
            turned = []
            for name in ("north", "up"):
                direction = base.direction_of(said.get(name))
                turned.append(None if direction is None else matrix[:3, :3] @ direction)
            return base.with_said_bearings(capture, *turned)
    return capture


def _matrix_of(node: dict[str, Any]) -> Floats:
    """The matrix [4 4] from a node's frame to its parent's, or that of its parts."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    local = np.eye(4)
    (x, y, z, w) = node.get("rotation", (0, 0, 0, 1))
    turn = rotations(torch.tensor([[w, x, y, z]], dtype=torch.float64))[0].numpy()
    local[:3, :3] = turn * node.get("scale", (1, 1, 1))
    local[:3, 3] = node.get("translation", (0, 0, 0))
    return local


def _part(
    path: Path,
    document: dict[str, Any],
    primitive: dict[str, Any],
    columns: dict[str, NDArray[Any]],
    matrix: Floats,
) -> _Part:
    """A primitive of Gaussians in a frame. Raises DataError where it is none that can be read."""
    extension = primitive["extensions"][_EXTENSION_NAME]
    if extension.get("extensions"):
        packed = ", ".join(extension["extensions"])
        raise DataError(f"{path}: Gaussians packed by {packed}; export them uncompressed")
    harmonics = _colour_attributes()
    wanted = dict.fromkeys(harmonics, 3) | _SHAPE_WIDTHS
    needed = {*_SHAPE_WIDTHS, harmonics[0]}
    sound = needed <= {*columns} and len({len(column) for column in columns.values()}) == 1
    for name, column in columns.items():
        sound = sound and column.shape[1] == wanted.get(name, column.shape[1])
    if not sound:
        raise DataError(
            f"{path}: Gaussians without one of {', '.join(_SHAPE_WIDTHS)}, or of unequal shapes; export it again"
        )
    # Gaussians stay Gaussians of the same kind under turns, shifts and one scale for all axes.
    linear = matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    if not scale > 0 or not np.abs(linear @ linear.T / scale**2 - np.eye(3)).max() < _MAX_NODE_SHEAR:
        raise DataError(
            f"{path}: a node shears, mirrors or stretches its Gaussians; apply its transform first"
        )
    about = document["accessors"][primitive["attributes"][_SCALE_ATTRIBUTE]]
    whole = about["componentType"] != _FLOAT and not about.get("normalized")
    return _Part(columns, linear / scale, scale, matrix[:3, 3], extension, whole)


def _colours_of_all(parts: list[_Part]) -> list[str]:
    """Attributes of harmonics, which all primitives have, of whole degrees. Raises ValueError for others."""
    if not parts:
        return []
    names = []
    for name in _colour_attributes():
        if name in parts[0].columns:
            names.append(name)
    alike = len(names) in COUNTS
    for part in parts:
        alike = alike and {*names} == {name for name in part.columns if ":SH_" in name}
    if not alike:
        raise ValueError("harmonics of degrees that are not whole, or differ")
    return names


def _logarithmic(document: dict[str, Any], parts: list[_Part]) -> tuple[bool, str]:
    """True where SCALE holds logarithms of sizes, for all of a file's Gaussians, and the reason in words."""
    # A size is never negative; its logarithm is where anything is smaller than the unit.
    for part in parts:
        for rows in base.pieces(len(part.columns[_POSITION])):
            if bool((part.sizes(rows) < 0).any()):
                return True, "some are negative"
    # What wrote the file may be known, or the draft that it follows.
    generator = str(document["asset"].get("generator"))
    version = re.match(r"splat-transform (\d+)\.(\d+)", generator)
    if version:
        return (int(version[1]), int(version[2])) < _LINEAR_SINCE, f"{generator[:40]} wrote it"
    if generator == "fprf":
        return False, "fprf wrote it"
    for part in parts:
        if str(part.extension.get("colorSpace")).startswith(_DRAFT_COLOUR_SPACES):
            return True, f"colorSpace {part.extension['colorSpace']} is that of a draft"
    # Else sizes are held against the distances between neighbours: Gaussians that cover a surface are about
    # as wide.
    part = max(parts, key=lambda part: len(part.columns[_POSITION]))
    points = part.columns[_POSITION]
    spacing = nearest_distance(torch.from_numpy(_values(points)))
    some = np.linspace(0, len(points) - 1, _ASKED_SIZES).astype(np.int64)
    middle = np.sort(part.sizes(some), 1)[:, 1]
    middle = middle[np.isfinite(middle)]
    if spacing is None or not len(middle):
        return False, "nothing tells otherwise"
    number = float(np.median(middle))
    ratios = (math.log(max(number, _MIN_SIZE_OF_GLTF)) - math.log(spacing), number - math.log(spacing))
    logarithmic = abs(ratios[1] - TYPICAL_LN_SIZE) < abs(ratios[0] - TYPICAL_LN_SIZE)
    shares = []
    for ratio in (ratios[logarithmic], ratios[not logarithmic]):
        shares.append(f"{math.exp(min(ratio, 99)):.2g}")
    return logarithmic, f"so they are {shares[0]} of the distance between neighbours, not {shares[1]}"


def _column(document: dict[str, Any], data: Data | bytearray, start: int, index: int) -> NDArray[Any]:
    """The rows of an accessor, in the file's own memory; NumPy holds them against its size."""
    about = document["accessors"][index]
    view = document["bufferViews"][about["bufferView"]]
    kind = np.dtype(_COMPONENT_TYPES[about["componentType"]])
    width = _WIDTH_OF_TYPE[about["type"]]
    count = about["count"]
    stride = view.get("byteStride") or kind.itemsize * width
    offset = view.get("byteOffset", 0) + about.get("byteOffset", 0)
    if (
        "sparse" in about
        or view.get("buffer", 0) != 0
        or count < 1
        or stride < kind.itemsize * width
        or offset < 0
    ):
        raise ValueError(f"accessor {index} is sparse, empty or in another buffer")
    return np.ndarray((count, width), kind, data, start + offset, (stride, kind.itemsize))


def _values(column: NDArray[Any]) -> NDArray[np.float64]:
    """Numbers of an attribute; whole numbers stand for shares of the largest."""
    if column.dtype.kind == "f":
        most = 1.0
    else:
        most = float(np.iinfo(column.dtype).max)
    if most > 1:
        return np.maximum(column / most, -1.0)
    return column.astype(np.float64)


def _in_other_light(harmonics: Floats, to_linear: bool) -> Floats:
    """Harmonics of sRGB as those of linear light, or back: the mean colour by the curve, what depends on
    views by its slope.
    """
    mean = np.maximum(base.colours_of(harmonics), 0)
    if to_linear:
        shown = mean
    else:
        shown = np.where(mean <= 0.0031308, 12.92 * mean, 1.055 * mean ** (1 / 2.4) - 0.055)
    slope = np.where(shown <= 0.04045, 1 / 12.92, 2.4 / 1.055 * ((shown + 0.055) / 1.055) ** 1.4)[:, None]
    if to_linear:
        rest = harmonics[:, 1:] * slope
    else:
        rest = harmonics[:, 1:] / slope
    return np.concatenate([base.constants_of(srgb_to_linear(shown) if to_linear else shown), rest], 1)
