"""The PLY files of 3D Gaussian Splatting: one vertex a Gaussian (INRIA), and SuperSplat's compressed chunks
(`ply_chunks`).

INRIA       float32 x y z, f_dc_0..2, f_rest_* channel by channel, opacity (logit), scale_0..2 (ln), rot_0..3 (w x y z), and
            any other property and element, which are kept. Header comments: `SplatRenderMode:
            default|mip|2dgs`, `antialiased 0|1` (Postshot) and `Vertical axis: x|y|z|X Y Z`, whose letters
            mean +x, -y and -z in Brush's files and +z in Nerfstudio's, which all say z; fprf adds
            `North: X Y Z`. Elements
            `extrinsic`, `intrinsic` and `image_size`: the camera of the one photograph that a capture was
            made of (SHARP). Variants: red green blue as bytes in the place of f_dc (Nerfstudio), no scale_2
            (2D Gaussians), either byte order, ASCII.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ...errors import DataError
from ...rendering.cameras import Cameras, ideal_cameras
from ...rendering.north import Bearings, North
from ...types import Origin
from ..gaussians import COUNTS, GaussianRows, Gaussians
from ..ground import Direction, axis_name, find_ground
from . import base
from .base import Bools, Capture, CaptureFormat, Data, Floats
from .ply_chunks import chunk_tables, flat_harmonics, is_chunked, kept_by_chunks, read_chunks
from .ply_tables import (
    BYTE_ORDER_MARK,
    Element,
    Header,
    ply_file,
    ply_head,
    read_header,
    read_tables,
    with_comments,
)

_MEANINGFUL_COMMENT = re.compile(
    r"(splatrendermode|antialiased|vertical axis|north)\b[\s:=]*(.*)", re.IGNORECASE
)
"""Comments that say something of a capture, with what they say."""
_NERFSTUDIO = re.compile(r"\bner(f)?studio\b", re.IGNORECASE)
"""Its exporter calls itself Nerstudio, and writes `Vertical Axis: z` whatever the scene is."""
_BRUSH = re.compile(r"\bbrush\b", re.IGNORECASE)
"""It writes `Exported from Brush`."""
_BRUSH_UP: dict[str, Direction] = {"x": (1.0, 0.0, 0.0), "y": (0.0, -1.0, 0.0), "z": (0.0, 0.0, -1.0)}
"""Direction up where Brush names a vertical axis by its letter."""
_USUAL_UP_OF_LETTER: dict[str, Direction] = _BRUSH_UP | {"z": (0.0, 0.0, 1.0)}
"""Direction up where another program does, and the ground does not tell: programs whose z is vertical
(Nerfstudio, Blender) have it point up, those whose y is vertical (COLMAP and what follows it) down.
"""
_MAX_CAMERA_DISTANCE = 1e15
"""Nothing is drawn from farther (`Gaussians.finite`)."""
_MAX_SHEAR = 1e-2
"""Of a camera's rotation from one, at most: float32 and rounded text are far closer."""
_MAX_CAMERA_PIXELS = 1 << 16
"""Along a side of the photograph of a camera, at most: no sensor has as many."""


@dataclass(frozen=True, kw_only=True)
class Ply(CaptureFormat):
    """INRIA's layout; SuperSplat's is read as well."""

    exact: ClassVar[bool] = True

    def recognises(self, head: bytes, size: int) -> bool:
        return head.removeprefix(BYTE_ORDER_MARK).startswith(b"ply")

    def read(self, path: Path, data: Data) -> Capture:
        """A PLY of either layout. Raises DataError for others. ASCII files become binary ones of the same
        elements.
        """
        file = read_tables(path, data)
        if is_chunked(file.header):
            read = read_chunks
        else:
            read = _read_inria
        capture = read(path, file.data, file.elements)
        said = _Comments.of(file.header)
        camera = _camera(file.data, file.elements)
        up, reason = said.up(capture.gaussians)
        if up is None and camera is not None:
            up = (float(camera.pose[0, 0, 1]), float(camera.pose[0, 1, 1]), float(camera.pose[0, 2, 1]))
            reason = "so it was for the camera of the photograph that it was made of"
        north = None
        if (there := base.direction_of(_numbers(said.north))) is not None:
            north = North(direction=there, source=f"its comment says `North: {said.north}`")
        capture = replace(capture, antialiased=said.antialiased, north=north, camera=camera)
        return replace(capture, up=up, up_reason=reason)

    def pack(self, gaussians: Gaussians, antialiased: bool, origin: Origin) -> Iterable[bytes]:
        """Exact; with an origin positions are in the world, float64."""
        return self.pack_rows(GaussianRows(len(gaussians), gaussians.select, antialiased), origin)

    def pack_rows(self, rows: GaussianRows, origin: Origin) -> Iterator[bytes]:
        """In pieces, of which one at a time is in memory."""
        yield ply_head({"vertex": ply_rows(rows.part(slice(0, 1)), origin)}, rows.antialiased, rows.count)
        for some in base.pieces(rows.count):
            yield ply_rows(rows.part(some), origin).tobytes()

    def with_bearings(self, pieces: Iterable[bytes], bearings: Bearings) -> Iterator[bytes]:
        """With comments."""
        comments = [f"North: {_written(bearings.north)}"]
        if bearings.up is not None:
            comments.append(f"Vertical axis: {_written(bearings.up)}")
        return with_comments(pieces, comments)

    def holds(self, capture: Capture, read_as: CaptureFormat) -> bool:
        """A compressed file may be called .ply: under the same ending it stays what it is."""
        return type(read_as) is Ply


@dataclass(frozen=True, kw_only=True)
class CompressedPly(Ply):
    """SuperSplat's .compressed.ply."""

    exact: ClassVar[bool] = False

    def pack(self, gaussians: Gaussians, antialiased: bool, origin: Origin) -> list[bytes]:
        """In spatial order, with bounds of colours."""
        return [ply_file(chunk_tables(gaussians), antialiased)]

    def keeps(self, gaussians: Gaussians) -> Bools:
        """All but a few outliers, which would need chunks of their own."""
        return kept_by_chunks(gaussians)

    def holds(self, capture: Capture, read_as: CaptureFormat) -> bool:
        if not isinstance(read_as, Ply):
            return False
        header = read_header(capture.data)
        return header is not None and is_chunked(header)


def ply_rows(gaussians: Gaussians, origin: Origin) -> NDArray[np.void]:
    """Rows of the INRIA file. Normals, which nobody reads and some demand, are 0."""
    means, turns, scales, logits, harmonics = base.arrays(gaussians)
    names = [*"xyz", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3))]
    for i in range(3 * harmonics.shape[1] - 3):
        names.append(f"f_rest_{i}")
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    normals = np.zeros_like(means)
    columns = np.concatenate(
        [means, normals, flat_harmonics(harmonics), logits[:, None], scales, turns], axis=1
    )
    table = np.ascontiguousarray(columns, "<f4").view([(name, "<f4") for name in names])[:, 0]
    return base.in_world(table, means, origin)


class _Comments(NamedTuple):
    """Comments of a header about a capture."""

    mode: str
    """Meaning of opacities; of several lines the last one counts."""
    vertical: str
    """The vertical axis; empty where no line says it."""
    north: str
    """Numbers of the line of north; empty if there is none."""
    nerfstudio: bool
    brush: bool

    @classmethod
    def of(cls, header: Header) -> "_Comments":
        texts = []
        for words in header.comments:
            texts.append(" ".join(words[1:]))
        mode = ""
        vertical = ""
        north = ""
        for text in texts:
            found = _MEANINGFUL_COMMENT.match(text)
            if found is None:
                continue
            if found[1].lower() == "vertical axis":
                vertical = found[2].lower()
            elif found[1].lower() == "north":
                north = found[2]
            else:
                mode = found[2].lower()
        nerfstudio = any(_NERFSTUDIO.search(text) for text in texts)
        brush = any(_BRUSH.search(text) for text in texts)
        return cls(mode, vertical, north, nerfstudio, brush)

    @property
    def antialiased(self) -> bool:
        return self.mode in ("mip", "1")

    def up(self, gaussians: Gaussians) -> tuple[Direction | None, str]:
        """The direction up and what tells it: of a letter without a sign the program that wrote it, else the
        ground. None where no line says it.
        """
        numbers = _numbers(self.vertical)
        letter = numbers[0] if len(numbers) == 1 else ""
        said = f"its comment says `Vertical axis: {self.vertical}`"
        if letter.lstrip("+-") in _BRUSH_UP and letter not in _BRUSH_UP:
            sign = -1.0 if letter[0] == "-" else 1.0
            return _along(letter[-1], sign), said
        if letter in _BRUSH_UP:
            if self.nerfstudio:
                return _along(letter, 1.0), f"{said}, and Nerfstudio wrote it"
            if self.brush:
                return _BRUSH_UP[letter], f"{said}, and Brush wrote it"
            # Programs differ in which end of the axis they mean.
            up = _USUAL_UP_OF_LETTER[letter]
            ground = find_ground(gaussians.drawable())
            if ground is not None and ground.up["xyz".index(letter)]:
                return ground.up, f"{said}, and {ground}"
            return up, f"{said}, of which {axis_name(up)} is the usual end"
        try:
            x, y, z = map(float, numbers)
        except ValueError:
            return None, ""
        if not 0 < x * x + y * y + z * z < np.inf:
            return None, ""
        return (x, y, z), said


def _numbers(text: str) -> list[str]:
    """Words of a comment, with or without commas and brackets."""
    return text.replace(",", " ").strip("[]() ").split()


def _written(direction: Direction) -> str:
    """Three numbers as a comment has them."""
    return " ".join(f"{number:.7g}" for number in direction)


def _along(letter: str, sign: float) -> Direction:
    """The direction of an axis."""
    x, y, z = (sign * (letter == each) for each in "xyz")
    return x, y, z


class _Columns(NamedTuple):
    """Properties of a vertex that make up a Gaussian."""

    places: dict[str, tuple[int, int]]
    """The harmonic and the channel that each property of a colour is."""
    sizes: list[str]
    """Two for 2D Gaussians, which lie in the plane of these."""
    bands: int
    """Harmonics a channel."""
    byte_colours: bool
    """Mean colours are bytes in the place of harmonics."""

    @property
    def turns(self) -> list[str]:
        found: list[str] = []
        for i in range(4):
            found.append(f"rot_{i}")
        return found


def _read_inria(path: Path, data: Data, elements: Mapping[str, Element]) -> Capture:
    """The capture of a file of INRIA's layout, whose rows are read, and later recoloured, in pieces."""
    vertex = elements.get("vertex")
    if vertex is None:
        raise DataError(f"{path}: no element `vertex`; not a file of 3D Gaussians")
    columns = _columns(path, vertex)
    whole = vertex.table(data)

    def part(rows: slice) -> tuple[Floats, ...]:
        return _decoded(whole[rows], columns)

    def recolour(harmonics: Floats, changed: Bools) -> Iterator[bytes]:
        """The file's own bytes, with other numbers in the columns of colours of the rows that change."""
        yield data[: vertex.offset]
        for rows in base.pieces(vertex.rows):
            yield _recoloured(whole[rows], columns, harmonics[rows], changed[rows]).tobytes()
            base.release(data)
        yield data[vertex.offset + vertex.rows * vertex.kind.itemsize :]

    gaussians, shift = base.decoded(columns.bands, (vertex.rows, part))
    return Capture(path, gaussians, False, data, recolour, shift=shift)


def _columns(path: Path, vertex: Element) -> _Columns:
    """Every property that is needed, in any order, among any others. Raises DataError where one is missing,
    or of another type.
    """
    known = set(vertex.names())
    rest = sum(bool(re.fullmatch(r"f_rest_\d+", name)) for name in known)
    byte_colours = "f_dc_0" not in known and {"red", "green", "blue"} <= known
    constants = ["f_dc_0", "f_dc_1", "f_dc_2"]
    if byte_colours:
        constants = ["red", "green", "blue"]
    sizes = ["scale_0", "scale_1"]
    if "scale_2" in known or "scale_1" not in known:
        sizes.append("scale_2")
    bands = 1 + rest // 3
    # The constants come first, then all harmonics of a channel after those of the one before.
    places = {}
    for channel, name in enumerate(constants):
        places[name] = (0, channel)
    for i in range(rest):
        places[f"f_rest_{i}"] = (1 + i % max(bands - 1, 1), i // max(bands - 1, 1))
    columns = _Columns(places, sizes, bands, byte_colours)
    for name in [*"xyz", "opacity", *sizes, *columns.turns, *places]:
        if name not in known:
            raise DataError(f"{path}: no property {name}; not a file of 3D Gaussians")
        is_byte_colour = byte_colours and name in constants
        if is_byte_colour and vertex.kind[name] != "u1":
            raise DataError(
                f"{path}: property {name} is no byte; colours are bytes, or f_dc_0 to f_dc_2 of float"
            )
        if vertex.kind[name].kind != "f" and name not in "xyz" and not is_byte_colour:
            raise DataError(
                f"{path}: property {name} is of whole numbers; 3D Gaussians have float or double there"
            )
    if rest % 3 or bands not in COUNTS:
        raise DataError(f"{path}: {rest} properties f_rest_*; 0, 9, 24, 45 or 72 belong to degrees 0 to 4")
    return columns


def _decoded(table: NDArray[np.void], columns: _Columns) -> tuple[Floats, ...]:
    """Rows as `base.decoded` wants them."""
    harmonics = np.empty((len(table), columns.bands, 3))
    scales = np.full((len(table), 3), -np.inf)
    for name, (band, channel) in columns.places.items():
        harmonics[:, band, channel] = table[name]
    if columns.byte_colours:
        harmonics[:, :1] = base.constants_of(harmonics[:, 0] / 255)
    for axis, name in enumerate(columns.sizes):
        scales[:, axis] = table[name]
    # Positions may be of any type; far from 0 they lose nothing by their local origin.
    parts = []
    for name in "xyz":
        parts.append(table[name])
    means = np.stack(parts, 1)
    parts = []
    for name in columns.turns:
        parts.append(table[name])
    turns = np.stack(parts, 1)
    return means, turns, scales, table["opacity"], harmonics


def _recoloured(
    table: NDArray[np.void], columns: _Columns, harmonics: Floats, changed: Bools
) -> NDArray[np.void]:
    """Rows with other numbers in the columns of colours of those that change."""
    out = table.copy()
    new = harmonics[changed]
    for name, (band, channel) in columns.places.items():
        column = new[:, band, channel]
        if columns.byte_colours and band == 0:
            column = base.steps(base.colours_of(new), 255)[:, channel]
        out[name][changed] = column
    return out


def _camera(data: Data, elements: Mapping[str, Element]) -> Cameras | None:
    """The camera of `extrinsic` (world to camera, OpenCV axes), `intrinsic` and `image_size`; None where
    there is no sound one.

    Older files have 12 numbers of `extrinsic`, its rotation transposed, and fx, fy, width and height as
    `intrinsic`.
    """
    numbers = {}
    for name in ("extrinsic", "intrinsic", "image_size"):
        if name in elements:
            table = elements[name].table(data)
            columns = []
            for each in elements[name].names():
                columns.append(table[each].astype(np.float64))
            numbers[name] = np.stack(columns, 1).ravel()
    # Without a pose the camera is at the origin and looks along z.
    matrix = numbers.get("extrinsic", np.eye(4).ravel())
    lens = numbers.get("intrinsic", np.zeros(0))
    if len(matrix) not in (12, 16) or len(lens) not in (4, 9):
        return None
    if len(lens) == 4:
        focal = lens[:2]
        size = numbers.get("image_size", lens[2:])
        centre = size / 2
    else:
        focal = lens[[0, 4]]
        size = numbers.get("image_size", np.zeros(0))
        centre = lens[[2, 5]]
    if len(size) != 2:
        return None
    world = matrix[:12].reshape(3, 4)
    rotation = world[:, :3]  # camera to world
    if len(matrix) == 16:
        rotation = rotation.T
    finite = all(np.isfinite(each).all() for each in (world, focal, centre))
    if not finite or np.abs(world[:, 3]).max() >= _MAX_CAMERA_DISTANCE:
        return None
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _MAX_SHEAR or np.linalg.det(rotation) < 0:
        return None
    if focal.min() <= 0 or size.min() < 1 or size.max() > _MAX_CAMERA_PIXELS:
        return None
    # The file has world to camera; ours is the inverse.
    pose = np.concatenate([rotation * [1.0, -1.0, -1.0], -rotation @ world[:, 3:]], 1)  # OpenGL axes
    cameras = ideal_cameras(torch.from_numpy(pose)[None], 1.0, (int(size[0]), int(size[1])))
    return replace(cameras, focal=torch.from_numpy(focal)[None], centre=torch.from_numpy(centre)[None])
