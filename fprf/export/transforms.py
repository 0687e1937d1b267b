"""Cameras as Nerfstudio's `transforms.json`: camera to world in OpenGL axes, in the capture's own frame."""

from collections.abc import Sequence
from typing import Any

import torch

from ..rendering.cameras import Cameras
from ..rendering.lens import FISHEYE, OPENCV

_MODELS = {FISHEYE: "OPENCV_FISHEYE", OPENCV: "OPENCV"}


def transforms(cameras: Cameras, files: Sequence[str], *, train: Sequence[int], test: Sequence[int]) -> dict[str, Any]:
    """The document of V views whose images are `files`, relative to it. Intrinsics stand once if all views share them."""
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
