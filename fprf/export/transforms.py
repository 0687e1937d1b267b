"""Cameras as Nerfstudio's `transforms.json`: camera to world in OpenGL axes, in the capture's own frame."""

from collections.abc import Sequence
from typing import TypeAlias

import torch

from ..rendering.cameras import Cameras
from ..rendering.lens import FISHEYE, OPENCV

Json: TypeAlias = "dict[str, Json] | list[Json] | str | int | float"

_LAST: list[Json] = [0.0, 0.0, 0.0, 1.0]


def transforms(
    cameras: Cameras, files: Sequence[str], *, train: Sequence[int], test: Sequence[int], cloud: str | None = None
) -> dict[str, Json]:
    """The document of V views whose images are `files`, relative to it.

    Intrinsics stand once if all views share them. `cloud` names a PLY of points to start other methods from.
    """
    lenses = [_lens(cameras, view) for view in range(len(cameras))]
    shared = all(lens == lenses[0] for lens in lenses)
    frames: list[Json] = []
    for view, file in enumerate(files):
        rows: list[Json] = [*cameras.pose[view].tolist(), _LAST]
        frames.append({"file_path": file, **({} if shared else lenses[view]), "transform_matrix": rows})
    document: dict[str, Json] = dict(lenses[0]) if shared else {}
    if cloud is not None:
        document["ply_file_path"] = cloud
    document["frames"] = frames
    document["train_filenames"] = [files[view] for view in train]
    document["test_filenames"] = [files[view] for view in test]
    document["val_filenames"] = [files[view] for view in test]
    return document


def _lens(cameras: Cameras, view: int) -> dict[str, Json]:
    kind = int(cameras.lens[view])
    width, height = (int(side) for side in cameras.size[view])
    fx, fy = cameras.focal[view].tolist()
    cx, cy = cameras.centre[view].tolist()
    lens: dict[str, Json] = {
        "camera_model": "OPENCV_FISHEYE" if kind == FISHEYE else "OPENCV" if kind == OPENCV else "PINHOLE",
        "w": width,
        "h": height,
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx,
        "cy": cy,
    }
    if bool(torch.any(cameras.distortion[view] != 0)):
        lens |= dict(zip(("k1", "k2", "k3", "k4", "p1", "p2"), cameras.distortion[view].tolist(), strict=True))
    return lens
