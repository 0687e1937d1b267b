"""Small captures written to disk by the tests, one scene in every format."""

import json
import struct
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

__all__ = ["Capture", "rotations", "write_colmap", "write_image", "write_llff", "write_transforms"]


@dataclass(frozen=True)
class Capture:
    """V views of one pinhole or distorting camera, poses camera-to-world in OpenGL axes, and points in front of all."""

    names: tuple[str, ...]
    poses: np.ndarray
    points: np.ndarray
    size: tuple[int, int] = (24, 16)
    focal: tuple[float, float] = (20.0, 20.0)
    k: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """k1 k2 p1 p2."""

    @staticmethod
    def make(count: int = 10, seed: int = 0, **fields: object) -> "Capture":
        draw = np.random.default_rng(seed)
        turn = rotations(draw.normal(size=(count, 3)) * 0.1)
        place = draw.normal(size=(count, 3, 1)) * 0.3
        points = draw.uniform((-1, -1, -7), (1, 1, -5), (40, 3))
        names = tuple(f"{k:04d}.png" for k in range(count))
        return Capture(names, np.concatenate([turn, place], 2), points, **fields)  # type: ignore[arg-type]


def rotations(vectors: np.ndarray) -> np.ndarray:
    return np.stack([cv2.Rodrigues(v)[0] for v in vectors])


def write_image(path: Path, size: tuple[int, int], channels: int = 3, seed: int = 0) -> np.ndarray:
    """A PNG of noise; returns it as written, in OpenCV's channel order."""
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.random.default_rng(seed).integers(0, 256, (size[1], size[0], channels), dtype=np.uint8)
    assert cv2.imwrite(str(path), image)
    return image


def _images(folder: Path, capture: Capture) -> None:
    for seed, name in enumerate(capture.names):
        write_image(folder / name, capture.size, seed=seed)


def write_transforms(folder: Path, capture: Capture, *, per_frame: bool = False, **top: object) -> dict[str, object]:
    """transforms.json with images and points; returns what was written."""
    _images(folder / "images", capture)
    width, height = capture.size
    lens = dict(zip(("k1", "k2", "p1", "p2"), capture.k, strict=True))
    camera = {"w": width, "h": height, "fl_x": capture.focal[0], "fl_y": capture.focal[1], "cx": width / 2, "cy": height / 2}
    frames = []
    for name, pose in zip(capture.names, capture.poses, strict=True):
        frame = {"file_path": f"images/{name}", "transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]}
        frames.append(frame | camera | lens if per_frame else frame)
    content = {**({} if per_frame else camera | lens), "frames": frames, **top}
    (folder / "transforms.json").write_text(json.dumps(content))
    np.savez(folder / "points.npz", xyz=capture.points.astype(np.float32))
    return content


def write_llff(folder: Path, capture: Capture, images: str = "images", factor: int = 1) -> np.ndarray:
    """poses_bounds.npy, whose size is `factor` times that of the images; returns its rows."""
    _images(folder / images, capture)
    rows = []
    for pose in capture.poses:
        column = np.array([[capture.size[1] * factor], [capture.size[0] * factor], [capture.focal[0] * factor]])
        right, up, back, place = pose.T
        rows.append([*np.concatenate([np.stack([-up, right, back, place], 1), column], 1).ravel(), 2.0, 9.0])
    array = np.array(rows)
    np.save(folder / "poses_bounds.npy", array)
    return array


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """w x y z of a rotation by less than half a turn."""
    w = np.sqrt(1 + np.trace(rotation)) / 2
    skew = rotation - rotation.T
    return np.array([w, skew[2, 1] / (4 * w), skew[0, 2] / (4 * w), skew[1, 0] / (4 * w)])


def _world_to_camera(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    # OpenGL to OpenCV axes turns half round x: the quaternion is multiplied by (0, 1, 0, 0).
    w, x, y, z = _quaternion(pose[:, :3].T)
    rotation = (pose[:, :3] * [1, -1, -1]).T
    return np.array([-x, w, -z, y]), -rotation @ pose[:, 3]


def write_colmap(
    folder: Path,
    capture: Capture,
    *,
    binary: bool = True,
    model: tuple[int, str] = (1, "PINHOLE"),
    params: tuple[float, ...] | None = None,
    images: str = "images",
) -> Path:
    """A sparse model in sparse/0 with images; every view observes every point. Returns the model's folder."""
    _images(folder / images, capture)
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True, exist_ok=True)
    width, height = capture.size
    params = params or (*capture.focal, width / 2, height / 2)
    poses = [_world_to_camera(pose) for pose in capture.poses]
    if binary:
        count = struct.pack("<Q", 1) + struct.pack("<IiQQ", 7, model[0], width, height)
        (sparse / "cameras.bin").write_bytes(count + struct.pack(f"<{len(params)}d", *params))
        features = struct.pack("<Q", len(capture.points))
        features += b"".join(struct.pack("<ddq", 1.0, 2.0, k) for k in range(len(capture.points)))
        parts = [struct.pack("<Q", len(poses))]
        for k, (name, (q, t)) in enumerate(zip(capture.names, poses, strict=True)):
            parts.append(struct.pack("<I7dI", k + 1, *q, *t, 7) + name.encode() + b"\0" + features)
        (sparse / "images.bin").write_bytes(b"".join(parts))
        parts = [struct.pack("<Q", len(capture.points))]
        for k, point in enumerate(capture.points):
            parts.append(struct.pack("<Q3d3BdQ", k, *point, 1, 2, 3, 0.5, 2) + struct.pack("<4I", 1, 0, 2, 0))
        (sparse / "points3D.bin").write_bytes(b"".join(parts))
        return sparse
    numbers = " ".join(repr(float(value)) for value in params)
    (sparse / "cameras.txt").write_text(f"# cameras\n7 {model[1]} {width} {height} {numbers}\n")
    lines = ["# images"]
    for k, (name, (q, t)) in enumerate(zip(capture.names, poses, strict=True)):
        lines.append(f"{k + 1} {' '.join(repr(float(v)) for v in (*q, *t))} 7 {name}")
        lines.append(" ".join(f"1.0 2.0 {index}" for index in range(len(capture.points))))
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [f"{k} {' '.join(repr(float(v)) for v in point)} 1 2 3 0.5 1 0 2 0" for k, point in enumerate(capture.points)]
    (sparse / "points3D.txt").write_text("\n".join(["# points", *rows]) + "\n")
    return sparse
