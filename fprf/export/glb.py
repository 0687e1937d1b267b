"""A coloured mesh as binary glTF 2.0, shown as it is: unlit, with 16-bit linear colours, which glTF asks for."""

import json
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..io.atomic import write_bytes

__all__ = ["linear", "write_glb"]

_ARRAY, _ELEMENTS = 34962, 34963
_UINT16, _UINT32, _FLOAT = 5123, 5125, 5126


def write_glb(
    path: Path, point: NDArray[np.float32], normal: NDArray[np.float32], face: NDArray[np.uint32], colour: NDArray[np.float32]
) -> None:
    """Vertices [N 3], normals [N 3], triangles [F 3], sRGB colours [N 3] in [0, 1]; whole or not at all.

    Every viewer multiplies COLOR_0 as linear light: 8 bits of that would band in the dark.
    """
    shade = np.ones((len(colour), 4))
    shade[:, :3] = linear(colour)
    blocks = [
        point.astype("<f4"),
        normal.astype("<f4"),
        np.rint(shade * 65535).astype("<u2"),
        face.astype("<u4").reshape(-1),
    ]
    views, start = [], 0
    for block, target in zip(blocks, (_ARRAY, _ARRAY, _ARRAY, _ELEMENTS), strict=True):
        views.append({"buffer": 0, "byteOffset": start, "byteLength": block.nbytes, "target": target})
        start += block.nbytes
    count = len(point)
    document = {
        "asset": {"version": "2.0", "generator": "fprf"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "materials": [
            {
                "doubleSided": True,
                "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
                "extensions": {"KHR_materials_unlit": {}},
            }
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}, "indices": 3, "material": 0}]}],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": _FLOAT,
                "count": count,
                "type": "VEC3",
                "min": blocks[0].min(0).tolist(),
                "max": blocks[0].max(0).tolist(),
            },
            {"bufferView": 1, "componentType": _FLOAT, "count": count, "type": "VEC3"},
            {"bufferView": 2, "componentType": _UINT16, "normalized": True, "count": count, "type": "VEC4"},
            {"bufferView": 3, "componentType": _UINT32, "count": face.size, "type": "SCALAR"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }
    head = json.dumps(document, separators=(",", ":")).encode("ascii")
    head += b" " * (-len(head) % 4)
    body = b"".join(block.tobytes() for block in blocks)
    total = 12 + 8 + len(head) + 8 + len(body)
    parts = [struct.pack("<4sII", b"glTF", 2, total), struct.pack("<I4s", len(head), b"JSON"), head]
    write_bytes(path, b"".join([*parts, struct.pack("<I4s", len(body), b"BIN\0"), body]))


def linear(colour: NDArray[np.floating]) -> NDArray[np.float64]:
    """sRGB in [0, 1] to linear light (IEC 61966-2-1)."""
    c = np.clip(colour.astype(np.float64), 0, 1)
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
