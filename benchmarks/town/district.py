"""A district of towns: scene folders of thousands of images with true cameras.

Towns of different seeds stand in a square, a tile each, 88 m x 56 m. In each, two thirds of the cameras walk along its
street and the others look down from 14 to 24 m; the latter see neighbouring towns. A point is lit and shaded by its own
town alone, so all views agree on it; the sky has one colour, `SKY`. Each image has an exposure of its own. Colours are one
sample a pixel.
"""

import math
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fprf.io.atomic import write_bytes, write_json

from .layout import Town, build_town
from .palettes import palette
from .render import FIELD_OF_VIEW, View, cast, directions, is_test, shade, walk

SKY = (0.72, 0.8, 0.88)
"""sRGB."""
_LOW, _TILE = np.array([-17.0, -28.0]), np.array([88.0, 56.0])
"""Corner and size of a town's tile in its own metres."""
_ALONG = 0.66
"""Share of the views that are taken in the street."""
_POINTS = 64
"""Surface points kept per training view."""
_EVERY, _APART = 4, 0.03
"""A point is seen where the nearest of every so many pixels is as far away, within this share."""


def write_district(
    folder: Path, *, images: int, tiles: int, width: int, height: int, exposure: float = 0.1, workers: int = 1
) -> None:
    """Write a scene folder of `tiles` towns; pictures that are there already are kept.

    The logarithm of what an image's colours are multiplied by is within twice `exposure`.
    """
    across = math.ceil(math.sqrt(tiles))
    (folder / "images").mkdir(parents=True, exist_ok=True)
    (folder / "points").mkdir(exist_ok=True)
    each = partial(_write_view, folder, tiles, images, width, height, exposure)
    with ProcessPoolExecutor(workers) as pool:
        for _ in pool.map(each, range(images), chunksize=8):
            pass
    views = [_view(tiles, images, width, height, k) for k in range(images)]
    kept = [np.load(folder / "points" / f"{k:05d}.npz") for k in range(images)]
    cloud = np.concatenate([each["points"] for each in kept])
    owner = np.repeat(np.arange(images), [len(each["points"]) for each in kept])
    train = np.array([not is_test(k) for k in range(images)])
    cloud, owner = cloud[train[owner]], owner[train[owner]]
    count = -(-images // tiles)
    pairs = [
        _seen(views[k], kept[k]["depth"], cloud, np.flatnonzero(owner // count == k // count), k)
        for k in np.flatnonzero(train).tolist()
    ]
    with (folder / "points.npz").open("wb") as file:
        np.savez(file, xyz=cloud[:, :3], rgb=cloud[:, 3:].astype(np.uint8), seen=np.concatenate(pairs))
    names = [f"images/{k:05d}.png" for k in range(images)]
    document: dict[str, Any] = {"camera_model": "PINHOLE", "fl_x": views[0].focal, "fl_y": views[0].focal}
    document |= {"cx": width / 2, "cy": height / 2, "w": width, "h": height, "towns": [across, tiles]}
    document["frames"] = [
        {"file_path": name, "transform_matrix": [*view.pose.tolist(), [0.0, 0.0, 0.0, 1.0]]}
        for name, view in zip(names, views, strict=True)
    ]
    for split, wanted in (("train", False), ("test", True)):
        document[f"{split}_filenames"] = [name for k, name in enumerate(names) if is_test(k) == wanted]
    write_json(folder / "transforms.json", document)


@cache
def _town(seed: int) -> Town:
    return build_town(seed)


def _place(tile: int, across: int) -> NDArray[np.float64]:
    """What is added to a town's own metres."""
    return np.array([*(np.array([tile % across, tile // across]) * _TILE), 0.0])


@cache
def _views(seed: int, count: int, width: int, height: int) -> list[View]:
    """Cameras of one town, in its own metres, those of the street and those above in turn."""
    along = round(_ALONG * count)
    street = walk(seed=seed, views=along, width=width, height=height)
    rng = np.random.default_rng([0xA1B, seed])
    focal = width / 2 / math.tan(math.radians(FIELD_OF_VIEW / 2))
    above = []
    for k in range(count - along):
        way = (k + 0.5) / (count - along)
        x, y = _LOW + _TILE * np.array([way, (0.5 + 3 * k * 0.618) % 1.0])
        yaw, pitch = rng.uniform(0, 2 * math.pi), math.radians(rng.uniform(-80, -52))
        forward = np.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)])
        right = np.array([math.sin(yaw), -math.cos(yaw), 0.0])
        pose = np.column_stack([right, np.cross(right, forward), -forward, [x, y, rng.uniform(14, 24)]])
        above.append(View(pose, focal, width, height))
    order = rng.permutation(count)
    every = street + above
    return [every[k] for k in order]


def _view(tiles: int, images: int, width: int, height: int, number: int) -> View:
    tile, turn = divmod(number, -(-images // tiles))
    view = _views(tile, -(-images // tiles), width, height)[turn]
    pose = view.pose.copy()
    pose[:, 3] += _place(tile, math.ceil(math.sqrt(tiles)))
    return view._replace(pose=pose)


def _write_view(folder: Path, tiles: int, images: int, width: int, height: int, exposure: float, number: int) -> None:
    path, points = folder / "images" / f"{number:05d}.png", folder / "points" / f"{number:05d}.npz"
    if path.exists() and points.exists():
        return
    view = _view(tiles, images, width, height, number)
    colour, distance = _drawn(view, tiles)
    gain = exposure * (math.sin(0.31 * number) + math.sin(0.13 * number + 1))  # pictures in a row resemble each other
    shown = np.clip(np.rint(255 * colour * math.exp(gain)), 0, 255).astype(np.uint8)
    at = np.random.default_rng([0xE7, number]).permutation(np.flatnonzero(np.isfinite(distance)))[:_POINTS]
    ray = np.stack(directions(view, 1), -1).reshape(-1, 3)[at]
    place = view.pose[:, 3] + ray * distance[at, None]
    cloud = np.concatenate([place, shown.reshape(-1, 3)[at]], 1).astype(np.float32)
    np.savez(points, points=cloud, depth=distance.reshape(height, width)[::_EVERY, ::_EVERY].astype(np.float32))
    write_bytes(path, cv2.imencode(".png", np.ascontiguousarray(shown[..., ::-1]))[1].tobytes())


def _seen(
    view: View, depth: NDArray[np.float32], cloud: NDArray[np.float32], some: NDArray[np.int64], number: int
) -> NDArray[np.int64]:
    """Pairs of the view and the points that it sees, of some of a cloud."""
    away = cloud[some, :3] - view.pose[:, 3]
    local = away @ view.pose[:, :3]
    ahead = np.maximum(-local[:, 2], 1e-6)
    x = view.focal * local[:, 0] / ahead + view.width / 2
    y = -view.focal * local[:, 1] / ahead + view.height / 2
    inside = (local[:, 2] < 0) & (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height)
    some, x, y, away = some[inside], x[inside], y[inside], np.linalg.norm(away[inside], axis=1)
    there = some[np.abs(depth[(y / _EVERY).astype(int), (x / _EVERY).astype(int)] - away) < _APART * away]
    return np.stack([np.full(len(there), number), there], 1)


def _drawn(view: View, tiles: int) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """sRGB [H W 3] in [0, 1] and the distance [H W] of what rays meet, flattened; inf = sky."""
    look, across = palette("day"), math.ceil(math.sqrt(tiles))
    ray = directions(view, 1)
    rays = np.stack(ray, -1).reshape(-1, 3)
    distance, owner = np.full(len(rays), np.inf), np.full(len(rays), -1)
    faces = np.zeros(len(rays), np.int64)
    column, row = ((view.pose[:2, 3] - _LOW) // _TILE).astype(int)
    near = [
        (i, j)
        for j in range(row - 1, row + 2)
        for i in range(column - 1, column + 2)
        if 0 <= i < across and j >= 0 and j * across + i < tiles
    ]
    for i, j in near:
        tile = j * across + i
        local = view.pose.copy()
        local[:, 3] -= _place(tile, across)
        hits = cast(_town(tile), view._replace(pose=local), ray, 1)
        met, face = hits.distance.ravel(), hits.face.ravel()
        ground = face == 0
        spot = (local[:2, 3] + np.where(ground, met, 0)[:, None] * rays[:, :2] - _LOW) / _TILE
        alone = len(near) == 1 or tiles == 1
        inside = np.floor(spot).astype(int)
        # The ground belongs to the town in whose tile it lies; at the district's edge to the next one.
        own = np.clip(inside + np.array([i, j]), 0, (across - 1, (tiles - 1) // across)) == (i, j)
        nearer = (met < distance) & (face >= 0) & (~ground | own.all(1) | alone)
        distance[nearer], faces[nearer], owner[nearer] = met[nearer], face[nearer], tile
    colour = np.tile(np.array(SKY, np.float32), (len(rays), 1))
    for tile in np.unique(owner[owner >= 0]):
        at = np.flatnonzero(owner == tile)
        start = view.pose[:, 3] - _place(int(tile), across)
        colour[at] = shade(_town(int(tile)), look, faces[at], start + distance[at, None] * rays[at])
    return colour.reshape(view.height, view.width, 3), distance
