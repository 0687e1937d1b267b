"""Cameras in Nerfstudio's files: camera paths, read and written, and the transforms.json of a capture, written.

A camera path that its viewer exports is rendered here, and ours loads there:

    {"camera_type": "perspective", "render_width": W, "render_height": H, "fps": F, "seconds": S,
     "camera_path": [{"camera_to_world": [16 numbers, row by row], "fov": vertical degrees, "aspect": W / H}, ...]}

Poses are in the capture's own coordinates, whatever the scene's origin, with OpenGL's axes. Pixels are square and the
principal point is the middle: the format can say nothing else.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import torch
from msgspec import Meta, Struct
from torch import Tensor

from ..errors import DataError
from ..io.atomic import write_json
from ..types import Origin
from .cameras import Cameras, ideal_cameras
from .lens import FISHEYE, OPENCV

_MODELS = {FISHEYE: "OPENCV_FISHEYE", OPENCV: "OPENCV"}
_STRAY = 1e-3
"""Tolerance of a rotation's orthonormality: viewers round to a few digits."""
_Matrix = Annotated[list[Annotated[float, Meta(gt=-1e30, lt=1e30)]], Meta(min_length=16, max_length=16)]
_Side = Annotated[float, Meta(ge=1, le=65536, multiple_of=1)]


class _Frame(Struct):
    """A frame of a file; other fields are passed over."""

    camera_to_world: _Matrix
    """16 numbers row by row."""
    fov: Annotated[float, Meta(gt=0, lt=180)]


class _CameraPath(Struct):
    """A file, with Nerfstudio's values where it leaves some out."""

    render_width: _Side
    render_height: _Side
    camera_path: Annotated[list[_Frame], Meta(min_length=1)]
    camera_type: Literal["perspective"] = "perspective"
    fps: Annotated[float, Meta(gt=0, lt=1000)] = 24.0


def read_camera_path(path: Path, origin: Origin = (0.0, 0.0, 0.0)) -> tuple[Cameras, float]:
    """The frames of a file as pinhole cameras about an origin, float64, and its frames a second.

    Raises DataError with the place.
    """
    try:
        content = msgspec.json.decode(path.read_bytes(), type=_CameraPath)
        poses = [_orthonormal(f"$.camera_path[{k}]", frame.camera_to_world) for k, frame in enumerate(content.camera_path)]
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such camera path; give spiral, interpolate, dataset or a JSON file") from error
    except (OSError, msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise DataError(f"{path}: cannot be read ({error}); export the camera path again") from error
    width, height = int(content.render_width), int(content.render_height)
    # Pixels are square: the vertical field of view decides both focal lengths.
    focals = [height / 2 / math.tan(math.radians(frame.fov) / 2) for frame in content.camera_path]
    frames = ideal_cameras(torch.stack(poses), torch.tensor(focals, dtype=torch.float64), (width, height))
    return frames.shifted([-x for x in origin]), content.fps


def _orthonormal(where: str, matrix: _Matrix) -> Annotated[Tensor, "3 4"]:
    """The pose whose rotation is the nearest orthonormal one: files hold a few digits.

    Raises ValidationError where there is a scale or a mirroring.
    """
    pose = torch.tensor(matrix, dtype=torch.float64).view(4, 4)[:3]
    left, scales, right = torch.linalg.svd(pose[:, :3])
    turn = left @ right
    if float((scales - 1).abs().max()) > _STRAY or float(torch.linalg.det(turn)) < 0:
        raise msgspec.ValidationError(f"Expected a rotation and a position, without scale or mirroring - at `{where}`")
    return torch.cat([turn, pose[:, 3:]], dim=1)


def write_camera_path(path: Path, cameras: Cameras, fps: float, origin: Origin = (0.0, 0.0, 0.0)) -> None:
    """Write frames about an origin, all of the first one's size.

    What the format cannot say (distortion, fx unlike fy) is left out.
    """
    if not len(cameras):
        raise DataError(f"{path}: a camera path of no frames cannot be written")
    width, height = (int(side) for side in cameras.size[0])
    # Files are in the capture's coordinates, cameras about the local origin.
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


def transforms(cameras: Cameras, files: Sequence[str], *, train: Sequence[int], test: Sequence[int]) -> dict[str, Any]:
    """transforms.json of V views whose images are `files`, relative to it. Intrinsics stand once if all views share them."""
    lenses = []
    for view in range(len(cameras)):
        width, height = cameras.size[view].tolist()
        (fx, fy), (cx, cy) = cameras.focal[view].tolist(), cameras.centre[view].tolist()
        lens = {"camera_model": _MODELS.get(int(cameras.lens[view]), "PINHOLE"), "w": width, "h": height}
        lens |= {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
        if bool(torch.any(cameras.distortion[view] != 0)):
            lens |= dict(zip(("k1", "k2", "k3", "k4", "p1", "p2"), cameras.distortion[view].tolist(), strict=True))
        lenses.append(lens)
    shared = all(lens == lenses[0] for lens in lenses)
    frames = []
    for view, file in enumerate(files):
        rows = [*cameras.pose[view].tolist(), [0.0, 0.0, 0.0, 1.0]]
        frames.append({"file_path": file, **({} if shared else lenses[view]), "transform_matrix": rows})
    splits = {"train": train, "test": test, "val": test}
    named = {f"{name}_filenames": [files[view] for view in views] for name, views in splits.items()}
    return {**(lenses[0] if shared else {}), "frames": frames, **named}
