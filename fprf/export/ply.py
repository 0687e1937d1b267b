"""Binary PLY files: columns of numbers for vertices, triangles if there are any."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..io.atomic import write_bytes

__all__ = ["write_ply"]

_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}


def write_ply(
    path: Path,
    vertices: Mapping[str, NDArray[np.generic]],
    faces: NDArray[np.int32] | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Write a little-endian PLY, whole or not at all: one property a column, in their order, and faces [F 3]."""
    columns = {name: np.asarray(column) for name, column in vertices.items()}
    count = len(next(iter(columns.values())))
    kinds = {name: column.dtype.str[1:] for name, column in columns.items()}
    table = np.empty(count, dtype=[(name, "<" + kind) for name, kind in kinds.items()])
    for name, column in columns.items():
        table[name] = column
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments), f"element vertex {count}"]
    lines += [f"property {_TYPES[kind]} {name}" for name, kind in kinds.items()]
    body = table.tobytes()
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        corners = np.empty(len(faces), dtype=[("count", "u1"), ("corner", "<i4", 3)])
        corners["count"], corners["corner"] = 3, faces
        body += corners.tobytes()
    write_bytes(path, "\n".join([*lines, "end_header", ""]).encode("ascii") + body)
