"""TFRecord files of tf.train.Example, written without TensorFlow, and a capture in the format of Mission Bay."""

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from capture_files import Capture, cameras_of

from fprf.datamanagers.parsers.blocknerf import crc32c, masked
from fprf.rendering.cameras import Cameras, pixel_grid, rays_through


def varint(value: int) -> bytes:
    value &= 0xFFFFFFFFFFFFFFFF
    out = b""
    while value > 0x7F:
        out += bytes([value & 0x7F | 0x80])
        value >>= 7
    return out + bytes([value])


def chunk(number: int, data: bytes) -> bytes:
    return varint(number << 3 | 2) + varint(len(data)) + data


def example(values: dict[str, Any], packed: bool = True) -> bytes:
    """A serialised Example; lists of integers, arrays of floats, bytes."""
    entries = b""
    for name, value in values.items():
        if isinstance(value, bytes):
            body = chunk(1, chunk(1, value))
        elif isinstance(value, list):
            whole = [varint(v) for v in value]
            body = chunk(3, chunk(1, b"".join(whole)) if packed else b"".join(varint(1 << 3) + w for w in whole))
        else:
            raw = value.astype("<f4").tobytes()
            parts = [varint(1 << 3 | 5) + raw[k : k + 4] for k in range(0, len(raw), 4)]
            body = chunk(2, chunk(1, raw) if packed else b"".join(parts))
        entries += chunk(1, chunk(1, name.encode()) + chunk(2, body))
    return chunk(1, entries)


def features(image: np.ndarray, origin: np.ndarray, direction: np.ndarray, **more: object) -> dict[str, object]:
    """Those of an image [H W 3] and its rays [H W 3]."""
    done, png = cv2.imencode(".png", image)
    assert done
    given: dict[str, object] = {
        "image": png.tobytes(),
        "image_hash": [99],
        "cam_idx": [5],
        "height": [image.shape[0]],
        "width": [image.shape[1]],
        "equivalent_exposure": np.array([1.0], np.float32),
        "ray_origins": np.float32(origin).reshape(-1),
        "ray_dirs": np.float32(direction).reshape(-1),
    }
    return given | more


def record(data: bytes) -> bytes:
    head = struct.pack("<Q", len(data))
    return head + struct.pack("<I", masked(crc32c(head))) + data + struct.pack("<I", masked(crc32c(data)))


def bay_records(folder: Path, views: int = 16) -> Cameras:
    """Two cameras of different focal length and exposure in turn, in three files; every fourth record is for validation."""
    size = (32, 24)
    cameras = cameras_of(
        torch.from_numpy(Capture.make(views).poses),
        size,
        [[30.0 if k % 2 else 24.0] * 2 for k in range(views)],
        (16.7, 11.6),
        (-0.05, 0.01, 0.0, 0.0, 0.001, -0.001),
    )
    held, learned = [], []
    for k in range(views):
        rays = rays_through(cameras, torch.full((size[0] * size[1],), k), pixel_grid(cameras, k))
        exposure = np.array([0.5 if k % 2 else 1.0], np.float32)
        more = {"image_hash": [-(k + 1) * 7919], "cam_idx": [k % 2], "equivalent_exposure": exposure}
        whole = example(features(np.full((size[1], size[0], 3), k, np.uint8), *(ray.numpy() for ray in rays), **more))
        (held if k % 4 == 3 else learned).append(record(whole))
    folder.mkdir(parents=True, exist_ok=True)
    half = len(learned) // 2
    (folder / "bay_train.tfrecord-00000-of-00002").write_bytes(b"".join(learned[:half]))
    (folder / "bay_train.tfrecord-00001-of-00002").write_bytes(b"".join(learned[half:]))
    (folder / "bay_validation.tfrecord-00000-of-00001").write_bytes(b"".join(held))
    return cameras
