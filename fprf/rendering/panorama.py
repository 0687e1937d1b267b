"""All-round cameras for headsets: equirectangular, one eye or two.

A stereo panorama has no single centre: each eye moves on a circle as the head turns, and every column of the picture is
seen from where the eye is when it looks there (omnidirectional stereo: Peleg, Ben-Ezra and Pritch, 2001). It is rendered as
strips of columns, each a camera of its own.
"""

import math
from dataclasses import replace
from typing import Annotated

import torch
from torch import Tensor

from .cameras import Cameras
from .lens import PANORAMA
from .paths import look_at

__all__ = ["STRIP", "eye_strips", "panoramas"]

STRIP = 4
"""Columns that share an eye's place."""


def panoramas(cameras: Cameras, width: int, up: Annotated[Tensor, "3"]) -> Cameras:
    """Level panoramas at the cameras' places, `width` x `width` / 2 pixels, the middle where each camera looks."""
    ahead = -cameras.pose[:, :, 2]
    upright = torch.nn.functional.normalize(up, dim=0)
    level = ahead - (ahead @ upright)[:, None] * upright
    # A camera that looks straight up or down: its own up is ahead, or behind.
    level = torch.where(level.norm(dim=-1, keepdim=True) < 1e-3, cameras.pose[:, :, 1], level)
    place, count = cameras.pose[:, :, 3], len(cameras)
    size = torch.tensor([width, max(1, width // 2)])
    return Cameras(
        pose=look_at(place, place + level, upright),
        focal=torch.full((count, 2), width / (2 * math.pi), dtype=torch.float64),
        centre=(size.double() / 2).repeat(count, 1),
        size=size.repeat(count, 1),
        distortion=torch.zeros(count, 6, dtype=torch.float64),
        lens=torch.full((count,), PANORAMA),
    )


def eye_strips(panorama: Cameras, offset: float) -> Cameras:
    """The strips of one eye of one panorama, left to right; `offset` from the middle to the right, in world units."""
    width, height = (int(side) for side in panorama.size[0])
    starts = torch.arange(0, width, STRIP)
    widths = (width - starts).clamp(max=STRIP)
    many = panorama.select(torch.zeros(len(starts), dtype=torch.int64))
    angle = (starts + widths / 2 - float(panorama.centre[0, 0])) / float(panorama.focal[0, 0])
    right, back = panorama.pose[0, :, 0], panorama.pose[0, :, 2]
    across = angle.cos()[:, None] * right + angle.sin()[:, None] * back
    pose = torch.cat([many.pose[:, :, :3], (many.pose[:, :, 3] + offset * across)[:, :, None]], -1)
    centre = torch.stack([many.centre[:, 0] - starts, many.centre[:, 1]], -1)
    return replace(many, pose=pose, centre=centre, size=torch.stack([widths, torch.full_like(widths, height)], -1))
