"""Small captures written to disk by the tests, one scene in every format."""

import json
import struct
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np


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


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """x y z w."""
    vector = cv2.Rodrigues(rotation)[0][:, 0]
    angle = float(np.linalg.norm(vector))
    return np.append(np.sin(angle / 2) * vector / max(angle, 1e-12), np.cos(angle / 2))


def write_polycam(folder: Path, capture: Capture, *, corrected: bool = False, **more: object) -> Path:
    """Raw data with images and cameras; returns the folder of cameras."""
    prefix, (width, height) = "corrected_" if corrected else "", capture.size
    cameras = folder / f"{prefix}cameras"
    cameras.mkdir(parents=True)
    for seed, (name, pose) in enumerate(zip(capture.names, capture.poses, strict=True)):
        write_image(folder / f"{prefix}images" / name, capture.size, seed=seed)
        rows = {f"t_{r}{c}": float(pose[r, c]) for r in range(3) for c in range(4)}
        lens = {
            "fx": capture.focal[0],
            "fy": capture.focal[1],
            "cx": width / 2,
            "cy": height / 2,
            "width": width,
            "height": height,
        }
        document = {**rows, **lens, "blur_score": 100.0, "timestamp": 1.0, **more}
        (cameras / f"{Path(name).stem}.json").write_text(json.dumps(document))
    return cameras


def write_record3d(folder: Path, capture: Capture, *, packed: bool = False, **more: object) -> Path:
    """An export as JPG and EXR, or what is in a .r3d; images are numbered. Returns the metadata's path."""
    width, height = capture.size
    for seed in range(len(capture.names)):
        write_image(folder / ("rgbd" if packed else "rgb") / f"{seed}.png", capture.size, seed=seed)
    poses = [[*quaternion(pose[:, :3]).tolist(), *pose[:, 3].tolist()] for pose in capture.poses]
    fx, fy = capture.focal
    k = [fx, 0, 0, 0, fy, 0, width / 2, height / 2, 1]
    file = folder / ("metadata" if packed else "metadata.json")
    file.write_text(json.dumps({"w": width, "h": height, "fps": 30, "K": k, "poses": poses, **more}))
    return file


def write_odm(folder: Path, capture: Capture, *, report: bool = False, reduced: int = 1, **camera: object) -> Path:
    """A project with a reconstruction whose cameras are `reduced`, or a report. Returns what holds the shots."""
    (width, height), longest = capture.size, max(capture.size)
    lens: dict[str, object] = {"projection_type": "brown", "width": width // reduced, "height": height // reduced}
    lens |= {"focal_x": capture.focal[0] / longest, "focal_y": capture.focal[1] / longest, "c_x": 0.0, "c_y": 0.0}
    lens |= dict(zip(("k1", "k2", "p1", "p2"), capture.k, strict=True)) | camera
    shots, features = {}, []
    for seed, (name, pose) in enumerate(zip(capture.names, capture.poses, strict=True)):
        write_image(folder / "images" / name, capture.size, seed=seed)
        turn = (pose[:, :3] * [1, -1, -1]).T
        rotation = cv2.Rodrigues(turn)[0][:, 0].tolist()
        shots[name] = {"camera": "v2 phone", "rotation": rotation, "translation": (-turn @ pose[:, 3]).tolist()}
        features.append(
            {"type": "Feature", "properties": {"filename": name, "rotation": rotation, "translation": pose[:, 3].tolist()}}
        )
    points = {str(k): {"coordinates": point.tolist(), "color": [1.0, 2.0, 3.0]} for k, point in enumerate(capture.points)}
    file = folder / ("odm_report/shots.geojson" if report else "opensfm/reconstruction.json")
    file.parent.mkdir()
    if report:
        (folder / "cameras.json").write_text(json.dumps({"v2 phone": lens}))
        file.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    else:
        file.write_text(json.dumps([{"cameras": {"v2 phone": lens}, "shots": shots, "points": points}]))
    return file
