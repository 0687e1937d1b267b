"""Captures of other programs' making, written by the tests: Polycam, Record3D, OpenDroneMap."""

import json
from pathlib import Path

import cv2
import numpy as np
from capture_files import Capture, write_image

__all__ = ["quaternion", "write_odm", "write_polycam", "write_record3d"]


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
