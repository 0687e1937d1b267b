"""San Francisco Mission Bay (Block-NeRF): TFRecord files of images with an origin and a direction for each pixel.

Files whose name holds `val` or `test` are held out. Each record keeps `image` (PNG), `cam_idx`, `image_hash`, `height`,
`width`, `equivalent_exposure`, `ray_origins` and `ray_dirs`. Images are taken out once, into the user's cache, and a camera is
fitted to each image's rays; what lies in a complete cache is not read again.
"""

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import DataError
from ...interfaces import DataParser
from ...io.atomic import atomic_path, write_json
from ...rendering.lens import OPENCV
from ..scene import Scene
from .config import BlockNerfConfig
from .ray_camera import fit_camera
from .split import indices
from .tfrecord import Example, read_examples
from .town import cache_folder
from .views import View, assemble, rigid

__all__ = ["BlockNerfParser", "is_record", "record_files"]

_FORMAT = 1


def record_files(data: Path) -> list[Path]:
    """The TFRecord files of a folder and its folders, by name."""
    return sorted(path for path in data.rglob("*") if is_record(path.name) and path.is_file())


def is_record(name: str) -> bool:
    """Return whether a file name is that of a TFRecord file or of one of its shards."""
    return re.search(r"\.tfrecord(-\d+-of-\d+)?$", name) is not None


class BlockNerfParser(DataParser):
    """TFRecord files in a folder."""

    def __init__(self, config: BlockNerfConfig) -> None:
        self.config = config

    def parse(self, data: Path, downscale: int) -> Scene:
        """The scene at 1/downscale of the stored size. Raises DataError naming file and record."""
        files = record_files(data)
        if not files:
            raise DataError(f"{data}: no *.tfrecord files here or below; name the folder that they lie in")
        folder = cache_folder() / f"blocknerf-{_key(data, files)}"
        entries = _unpacked(folder)
        if entries is None:
            entries = [entry for file in files for entry in _unpack(file, data, folder)]
            write_json(folder / "views.json", {"format": _FORMAT, "views": entries})
        chosen = [e for e in entries if not self.config.cameras or e["camera"] in self.config.cameras]
        if not chosen:
            present = sorted({e["camera"] for e in entries})
            raise DataError(f"{data}: no images of cameras {list(self.config.cameras)}; parser.cameras may name {present}")
        chosen.sort(key=lambda entry: str(entry["name"]))
        self._check(data, chosen)
        views = [_view(folder, entry) for entry in chosen]
        held = [bool(entry["held"]) for entry in chosen]
        split = (indices([not each for each in held]), indices(held)) if any(held) and not all(held) else None
        exposure = [float(entry["exposure"]) for entry in chosen]
        scene = assemble(data, views, downscale=downscale, split=split)
        return _exposed(scene, exposure)

    def _check(self, data: Path, entries: list[dict[str, Any]]) -> None:
        worst = max(entries, key=lambda entry: float(entry["error"]))
        if worst["error"] > self.config.tolerance:
            raise DataError(
                f"{data}: the rays of {worst['name']} are {worst['error']:.2g} pixels from those of any camera, "
                f"parser.tolerance is {self.config.tolerance:g}; raise it, or leave out its camera with parser.cameras"
            )


def _exposed(scene: Scene, exposure: list[float]) -> Scene:
    from dataclasses import replace

    import torch

    return replace(scene, exposure=torch.tensor(exposure, dtype=torch.float64))


def _key(data: Path, files: list[Path]) -> str:
    """By what tells files apart without reading hundreds of gigabytes: place, size and time."""
    facts = [(str(f.relative_to(data)), f.stat().st_size, f.stat().st_mtime_ns) for f in files]
    return hashlib.sha256(json.dumps([str(data.resolve()), facts]).encode()).hexdigest()[:12]


def _unpacked(folder: Path) -> list[dict[str, Any]] | None:
    """The views of a complete cache."""
    try:
        document = json.loads((folder / "views.json").read_text())
        entries: list[dict[str, Any]] = document["views"]
        complete = document["format"] == _FORMAT and all((folder / "images" / f"{e['name']}.png").is_file() for e in entries)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return entries if complete else None


def _unpack(file: Path, data: Path, folder: Path) -> list[dict[str, Any]]:
    held = bool(re.search("val|test", str(file.relative_to(data)).lower()))
    (folder / "images").mkdir(parents=True, exist_ok=True)
    return [_entry(example, folder, held) for example in read_examples(file)]


def _entry(example: Example, folder: Path, held: bool) -> dict[str, Any]:
    """Writes the image; what is known of its camera."""
    height, width = example.integer("height"), example.integer("width")
    if not (4 <= height <= 10**5 and 4 <= width <= 10**5):
        raise DataError(f"{example.where}: an image of {width}x{height} pixels; download the file again")
    count = 3 * height * width
    shape = (height, width, 3)
    origin = example.numbers("ray_origins", count).reshape(shape)
    direction = example.numbers("ray_dirs", count).reshape(shape)
    try:
        camera = fit_camera(origin, direction)
    except (ValueError, np.linalg.LinAlgError) as error:
        raise DataError(f"{example.where}: its rays are not those of a camera ({error}); leave its file out") from error
    exposure = float(example.numbers("equivalent_exposure", 1)[0])
    if exposure <= 0:
        raise DataError(f"{example.where}: equivalent_exposure is {exposure}, it must be above 0; leave its file out")
    index = example.integer("cam_idx")
    # Hashes are unsigned: neither a minus nor an order by size belongs in a file's name.
    name = f"cam{index:02d}-{example.integer('image_hash') & 0xFFFFFFFFFFFFFFFF:016x}"
    with atomic_path(folder / "images" / f"{name}.png") as temporary:
        temporary.write_bytes(example.blob("image"))
    return {
        "name": name,
        "camera": index,
        "held": held,
        "exposure": exposure,
        "size": [width, height],
        "pose": camera.pose.tolist(),
        "focal": camera.focal,
        "centre": camera.centre,
        "distortion": camera.distortion,
        "error": camera.error,
        "drift": camera.drift,
    }


def _view(folder: Path, entry: dict[str, Any]) -> View:
    k1, k2, k3, k4, p1, p2 = (float(v) for v in entry["distortion"])
    return View(
        name=str(entry["name"]),
        path=folder / "images" / f"{entry['name']}.png",
        pose=rigid(str(entry["name"]), np.array(entry["pose"], dtype=np.float64)),
        size=(int(entry["size"][0]), int(entry["size"][1])),
        focal=(float(entry["focal"][0]), float(entry["focal"][1])),
        centre=(float(entry["centre"][0]), float(entry["centre"][1])),
        distortion=(k1, k2, k3, k4, p1, p2),
        lens=OPENCV,
    )
