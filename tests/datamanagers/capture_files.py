"""Small captures written to disk by the tests, one scene in every format."""

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from fprf.datamanagers.parsers.colmap_model import MODELS
from fprf.rendering.cameras import Cameras


@dataclass(frozen=True)
class Capture:
    """V views of one pinhole or distorting camera, poses camera-to-world in OpenGL axes, and points in front
    of all.
    """

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

    @property
    def centre(self) -> tuple[float, float]:
        return self.size[0] / 2, self.size[1] / 2

    def cameras(self) -> Cameras:
        k1, k2, p1, p2 = self.k
        return cameras_of(torch.from_numpy(self.poses), self.size, self.focal, k=(k1, k2, 0.0, 0.0, p1, p2))


def cameras_of(
    pose: Tensor,
    size: Sequence[object],
    focal: Sequence[object],
    centre: Sequence[object] | None = None,
    k: tuple[float, ...] = (0.0,) * 6,
) -> Cameras:
    """Of poses [V 3 4]; sizes, focal lengths and centres are pairs, one for all or one a view."""
    sides = torch.as_tensor(size).expand(len(pose), 2)
    focals = torch.as_tensor(focal, dtype=torch.float64)
    return Cameras(
        pose=pose,
        focal=focals.expand(len(pose), 2),
        centre=sides.double() / 2
        if centre is None
        else torch.tensor(centre, dtype=torch.float64).expand(len(pose), 2),
        size=sides,
        distortion=torch.tensor([k], dtype=torch.float64).expand(len(pose), 6),
        lens=torch.full((len(pose),), int(any(k))),
    )


def rotations(vectors: np.ndarray) -> np.ndarray:
    return np.stack([cv2.Rodrigues(v)[0] for v in vectors])


def write_image(path: Path, size: tuple[int, int] = (24, 16), channels: int = 3, seed: int = 0) -> np.ndarray:
    """A PNG of noise; returns it as written, in OpenCV's channel order."""
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.random.default_rng(seed).integers(0, 256, (size[1], size[0], channels), dtype=np.uint8)
    assert cv2.imwrite(str(path), image)
    return image


def _write(path: Path, content: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def _images(folder: Path, capture: Capture) -> None:
    for seed, name in enumerate(capture.names):
        write_image(folder / name, capture.size, seed=seed)


def write_transforms(
    folder: Path, capture: Capture, *, per_frame: bool = False, **top: object
) -> dict[str, object]:
    """transforms.json with images and points; returns what was written."""
    _images(folder / "images", capture)
    camera = dict(
        zip(
            ("w", "h", "fl_x", "fl_y", "cx", "cy"),
            (*capture.size, *capture.focal, *capture.centre),
            strict=True,
        )
    )
    camera |= dict(zip(("k1", "k2", "p1", "p2"), capture.k, strict=True))
    frames = []
    for name, pose in zip(capture.names, capture.poses, strict=True):
        frame = {"file_path": f"images/{name}", "transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]}
        frames.append(frame | camera if per_frame else frame)
    content = {**({} if per_frame else camera), "frames": frames, **top}
    _write(folder / "transforms.json", content)
    np.savez(folder / "points.npz", xyz=capture.points)
    return content


def write_llff(folder: Path, capture: Capture, images: str = "images", factor: int = 1) -> np.ndarray:
    """poses_bounds.npy, whose size is `factor` times that of the images; returns its rows."""
    _images(folder / images, capture)
    rows = []
    for pose in capture.poses:
        column = np.array(
            [[capture.size[1] * factor], [capture.size[0] * factor], [capture.focal[0] * factor]]
        )
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
    model: str = "PINHOLE",
    params: tuple[float, ...] | None = None,
    images: str = "images",
) -> Path:
    """A sparse model in sparse/0 with images; every view observes every point. Returns the model's folder."""
    _images(folder / images, capture)
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True, exist_ok=True)
    params = params or (*capture.focal, *capture.centre)
    posed = [
        (k, name, *_world_to_camera(pose))
        for k, (name, pose) in enumerate(zip(capture.names, capture.poses, strict=True))
    ]
    points = list(enumerate(capture.points))
    if binary:
        id_ = [name for name, _ in MODELS].index(model)
        cameras = struct.pack("<QIiQQ", 1, 7, id_, *capture.size) + struct.pack(f"<{len(params)}d", *params)
        features = struct.pack("<Q", len(points)) + b"".join(
            struct.pack("<ddq", 1.0, 2.0, k) for k, _ in points
        )
        rows = [
            struct.pack("<I7dI", k + 1, *q, *t, 7) + name.encode() + b"\0" + features
            for k, name, q, t in posed
        ]
        cloud = [struct.pack("<Q3d3BdQ4I", k, *point, 1, 2, 3, 0.5, 2, 1, 0, 2, 0) for k, point in points]
        (sparse / "cameras.bin").write_bytes(cameras)
        (sparse / "images.bin").write_bytes(struct.pack("<Q", len(rows)) + b"".join(rows))
        (sparse / "points3D.bin").write_bytes(struct.pack("<Q", len(cloud)) + b"".join(cloud))
        return sparse

    def text(values: object) -> str:
        return " ".join(repr(float(value)) for value in values)  # type: ignore[attr-defined]

    features = " ".join(f"1.0 2.0 {k}" for k, _ in points)
    lines = [f"{k + 1} {text((*q, *t))} 7 {name}\n{features}\n" for k, name, q, t in posed]
    _write(
        sparse / "cameras.txt", f"# cameras\n7 {model} {capture.size[0]} {capture.size[1]} {text(params)}\n"
    )
    _write(sparse / "images.txt", "# images\n" + "".join(lines))
    _write(
        sparse / "points3D.txt",
        "# points\n" + "".join(f"{k} {text(point)} 1 2 3 0.5 1 0 2 0\n" for k, point in points),
    )
    return sparse


def write_polycam(folder: Path, capture: Capture, *, corrected: bool = False, **more: object) -> Path:
    """Raw data with images and cameras; returns the folder of cameras."""
    prefix = "corrected_" if corrected else ""
    _images(folder / f"{prefix}images", capture)
    names = ("fx", "fy", "cx", "cy", "width", "height")
    lens = dict(zip(names, (*capture.focal, *capture.centre, *capture.size), strict=True))
    for name, pose in zip(capture.names, capture.poses, strict=True):
        rows = {f"t_{r}{c}": float(pose[r, c]) for r in range(3) for c in range(4)}
        _write(
            folder / f"{prefix}cameras" / f"{Path(name).stem}.json",
            rows | lens | {"blur_score": 100.0} | more,
        )
    return folder / f"{prefix}cameras"


def write_record3d(folder: Path, capture: Capture, *, packed: bool = False, **more: object) -> Path:
    """An export as JPG and EXR, or what is in a .r3d; images are numbered. Returns the metadata's path."""
    for seed in range(len(capture.names)):
        write_image(folder / ("rgbd" if packed else "rgb") / f"{seed}.png", capture.size, seed=seed)
    poses = [
        [*np.roll(_quaternion(pose[:, :3]), -1).tolist(), *pose[:, 3].tolist()] for pose in capture.poses
    ]
    k = [capture.focal[0], 0, 0, 0, capture.focal[1], 0, *capture.centre, 1]
    content = {"w": capture.size[0], "h": capture.size[1], "fps": 30, "K": k, "poses": poses, **more}
    return _write(folder / ("metadata" if packed else "metadata.json"), content)


def write_odm(folder: Path, capture: Capture, *, report: bool = False, **camera: object) -> Path:
    """A project with a reconstruction, or a report. Returns what holds the shots."""
    _images(folder / "images", capture)
    (width, height) = capture.size
    longest = max(capture.size)
    lens: dict[str, object] = {
        "projection_type": "brown",
        "width": width,
        "height": height,
        "c_x": 0.0,
        "c_y": 0.0,
    }
    lens |= {"focal_x": capture.focal[0] / longest, "focal_y": capture.focal[1] / longest}
    lens |= dict(zip(("k1", "k2", "p1", "p2"), capture.k, strict=True)) | camera
    shots = {}
    features = []
    for name, pose in zip(capture.names, capture.poses, strict=True):
        turn = (pose[:, :3] * [1, -1, -1]).T
        rotation = cv2.Rodrigues(turn)[0][:, 0].tolist()
        shots[name] = {
            "camera": "v2 phone",
            "rotation": rotation,
            "translation": (-turn @ pose[:, 3]).tolist(),
        }
        features.append(
            {"properties": {"filename": name, "rotation": rotation, "translation": pose[:, 3].tolist()}}
        )
    if report:
        _write(folder / "cameras.json", {"v2 phone": lens})
        return _write(
            folder / "odm_report/shots.geojson", {"type": "FeatureCollection", "features": features}
        )
    points = {
        str(k): {"coordinates": point.tolist(), "color": [1.0, 2.0, 3.0]}
        for k, point in enumerate(capture.points)
    }
    whole = [{"cameras": {"v2 phone": lens}, "shots": shots, "points": points}]
    return _write(folder / "opensfm/reconstruction.json", whole)


def write_meganerf(
    folder: Path, capture: Capture, held: tuple[int, ...] = (2, 5), unit: float | None = None
) -> None:
    for k, name in enumerate(capture.names):
        part = folder / ("val" if k in held else "train")
        (part / "metadata").mkdir(parents=True, exist_ok=True)
        write_image(part / "rgbs" / name, capture.size, seed=k)
        lens = {
            "W": capture.size[0],
            "H": capture.size[1],
            "intrinsics": torch.tensor([*capture.focal, *capture.centre]),
        }
        torch.save(
            lens | {"c2w": torch.from_numpy(capture.poses[k])}, part / "metadata" / f"{Path(name).stem}.pt"
        )
    if unit is not None:
        torch.save({"origin_drb": torch.zeros(3), "pose_scale_factor": unit}, folder / "coordinates.pt")


def write_phototourism(
    folder: Path, capture: Capture, rows: list[tuple[str, str, str]] | None = None
) -> None:
    """A model in dense/, and the table of rows (file name, id, split); by default all are for training."""
    write_colmap(folder / "dense", capture)
    rows = [(name, str(k), "train") for k, name in enumerate(capture.names)] if rows is None else rows
    _write(
        folder / "gate.tsv", "".join("\t".join(row) + "\n" for row in [("filename", "id", "split"), *rows])
    )
