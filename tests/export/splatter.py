"""Plain readers of files of 3D Gaussians: the judges of exported files."""

from typing import NamedTuple

import numpy as np


class Gaussians(NamedTuple):
    at: np.ndarray
    deviation: np.ndarray
    turn: np.ndarray
    """Quaternion w x y z."""
    colour: np.ndarray
    opacity: np.ndarray


def table(data: bytes) -> np.ndarray:
    """The vertices of a binary PLY, by nothing but its header."""
    head, _, body = data.partition(b"end_header\n")
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4"}
    rows, count, inside = [], 0, False
    for line in head.decode("ascii").splitlines():
        word = line.split()
        if word[:1] == ["element"]:
            inside = word[1] == "vertex"
            count = int(word[2]) if inside else count
        elif word[:1] == ["property"] and inside:
            rows.append((word[2], kinds[word[1]]))
    return np.frombuffer(body, dtype=rows, count=count)


def read_gaussians(data: bytes) -> Gaussians:
    v = table(data)

    def columns(*names: str) -> np.ndarray:
        return np.stack([v[name] for name in names], 1).astype(float)

    return Gaussians(
        columns("x", "y", "z"),
        np.exp(columns("scale_0", "scale_1", "scale_2")),
        columns("rot_0", "rot_1", "rot_2", "rot_3"),
        0.5 + 0.5 / np.sqrt(np.pi) * columns("f_dc_0", "f_dc_1", "f_dc_2"),
        1 / (1 + np.exp(-v["opacity"].astype(float))),
    )


def read_splat(data: bytes) -> Gaussians:
    raw = np.frombuffer(data, dtype=np.uint8).reshape(-1, 32)
    real = np.ascontiguousarray(raw[:, :24]).view("<f4").astype(float)
    turn = (raw[:, 28:].astype(float) - 128) / 128
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    return Gaussians(real[:, :3], real[:, 3:], turn, raw[:, 24:27] / 255.0, raw[:, 27] / 255.0)
