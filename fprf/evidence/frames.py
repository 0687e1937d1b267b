"""Frames, cameras and depths that another system wrote: a folder of pictures, a transforms.json, a folder of arrays."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import torch
from torch import Tensor

from ..datamanagers.images import IMAGE_SUFFIXES, load_image
from ..datamanagers.parsers.files import Record, read_bytes, read_json, read_npy, read_npz, record_of
from ..datamanagers.parsers.views import rigid
from ..errors import DataError
from ..rendering.cameras import Cameras, pixel_grid, rays_through

__all__ = ["Along", "Frames", "read_cameras", "read_depths", "read_pictures"]

Along = Literal["ray", "axis"]


class Frames(NamedTuple):
    """Pictures in the order of their names."""

    names: tuple[str, ...]
    """Stems of the files."""
    images: list[Annotated[Tensor, "H W 3"]]


def read_pictures(folder: Path, names: Sequence[str] | None = None) -> Frames:
    """All pictures of a folder, or those with these stems, in [0, 1]. Raises DataError for none, or a missing one."""
    found = {path.stem: path for path in sorted(folder.glob("*")) if path.suffix.lower() in IMAGE_SUFFIXES}
    if not found:
        raise DataError(f"{folder}: no pictures ({' '.join(sorted(IMAGE_SUFFIXES))}); name the folder that the frames lie in")
    wanted = list(found) if names is None else list(names)
    missing = [name for name in wanted if name not in found]
    if missing:
        raise DataError(f"{folder}: no picture named {missing[0]} ({len(missing)} are missing); name them as the frames")
    return Frames(tuple(wanted), [torch.from_numpy(load_image(found[name])).float() / 255 for name in wanted])


def read_cameras(path: Path, frames: Frames) -> Cameras:
    """The camera of each frame out of a transforms.json, at the size of the frame.

    A frame belongs to the entry whose `file_path` has its stem; where no stem agrees and the numbers do, to the one at its
    place by name. Pinholes alone. Raises DataError for what does not fit.
    """
    entries = {
        Path(record.text("file_path") or "").stem: record for record in record_of(path, read_json(path)).records("frames")
    }
    chosen = [entries[name] for name in frames.names if name in entries]
    if not chosen and len(entries) == len(frames.names):
        chosen = [entries[name] for name in sorted(entries)]
    if len(chosen) != len(frames.names):
        raise DataError(
            f"{path}: cameras for {len(chosen)} of {len(frames.names)} frames; name the frames as the entries' file_path"
        )
    views = [_camera(record, image.shape[1], image.shape[0]) for record, image in zip(chosen, frames.images, strict=True)]
    return Cameras(
        pose=torch.stack([torch.from_numpy(rigid(r.where, r.matrix("transform_matrix"))) for r in chosen]),
        focal=torch.tensor([focal for focal, _ in views], dtype=torch.float64),
        centre=torch.tensor([centre for _, centre in views], dtype=torch.float64),
        size=torch.tensor([[image.shape[1], image.shape[0]] for image in frames.images]),
        distortion=torch.zeros(len(views), 6, dtype=torch.float64),
        lens=torch.zeros(len(views), dtype=torch.int64),
    )


def read_depths(folder: Path, names: Sequence[str], cameras: Cameras, along: Along) -> list[Annotated[Tensor, "H W"]]:
    """Distances along the unit ray of NAME.npz (array `depth`) or NAME.npy, [H W] in the unit of the poses.

    `along` says what the files hold: distances along the ray, or along the camera's axis. Raises DataError.
    """
    found = []
    for view, name in enumerate(names):
        packed, plain = folder / f"{name}.npz", folder / f"{name}.npy"
        if packed.is_file():
            array = read_npz(packed, "depth")
        elif plain.is_file():
            array = read_npy(str(plain), read_bytes(plain))
        else:
            raise DataError(f"{folder}: neither {packed.name} nor {plain.name}; write a depth for every frame")
        depth = torch.from_numpy(array.astype("float64"))
        width, height = cameras.size[view].tolist()
        if depth.shape != (height, width):
            raise DataError(f"{folder}/{name}: depth of shape {tuple(depth.shape)}, the frame has {height} rows of {width}")
        if along == "axis":
            pixel = pixel_grid(cameras, view)
            _, direction = rays_through(cameras, torch.full((len(pixel),), view), pixel)
            depth = depth / (-direction @ cameras.pose[view, :, 2]).view(height, width)
        found.append(depth)
    return found


def _camera(record: Record, width: int, height: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Focal lengths and centre in pixels of a frame that may be smaller or larger than the calibrated picture."""
    bent = [key for key in ("k1", "k2", "k3", "k4", "p1", "p2") if record.number(key)]
    if bent:
        raise DataError(f"{record.where}: {bent[0]} is not 0; only pinholes are judged, undistort the frames")
    own_width, own_height = record.number("w") or width, record.number("h") or height
    across, down = width / own_width, height / own_height
    angle, fx = record.number("camera_angle_x"), record.number("fl_x")
    if fx is None:
        if angle is None or not 0 < angle < math.pi:
            raise DataError(f"{record.where}: no fl_x, and no camera_angle_x between 0 and pi; give the focal length as fl_x")
        fx = own_width / 2 / math.tan(angle / 2)
    fy, cx, cy = record.number("fl_y"), record.number("cx"), record.number("cy")
    centre = (own_width / 2 if cx is None else cx, own_height / 2 if cy is None else cy)
    return (fx * across, (fx if fy is None else fy) * down), (centre[0] * across, centre[1] * down)
