"""Places that a view of the town shows, and pixels that show a place."""

import numpy as np

from benchmarks.town.render import directions


def world(view, depth):
    """Points [N 3] at finite depths, and the mask of these [H W]."""
    seen = np.isfinite(depth)
    return view.pose[:, 3] + np.stack(directions(view, 1), -1)[seen] * depth[seen][:, None], seen


def project(view, points):
    """Row, column and distance of points [N 3]; row -1 where they lie outside the image."""
    off = points - view.pose[:, 3]
    local = off @ view.pose[:, :3]
    with np.errstate(divide="ignore", invalid="ignore"):
        x = view.focal * local[:, 0] / -local[:, 2] + view.width / 2
        y = -view.focal * local[:, 1] / -local[:, 2] + view.height / 2
        inside = (local[:, 2] < -0.05) & (x >= 0) & (y >= 0) & (x < view.width) & (y < view.height)
        row, column = np.where(inside, np.floor(y), -1).astype(int), np.where(inside, np.floor(x), -1).astype(int)
    return row, column, np.linalg.norm(off, axis=1)
