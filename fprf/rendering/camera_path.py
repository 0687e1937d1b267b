"""Nerfstudio's camera-path JSON, read and written: what its viewer exports is rendered here, and ours loads there.

    {"camera_type": "perspective", "render_width": W, "render_height": H, "fps": F, "seconds": S,
     "camera_path": [{"camera_to_world": [16 numbers, row by row], "fov": vertical degrees, "aspect": W / H}, ...]}

Poses are in the capture's own coordinates, whatever the scene's origin, with OpenGL's axes. Pixels are square and the
principal point is the middle: the format can say nothing else.
"""

import json
import math
from pathlib import Path
from typing import Annotated, NoReturn

import torch
from torch import Tensor

from ..errors import DataError
from ..io.atomic import write_json
from ..types import Origin
from .cameras import Cameras, ideal_cameras

_FPS = 24.0
"""Nerfstudio's value where a file has none."""
_FAR = 1e30
"""Numbers of a pose lie below: an integer of JSON may be larger than any float."""
_STRAY = 1e-3
"""Tolerance of a rotation's orthonormality: viewers round to a few digits."""


def read_camera_path(path: Path, origin: Origin = (0.0, 0.0, 0.0)) -> tuple[Cameras, float]:
    """The frames of a file as pinhole cameras about an origin, float64, and its frames a second.

    Raises DataError with the place.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such camera path; give spiral, interpolate, dataset or a JSON file") from error
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: not readable as JSON ({error}); export the camera path again") from error
    if not isinstance(content, dict):
        _wrong(path, "", "an object with 'camera_path'", content)
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        _wrong(path, "camera_type", "'perspective'", kind)
    width, height = (_size(path, content, name) for name in ("render_width", "render_height"))
    fps = _number(path, "fps", content.get("fps", _FPS), 0.0, 1000.0)
    frames = content.get("camera_path")
    if not isinstance(frames, list) or not frames:
        _wrong(path, "camera_path", "a list of at least one frame", frames)
    poses, focals = [], []
    for index, frame in enumerate(frames):
        where = f"camera_path[{index}]"
        if not isinstance(frame, dict):
            _wrong(path, where, "an object with 'camera_to_world' and 'fov'", frame)
        poses.append(_pose(path, f"{where}.camera_to_world", frame.get("camera_to_world")))
        fov = _number(path, f"{where}.fov", frame.get("fov"), 0.0, 180.0)
        focals.append(height / 2 / math.tan(math.radians(fov) / 2))
    frames = ideal_cameras(torch.stack(poses), torch.tensor(focals, dtype=torch.float64), (width, height))
    return frames.shifted([-x for x in origin]), fps


def write_camera_path(path: Path, cameras: Cameras, fps: float, origin: Origin = (0.0, 0.0, 0.0)) -> None:
    """Write frames about an origin, all of the first one's size.

    What the format cannot say (distortion, fx unlike fy) is left out.
    """
    if not len(cameras):
        raise DataError(f"{path}: a camera path of no frames cannot be written")
    width, height = (int(side) for side in cameras.size[0])
    cameras, frames = cameras.shifted(origin), []
    for view in range(len(cameras)):
        matrix = [*cameras.pose[view].flatten().tolist(), 0.0, 0.0, 0.0, 1.0]
        fov = math.degrees(2 * math.atan(float(cameras.size[view, 1]) / 2 / float(cameras.focal[view, 1])))
        frames.append({"camera_to_world": matrix, "fov": fov, "aspect": width / height})
    content = {
        "camera_type": "perspective",
        "render_width": width,
        "render_height": height,
        "fps": fps,
        "seconds": len(frames) / fps,
        "is_cycle": False,
        "smoothness_value": 0.0,
        "camera_path": frames,
        "keyframes": [],
    }
    write_json(path, content)


def _wrong(path: Path, where: str, allowed: str, value: object) -> NoReturn:
    shown = json.dumps(value)
    shown = shown if len(shown) <= 60 else f"{shown[:57]}..."
    raise DataError(f"{path}: {where or 'the file'} is {shown}; must be {allowed}; export the camera path again")


def _number(path: Path, where: str, value: object, low: float, high: float) -> float:
    """A number within (low, high)."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not low < value < high:
        _wrong(path, where, f"a number between {low:g} and {high:g}", value)
    return float(value)


def _size(path: Path, content: dict[str, object], name: str) -> int:
    value = content.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 1 <= value <= 65536 or value != round(value):
        _wrong(path, name, "a whole number of pixels from 1 to 65536", value)
    return int(value)


def _pose(path: Path, where: str, value: object) -> Annotated[Tensor, "3 4"]:
    """16 numbers, or 4 rows of them, as a pose whose rotation is exactly orthonormal."""
    rows = value if isinstance(value, list) else []
    flat = [number for row in rows for number in (row if isinstance(row, list) else [row])]
    if len(flat) != 16 or not all(isinstance(number, int | float) and abs(number) < _FAR for number in flat):
        _wrong(path, where, "16 finite numbers, row by row, below 1e30", value)
    pose = torch.tensor(flat, dtype=torch.float64).reshape(4, 4)[:3]
    left, scales, right = torch.linalg.svd(pose[:, :3])
    turn = left @ right
    if float((scales - 1).abs().max()) > _STRAY or float(torch.linalg.det(turn)) < 0:
        _wrong(path, where, "a rotation and a position, without scale or mirroring", value)
    return torch.cat([turn, pose[:, 3:]], dim=1)
