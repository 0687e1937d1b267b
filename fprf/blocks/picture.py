"""A scene from above: sparse points, cameras and where they look, blocks with their numbers and margins, a scale."""

import math

import cv2
import numpy as np
import torch
from torch import Tensor

from ..datamanagers.scene import Scene
from ..io.images import Picture
from .charts import chart_of, surroundings_of
from .plan import Plan
from .space import site_of

__all__ = ["top_view"]

SIDE = 1200
"""Pixels of the longer side of the ground plan."""
BORDER = 60
"""Pixels around it."""
POINTS = 200_000
"""Points drawn at most."""
_PAPER, _INK, _DUST, _CAMERA = (250, 249, 246), (40, 42, 46), (176, 172, 164), (178, 58, 40)
_COLOURS = ((0, 114, 178), (0, 158, 115), (204, 121, 167), (213, 94, 0), (86, 180, 233), (148, 103, 189))


def top_view(scene: Scene, plan: Plan) -> Picture:
    """The plan as a picture; axis 0 runs to the right, axis 1 upwards."""
    site = site_of(scene, plan.space)
    whole = surroundings_of(plan.boxes)
    margin = plan.boxes.margin + 0.5
    low, high = whole.low[:2] - margin, whole.high[:2] + margin
    step = float((high - low).amax()) / SIDE
    width, height = (math.ceil(float(extent) / step) + 2 * BORDER for extent in high - low)
    sheet: Picture = np.full((height, width, 3), _PAPER, np.uint8)

    def place(points: Tensor) -> np.ndarray:
        flat = (points[..., :2].double() - low) / step
        return torch.stack([flat[..., 0] + BORDER, height - BORDER - flat[..., 1]], -1).round().numpy().astype(np.int64)

    dots = place(site.points[:: max(1, len(site.points) // POINTS)])
    dots = dots[((dots >= 0) & (dots < (width, height))).all(1)]
    sheet[dots[:, 1], dots[:, 0]] = _DUST
    _boxes(sheet, plan, place)
    turn = torch.tensor(plan.space.rotation, dtype=torch.float64)
    ahead = -scene.cameras.pose[scene.train][:, :, 2] @ turn.T
    long = 10 * step
    for start, end in zip(place(site.position), place(site.position + long * ahead), strict=True):
        cv2.line(sheet, _at(start), _at(end), _CAMERA, 1, cv2.LINE_AA)
        cv2.circle(sheet, _at(start), 2, _CAMERA, -1, cv2.LINE_AA)
    _scale(sheet, step / plan.space.scale)
    return sheet


def _boxes(sheet: Picture, plan: Plan, place) -> None:  # type: ignore[no-untyped-def]
    for block in range(len(plan.boxes.low)):
        colour = _COLOURS[block % len(_COLOURS)]
        chart = chart_of(plan.boxes, block)
        for low, high, thick in (
            (chart.low, chart.high, 1),
            (plan.boxes.low[block], plan.boxes.high[block], 2),
        ):
            corners = torch.stack(
                [
                    torch.stack([x, y, low[2]])
                    for x, y in ((low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1]))
                ]
            )
            ring = place(corners @ plan.boxes.turn[block]).astype(np.int32)
            cv2.polylines(sheet, [ring], True, colour, thick, cv2.LINE_AA)
        middle = place(((plan.boxes.low[block] + plan.boxes.high[block]) / 2 @ plan.boxes.turn[block])[None])[0]
        cv2.putText(
            sheet,
            f"{block:02d}",
            (int(middle[0]) - 16, int(middle[1]) + 10),
            cv2.FONT_HERSHEY_SIMPLEX,
            0.9,
            colour,
            2,
            cv2.LINE_AA,
        )


def _scale(sheet: Picture, unit: float) -> None:
    """A bar of a round length in world units; `unit` of them make a pixel."""
    longest = 0.25 * sheet.shape[1] * unit
    power = 10.0 ** math.floor(math.log10(longest))
    length = max(k * power for k in (1, 2, 5) if k * power <= longest)
    pixels, y = round(length / unit), sheet.shape[0] - 24
    cv2.line(sheet, (BORDER, y), (BORDER + pixels, y), _INK, 2, cv2.LINE_AA)
    cv2.putText(
        sheet, f"{length:g} world units", (BORDER + pixels + 10, y + 5), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _INK, 1, cv2.LINE_AA
    )


def _at(point: np.ndarray) -> tuple[int, int]:
    return int(point[0]), int(point[1])
