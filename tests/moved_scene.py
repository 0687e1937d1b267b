"""A scene folder in other coordinates: poses and points scaled and shifted in float64."""

import json
import shutil
from pathlib import Path

import numpy as np

UTM = (500_000.0, 5_600_000.0, 100.0)


def moved_scene(source: Path, folder: Path, shift: tuple[float, float, float], factor: float = 1.0) -> Path:
    """A copy of a folder with transforms.json and, perhaps, points.npz."""
    shutil.copytree(source, folder)
    document = json.loads((source / "transforms.json").read_text())
    for frame in document["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] = pose[:3, 3] * factor + shift
        frame["transform_matrix"] = pose.tolist()
        frame |= {key: frame[key] * factor for key in ("near", "far") if key in frame}
    document |= {key: document[key] * factor for key in ("near", "far") if key in document}
    (folder / "transforms.json").write_text(json.dumps(document))
    if (source / "points.npz").is_file():
        parts = dict(np.load(source / "points.npz"))
        parts["xyz"] = parts["xyz"].astype(np.float64) * factor + shift
        np.savez(folder / "points.npz", **parts)
    return folder
