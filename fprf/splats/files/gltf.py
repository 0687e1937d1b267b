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
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np
import torch
from numpy.typing import NDArray

from ...errors import DataError
from ...io.images import srgb_to_linear
from ...rendering.splines import quaternions, rotations
from ...types import Origin
from ..activation import TYPICAL_LN_SIZE, nearest_distance
from ..gaussians import COUNTS, Gaussians
from . import base
from .base import Bools, Capture, CaptureFormat, Data, Floats

_NAME = "KHR_gaussian_splatting"
_HARMONICS = [f"{_NAME}:SH_DEGREE_{degree}_COEF_{k}" for degree in range(4) for k in range(2 * degree + 1)]
_SHAPE = ("POSITION", f"{_NAME}:ROTATION", f"{_NAME}:SCALE", f"{_NAME}:OPACITY")
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_MOST = (1 << 32) - (1 << 20)
"""Bytes of a .glb's buffer, whose lengths are 32-bit; the rest is for its document."""
_LEAST = 1e-30
"""Sizes are at least this, so that their logarithm is finite."""
_DRAFTS = ("BT.", "Display-P3", "linear")
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
        column = self.columns[_SHAPE[2]][rows]
        if self.whole:
            return column.astype(np.float64)
        return _values(column)

    def decoded(self, rows: slice, names: list[str], logarithmic: bool) -> tuple[Floats, ...]:
        """Means, quaternions, ln-scales, logits and harmonics of some rows; SCALE is those ln-scales, or
        sizes.
        """
        # Attributes may be whole numbers that stand for shares, except of harmonics.
        points, turns, opacity = (_values(self.columns[name][rows]) for name in (*_SHAPE[:2], _SHAPE[3]))
        scale = self.sizes(rows)
        # The quaternion product of the node's rotation and the Gaussians' own.
        a, b, c, d = quaternions(torch.from_numpy(self.rotation)[None])[0].tolist()
        product = np.array([[a, -b, -c, -d], [b, a, -d, c], [c, d, a, -b], [d, -c, b, a]])
        harmonics = np.stack([_values(self.columns[name][rows]) for name in names], 1)
        if self.linear:
            harmonics = _in_other_light(harmonics, to_linear=False)
        else:
            harmonics = harmonics
        return (
            self.scale * points @ self.rotation.T + self.translation,
            np.roll(turns, 1, 1) @ product.T,
            (scale if logarithmic else np.log(np.maximum(scale, _LEAST))) + np.log(self.scale),
            base.logit(opacity[:, 0]),
            np.matmul(base.turned_harmonics(self.rotation, len(names)), harmonics),
        )


@dataclass(frozen=True, kw_only=True)
class Gltf(CaptureFormat):
    """Khronos' .glb and .gltf."""

    def recognises(self, head: bytes, size: int) -> bool:
        return head.startswith(b"glTF") or head.lstrip()[:1] == b"{"

    def read(self, path: Path, data: Data) -> Capture:
        """All primitives of Gaussians of the file's scene. Raises DataError where there is none."""
        try:
            # Both kinds are handled as a .glb: a .gltf is packed into one first.
            if data[:4] == b"glTF":
                data = data
            else:
                data = _binary(path, json.loads(bytes(data)))
            document, start = _document(data)
            parts = _parts(path, document, data, start)
            names = [name for name in _HARMONICS if parts and name in parts[0].columns]
            if any({*names} ^ {name for name in part.columns if ":SH_" in name} for part in parts) or len(
                names
            ) not in (
                0,
                *COUNTS,
            ):
                raise ValueError("harmonics of degrees that are not whole, or differ")
        except base.UNSOUND as error:
            raise DataError(
                f"{path}: no sound glTF ({error!r}); copy it again, it is damaged or of another kind"
            ) from error
        if not parts:
            raise DataError(f"{path}: a glTF without {_NAME} in its scene; it holds no 3D Gaussians")

        def recolour(harmonics: Floats, changed: Bools) -> list[bytes]:
            # The document stays byte for byte; columns of colours are overwritten in a copy of the buffer.
            out = bytearray(data)
            begin = 0
            for part in _parts(path, document, out, start):
                back = base.turned_harmonics(part.rotation, len(names)).T
                for rows in base.pieces(len(part.columns["POSITION"])):
                    here = slice(begin + rows.start, begin + rows.stop)
                    which = changed[here]
                    new = np.matmul(back, base.finite(harmonics[here]))
                    if part.linear:
                        new = _in_other_light(new, to_linear=True)
                    else:
                        new = new
                    for name, column in zip(names, new.transpose(1, 0, 2), strict=True):
                        part.columns[name][rows][which] = column[which]
                    colour = part.columns.get("COLOR_0")
                    if (
                        colour is not None and colour.dtype == np.uint8
                    ):  # what programs without the extension show
                        colour[rows, :3][which] = base.steps(base.colours_of(new), 255)[which]
                begin += len(part.columns["POSITION"])
            return [bytes(out)]

        # One section a primitive: each has its own node, and so its own axes.
        logarithmic, reason = _logarithmic(document, parts)
        sections = [
            (len(part.columns["POSITION"]), lambda rows, part=part: part.decoded(rows, names, logarithmic))
            for part in parts
        ]
        gaussians, shift = base.decoded(len(names), *sections)
        if logarithmic:
            kind = "logarithms, as in the review draft"
        else:
            kind = "linear, as in the final text"
        compensated = parts[0].extension.get("extras") == {"antialiased": True}
        notes = (f"sizes are {kind} of {_NAME}: {reason}",)
        return Capture(path, gaussians, compensated, data, recolour, shift=shift, notes=notes)

    def pack(self, gaussians: Gaussians, antialiased: bool, origin: Origin) -> list[bytes]:
        """A .glb of one node; harmonics of degree 4 are left out."""
        means, turns, scales, logits, harmonics = base.arrays(gaussians)
        opacity = base.sigmoid(logits)[:, None]
        # Columns lie one after the other in the buffer; quaternions have w last.
        shape = (means, np.roll(base.unit_quaternions(turns), -1, 1), np.exp(scales.clip(-80, 80)), opacity)
        columns: dict[str, Floats] = dict(
            zip((*_SHAPE, *_HARMONICS), (*shape, *harmonics.transpose(1, 0, 2)), strict=False)
        )
        columns = {name: values.astype("<f4") for name, values in columns.items()}
        columns["COLOR_0"] = base.steps(np.concatenate([base.colours_of(harmonics), opacity], 1), 255).astype(
            np.uint8
        )
        # Each column has a view of the buffer and an accessor of that view.
        views = []
        accessors = []
        size = 0
        for k, values in enumerate(columns.values()):
            kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[values.shape[1]]
            code = 5126 if values.dtype == "<f4" else 5121
            views.append({"buffer": 0, "byteOffset": size, "byteLength": values.nbytes, "target": 34962})
            accessors.append({"bufferView": k, "componentType": code, "count": len(values), "type": kind})
            size += values.nbytes
        # The specification demands the bounds of positions; bytes of colours stand for shares.
        accessors[0] |= {"min": means.min(0).tolist(), "max": means.max(0).tolist()}
        accessors[-1]["normalized"] = True
        extension: dict[str, Any] = {
            "kernel": "ellipse",
            "colorSpace": "srgb_rec709_display",
            "projection": "perspective",
        }
        extension |= {"sortingMethod": "cameraDistance"} | (
            {"extras": {"antialiased": True}} if antialiased else {}
        )
        attributes = {name: k for k, name in enumerate(columns)}
        document = {
            "asset": {"version": "2.0", "generator": "fprf"},
            "extensionsUsed": [_NAME],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "rotation": [1, 0, 0, 0]}],
            "meshes": [
                {"primitives": [{"attributes": attributes, "mode": 0, "extensions": {_NAME: extension}}]}
            ],
            "accessors": accessors,
            "bufferViews": views,
            "buffers": [{"byteLength": size}],
        }
        return _glb(document, [values.tobytes() for values in columns.values()])

    def write(self, path: Path, pieces: Iterable[bytes]) -> None:
        """A .glb; for a .gltf its document, with the buffer as base64."""
        if path.suffix.lower() == ".gltf":
            data = b"".join(pieces)
            document, start = _document(data)
            content = base64.b64encode(data[start : start + document["buffers"][0]["byteLength"]]).decode()
            document["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{content}"
            pieces = [json.dumps(document, ensure_ascii=False).encode()]
        super().write(path, pieces)


def _glb(document: dict[str, Any], body: Iterable[bytes]) -> list[bytes]:
    """The pieces of a .glb: its header, its document and its one buffer."""
    if (needed := document["buffers"][0]["byteLength"]) > _MOST:
        raise DataError(
            f"Gaussians of {needed} bytes, where a .glb holds {_MOST} at most; export them as .ply or .spz"
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
    nodes = document.get("nodes", [])
    found = list[_Part]()
    seen = set[int]()
    scene = document.get("scenes", [{"nodes": range(len(nodes))}])[document.get("scene", 0)]
    # From right up back, in which a scene is, to right down front.
    waiting = [(index, np.diag([1.0, -1.0, -1.0, 1.0])) for index in scene.get("nodes", [])]
    for index, above in waiting:
        if index in seen:
            raise ValueError(f"node {index} is reached twice")
        seen.add(index)
        node = nodes[index]
        # The node's own matrix, from its parent's frame, or its parts.
        if "matrix" in node:
            local = np.array(node["matrix"], np.float64).reshape(4, 4).T
        else:
            local = np.eye(4)
            (x, y, z, w) = node.get("rotation", (0, 0, 0, 1))
            turn = rotations(torch.tensor([[w, x, y, z]], dtype=torch.float64))[0].numpy()
            local[:3, :3] = turn * node.get("scale", (1, 1, 1))
            local[:3, 3] = node.get("translation", (0, 0, 0))
        matrix = above @ local
        waiting += [(child, matrix) for child in node.get("children", [])]
        for primitive in document["meshes"][node["mesh"]]["primitives"] if "mesh" in node else []:
            extension = primitive.get("extensions", {}).get(_NAME)
            if extension is None:
                continue
            if extension.get("extensions"):
                raise DataError(
                    f"{path}: Gaussians packed by {', '.join(extension['extensions'])}; export them uncompressed"
                )
            columns = {}
            for name, at in primitive["attributes"].items():
                columns[name] = _column(document, data, start, at)
            widths = {}
            for name in columns:
                if name in _SHAPE or name in _HARMONICS:
                    widths[name] = columns[name].shape[1]
            wanted = dict.fromkeys(_HARMONICS, 3) | dict(zip(_SHAPE, (3, 4, 3, 1), strict=True))
            sound = {*_SHAPE, _HARMONICS[0]} <= {*columns} and all(
                wanted[name] == width for name, width in widths.items()
            )
            if not sound or len({len(column) for column in columns.values()}) > 1:
                raise DataError(
                    f"{path}: Gaussians without one of {', '.join(_SHAPE)}, or of unequal shapes; export it again"
                )
            # Gaussians stay Gaussians of the same kind under turns, shifts and one scale for all axes.
            linear = matrix[:3, :3]
            scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
            if not scale > 0 or not np.abs(linear @ linear.T / scale**2 - np.eye(3)).max() < 1e-3:
                raise DataError(
                    f"{path}: a node shears, mirrors or stretches its Gaussians; apply its transform first"
                )
            about = document["accessors"][primitive["attributes"][_SHAPE[2]]]
            whole = about["componentType"] != 5126 and not about.get("normalized")
            found.append(_Part(columns, linear / scale, scale, matrix[:3, 3], extension, whole))
    # Gaussians shown several times would multiply a small file, and have but one place for several new
    # colours.
    colours = sorted((part.columns[_HARMONICS[0]] for part in found), key=lambda column: column.ctypes.data)
    if any(itertools.starmap(np.may_share_memory, itertools.pairwise(colours))):
        raise DataError(
            f"{path}: several nodes or primitives show the same Gaussians; export each with its own"
        )
    return found


def _logarithmic(document: dict[str, Any], parts: list[_Part]) -> tuple[bool, str]:
    """True where SCALE holds logarithms of sizes, for all of a file's Gaussians, and the reason in words."""
    # A size is never negative; its logarithm is where anything is smaller than the unit.
    for part in parts:
        if any(bool((part.sizes(rows) < 0).any()) for rows in base.pieces(len(part.columns["POSITION"]))):
            return True, "some are negative"
    # What wrote the file may be known, or the draft that it follows.
    generator = str(document["asset"].get("generator"))
    version = re.match(r"splat-transform (\d+)\.(\d+)", generator)
    if version or generator == "fprf":
        return version is not None and (
            int(version[1]),
            int(version[2]),
        ) < _LINEAR_SINCE, f"{generator[:40]} wrote it"
    for part in parts:
        if str(part.extension.get("colorSpace")).startswith(_DRAFTS):
            return True, f"colorSpace {part.extension['colorSpace']} is that of a draft"
    # Else sizes are held against the distances between neighbours: Gaussians that cover a surface are about
    # as wide.
    part = max(parts, key=lambda part: len(part.columns["POSITION"]))
    points = part.columns["POSITION"]
    spacing = nearest_distance(torch.from_numpy(_values(points)))
    some = np.linspace(0, len(points) - 1, _ASKED_SIZES).astype(np.int64)
    middle = np.sort(part.sizes(some), 1)[:, 1]
    middle = middle[np.isfinite(middle)]
    if spacing is None or not len(middle):
        return False, "nothing tells otherwise"
    number = float(np.median(middle))
    ratios = (math.log(max(number, _LEAST)) - math.log(spacing), number - math.log(spacing))
    logarithmic = abs(ratios[1] - TYPICAL_LN_SIZE) < abs(ratios[0] - TYPICAL_LN_SIZE)
    shares = []
    for ratio in (ratios[logarithmic], ratios[not logarithmic]):
        shares.append(f"{math.exp(min(ratio, 99)):.2g}")
    return logarithmic, f"so they are {shares[0]} of the distance between neighbours, not {shares[1]}"


def _column(document: dict[str, Any], data: Data | bytearray, start: int, index: int) -> NDArray[Any]:
    """The rows of an accessor, in the file's own memory; NumPy holds them against its size."""
    about = document["accessors"][index]
    view = document["bufferViews"][about["bufferView"]]
    kind = np.dtype(_COMPONENTS[about["componentType"]])
    width = _WIDTHS[about["type"]]
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
