"""A town as a scene folder that any reader of Nerfstudio's format understands, with the truth beside the
images.

transforms.json           cameras, split
images/0000.png           sRGB
depth/0000.npz            `depth` [H W] float32, metres along the unit ray through the pixel's centre, inf = sky
labels/0000.png           class ids, one channel
points.npz                `xyz` [P 3] float32 surface points, `rgb` [P 3] uint8, `seen` [O 2] view and point
palette.json, town.json   colours and light; the settings, written last
"""

import argparse
import hashlib
import json
import os
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fprf.errors import DataError

from .layout import build_town
from .palettes import OTHERS, PALETTES, Palette
from .palettes import palette as palette_of
from .render import Picture, View, directions, is_test, render, walk
from .surface import CLASSES

_EDITION = 1
"""Counts the looks of the town: raised with every change to its pictures, so that cached folders are rendered
anew.
"""
_POINTS = 256
"""Surface points kept per training view."""
_RECORD = "town.json"


@dataclass(frozen=True, kw_only=True)
class TownSettings:
    """Settings of a folder."""

    seed: int
    palette: str
    views: int
    width: int
    height: int
    extra: float = 0.0
    """Metres by which the street is longer."""
    edition: int = _EDITION

    @property
    def key(self) -> str:
        """A short hash, for folder names."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()[:12]


def is_town(folder: Path) -> bool:
    """True where the folder holds a town record."""
    return (folder / _RECORD).is_file()


def _files(views: int) -> list[str]:
    kinds = (("images", "png"), ("depth", "npz"), ("labels", "png"))
    stems = [f"{kind}/{k:04d}.{suffix}" for kind, suffix in kinds for k in range(views)]
    return [*stems, "transforms.json", "points.npz", "palette.json"]


def _complete(folder: Path, settings: TownSettings) -> bool:
    """True where a folder holds exactly these settings, all files present."""
    try:
        record = json.loads((folder / _RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    same = isinstance(record, dict) and record.get("settings") == asdict(settings)
    return same and all((folder / name).is_file() for name in _files(settings.views))


def read_truth(folder: Path, view: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Depth [H W] (inf = sky) and labels [H W] of a view of a town folder. Raises DataError where they are
    missing.
    """
    depth = folder / "depth" / f"{view:04d}.npz"
    label = folder / "labels" / f"{view:04d}.png"
    try:
        with np.load(depth) as stored:
            distance = np.asarray(stored["depth"], dtype=np.float32)
        kinds = cv2.imdecode(np.frombuffer(label.read_bytes(), np.uint8), cv2.IMREAD_GRAYSCALE)
    except (OSError, ValueError, KeyError) as error:
        raise DataError(
            f"{depth}: {error}; remove the folder {folder} and let it be rendered again"
        ) from error
    if kinds is None:
        raise DataError(f"{label}: not an image; remove the folder {folder} and let it be rendered again")
    return distance, np.asarray(kinds, dtype=np.uint8)


def _save_image(path: Path, image: NDArray[np.uint8]) -> None:
    done, data = cv2.imencode(".png", image)
    assert done
    path.write_bytes(data.tobytes())


def _save_json(path: Path, value: object) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def _transforms(views: list[View]) -> dict[str, object]:
    names = [f"images/{k:04d}.png" for k in range(len(views))]
    bottom = [0.0, 0.0, 0.0, 1.0]
    return {
        "camera_model": "PINHOLE",
        "fl_x": views[0].focal,
        "fl_y": views[0].focal,
        "cx": views[0].width / 2,
        "cy": views[0].height / 2,
        "w": views[0].width,
        "h": views[0].height,
        "frames": [
            {"file_path": name, "transform_matrix": [*view.pose.tolist(), bottom]}
            for name, view in zip(names, views, strict=True)
        ],
        "train_filenames": [name for k, name in enumerate(names) if not is_test(k)],
        "test_filenames": [name for k, name in enumerate(names) if is_test(k)],
    }


def _surface(
    view: View, picture: Picture, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    at = np.flatnonzero(np.isfinite(picture.depth))
    at = rng.permutation(at)[:_POINTS]
    ray = np.stack(directions(view, 1), -1).reshape(-1, 3)[at]
    points = view.pose[:, 3] + ray * picture.depth.reshape(-1, 1)[at]
    return points.astype(np.float32), picture.rgb.reshape(-1, 3)[at]


def _fill(folder: Path, settings: TownSettings, look: Palette) -> None:
    town = build_town(settings.seed, settings.extra)
    views = walk(
        seed=settings.seed,
        views=settings.views,
        width=settings.width,
        height=settings.height,
        extra=settings.extra,
    )
    rng = np.random.default_rng([0x9015, settings.seed])
    for name in ("images", "depth", "labels"):
        (folder / name).mkdir()
    cloud = []
    for k, view in enumerate(views):
        picture = render(town, view, look)
        _save_image(folder / "images" / f"{k:04d}.png", np.ascontiguousarray(picture.rgb[..., ::-1]))
        _save_image(folder / "labels" / f"{k:04d}.png", picture.labels)
        np.savez_compressed(folder / "depth" / f"{k:04d}.npz", depth=picture.depth)
        if not is_test(k):
            cloud.append(_surface(view, picture, rng))
    finder = np.repeat([k for k in range(len(views)) if not is_test(k)], [len(c[0]) for c in cloud])
    np.savez_compressed(
        folder / "points.npz",
        xyz=np.concatenate([c[0] for c in cloud]),
        rgb=np.concatenate([c[1] for c in cloud]),
        seen=np.stack([finder, np.arange(len(finder))], 1),
    )
    _save_json(folder / "transforms.json", _transforms(views))
    _save_json(folder / "palette.json", asdict(look))
    _save_json(folder / _RECORD, {"settings": asdict(settings), "classes": list(CLASSES)})


def write_town(
    folder: Path, *, seed: int, palette: str, views: int, width: int, height: int, extra: float = 0.0
) -> None:
    """Renders a town into a folder, all or nothing; a complete one of the same settings is left as it is.

    Raises DataError where the folder holds something else, or can't be written.
    """
    settings = TownSettings(
        seed=seed, palette=palette, views=views, width=width, height=height, extra=float(extra)
    )
    look = palette_of(palette)
    if _complete(folder, settings):
        return
    if folder.exists() and not is_town(folder) and (not folder.is_dir() or any(folder.iterdir())):
        raise DataError(f"{folder}: holds something that is not a town; name a folder that is empty or new")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as scratch:
            fresh = Path(scratch) / "town"
            fresh.mkdir()
            _fill(fresh, settings, look)
            _place(fresh, folder, settings)
    except OSError as error:
        raise DataError(
            f"{folder}: can't be written ({error}); free some space or name another folder"
        ) from error


def cached_town(
    *,
    seed: int = 0,
    palette: str = "day",
    views: int = 40,
    width: int = 160,
    height: int = 120,
    extra: float = 0.0,
) -> Path:
    """The folder of a town in the user's cache ($XDG_CACHE_HOME/fprf or ~/.cache/fprf), rendered where it is
    not there yet.
    """
    settings = TownSettings(
        seed=seed, palette=palette, views=views, width=width, height=height, extra=float(extra)
    )
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fprf"
    folder = cache / f"town-{settings.key}" / "town"
    write_town(folder, seed=seed, palette=palette, views=views, width=width, height=height, extra=extra)
    return folder


def scene_folder(data: Path) -> Path:
    """`data` itself; `town`, where there is no such folder, is the cached town."""
    return cached_town() if data == Path("town") and not data.exists() else data


def main(argv: list[str]) -> int:
    """`python -m benchmarks town FOLDER`: a town as a scene folder, with the truth beside its images."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks town", description="Render a town into a folder."
    )
    parser.add_argument("folder", type=Path, help="empty or new")
    parser.add_argument("--seed", type=int, default=0, help="decides where houses, trees and cars stand")
    parser.add_argument(
        "--palette", default="day", choices=sorted({**PALETTES, **OTHERS}), help="light and colours"
    )
    parser.add_argument("--views", type=int, default=40, help="number of images")
    parser.add_argument("--width", type=int, default=160, help="pixels across an image")
    parser.add_argument("--height", type=int, default=120, help="pixels down an image")
    parser.add_argument(
        "--extra", type=float, default=0.0, help="metres by which the street is longer than the usual 49"
    )
    options = vars(parser.parse_args(argv))
    write_town(options.pop("folder"), **options)
    return 0


def _place(fresh: Path, folder: Path, settings: TownSettings) -> None:
    """Moves a finished folder to its place; of several writers of the same one, the first wins."""
    if folder.exists():
        if _complete(folder, settings):
            return
        os.rename(folder, fresh.with_name("old"))
    try:
        os.rename(fresh, folder)
    except OSError:
        if not _complete(folder, settings):
            raise
