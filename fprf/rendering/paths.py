"""Camera paths through a captured scene, as `Cameras` without distortion, and Nerfstudio's files of cameras.

World units and OpenGL axes as in `rendering.cameras`; float64. Every path stays where the training cameras
were: a radiance field knows nothing of places that no camera has seen. A camera path that Nerfstudio's viewer
exports is rendered here, and ours loads there:

    {"camera_type": "perspective", "render_width": W, "render_height": H, "fps": F, "seconds": S,
     "camera_path": [{"camera_to_world": [16 numbers, row by row], "fov": vertical degrees, "aspect": W / H},
     ...]}

Poses are in the capture's own coordinates, whatever the scene's origin. Pixels are square and the principal
point is the middle: the format can say nothing else.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import torch
from msgspec import Meta, Struct
from torch import Tensor

from ..checks import at_least
from ..errors import DataError, UsageError
from ..io.atomic import write_json
from ..io.paths import as_path
from ..types import Origin
from .cameras import Cameras, ideal_cameras
from .lens import FISHEYE, OPENCV, PINHOLE
from .splines import catmull_rom, quaternions, rotations, slerp

_SPIRAL_TURNS = 2
"""As in the spirals of LLFF."""
_PARALLEL_SPREADS = 4
"""Distance, in baselines, at which cameras with parallel axes are taken to look; by eye."""
_MAX_SPIRAL_SHRINKS = 64
"""Steps in which a spiral shrinks until it stays near the cameras; by eye."""
_MODELS = {FISHEYE: "OPENCV_FISHEYE", OPENCV: "OPENCV"}
_MAX_ROTATION_ERROR = 1e-3
"""Tolerance of a rotation's orthonormality: viewers round to a few digits."""
_Matrix = Annotated[list[Annotated[float, Meta(gt=-1e30, lt=1e30)]], Meta(min_length=16, max_length=16)]
_Side = Annotated[float, Meta(ge=1, le=65536, multiple_of=1)]


def look_at(
    position: Annotated[Tensor, "M 3"], target: Annotated[Tensor, "M 3"], up: Annotated[Tensor, "3"]
) -> Annotated[Tensor, "M 3 4"]:
    """Poses at `position` that look at `target`, x level with respect to `up`. Rotations orthonormal to
    1e-12.

    Where the line of sight runs along `up`, which then says nothing, another axis takes its place.
    """
    back = _unit(position - target)
    right = torch.linalg.cross(up.expand_as(back), back)
    vague = right.norm(dim=-1, keepdim=True) < 1e-6 * up.norm()
    right = _unit(torch.where(vague, torch.linalg.cross(_least_axis(up).expand_as(back), back), right))
    return torch.stack([right, torch.linalg.cross(back, right), back, position], dim=-1)


def pinhole(pose: Annotated[Tensor, "F 3 4"], *, width: int, height: int, fov: float) -> Cameras:
    """Frames at `pose` with square pixels, the principal point in the middle and a vertical angle of `fov`
    degrees.
    """
    return ideal_cameras(pose, height / 2 / math.tan(math.radians(fov) / 2), (width, height))


def spiral(cameras: Cameras, frames: int) -> Cameras:
    """A closed spiral of two turns about the most central captured camera, looking at where the optical axes
    meet.

    The radii are the spread of the cameras along the central camera's axes, shrunk until no frame is farther
    from a captured camera than captured cameras are from each other. Raises ConfigError.
    """
    at_least("frames", frames, 1)
    centres = cameras.pose[:, :, 3]
    apart = torch.cdist(centres, centres)
    middle = int(apart.sum(-1).argmin())
    rotation = cameras.pose[middle, :, :3]
    start = centres[middle]
    depth = _focus_depth(cameras, middle)
    spread = ((centres - start) @ rotation).abs().quantile(0.9, dim=0)
    # Beyond a third of the depth the view would swing by more than 18 degrees, or pass what it looks at.
    radii = spread.clamp(max=depth / 3)
    angle = torch.arange(frames, dtype=centres.dtype, device=centres.device) * (
        2 * math.pi * _SPIRAL_TURNS / frames
    )
    loop = (
        torch.stack([angle.cos(), angle.sin(), (angle / _SPIRAL_TURNS).sin()], dim=-1) * radii
    ) @ rotation.T
    # The distance from a camera to the nearest other one, such that nine in ten are closer.
    others = apart + torch.diag(torch.full_like(apart[0], torch.inf))
    if len(cameras) == 1:
        reach = 1.0
    else:
        reach = float(others.amin(dim=-1).quantile(0.9))
    for step in range(_MAX_SPIRAL_SHRINKS):
        position = start + loop * (1 - step / _MAX_SPIRAL_SHRINKS)
        if float(torch.cdist(position, centres).amin(dim=-1).amax()) <= reach:
            break
    target = (start - rotation[:, 2] * depth).expand_as(position)
    return _pinhole(look_at(position, target, rotation[:, 1]), cameras, middle)


def orbit(cameras: Cameras, frames: int) -> Cameras:
    """Around the place that the cameras look at, in the distance and elevation that they have at each
    azimuth.

    A full circle where the cameras surround the place, else to and fro within the arc that they cover; closed
    in both cases. The axis is the cameras' mean up, or for cameras that look straight down, against their
    view. Raises UsageError.
    """
    at_least("frames", frames, 1)
    pose = cameras.pose
    centres = pose[:, :, 3]
    up = upwards(cameras)
    if float(up.norm()) < 1e-6:
        raise UsageError("orbit: the cameras have no common up; choose the path 'interpolate' or 'dataset'")
    up = _unit(up)
    middle = int(torch.cdist(centres, centres).sum(-1).argmin())
    target = _meeting(pose)
    if target is None:
        target = centres[middle] - pose[middle, :, 2] * _focus_depth(cameras, middle)
    east = _unit(torch.linalg.cross(up, _least_axis(up)))
    north = torch.linalg.cross(up, east)
    offset = centres - target
    distance = offset.norm(dim=-1)
    azimuth = torch.atan2(offset @ north, offset @ east)
    elevation = torch.asin(((offset @ up) / distance.clamp(min=1e-12)).clamp(-1, 1))
    # A closed walk over the azimuths: a circle, or to and fro where more than 100 degrees hold no camera.
    phase = torch.arange(frames, dtype=azimuth.dtype, device=azimuth.device) / frames
    around = azimuth.sort().values
    gaps = torch.cat([around[1:], around[:1] + 2 * math.pi]) - around
    widest = int(gaps.argmax())
    first = float(around[(widest + 1) % len(around)])
    if float(gaps[widest]) < math.radians(100):
        angle = first + 2 * math.pi * phase
    else:
        arc = 2 * math.pi - float(gaps[widest])
        angle = first + arc * (1 - torch.cos(2 * math.pi * phase)) / 2
    # Von Mises kernel, about 15 degrees wide; the maximum is taken out so that an empty azimuth takes the
    # nearest camera.
    closeness = 15 * torch.cos(angle[:, None] - azimuth)
    share = torch.softmax(closeness, dim=-1)
    high = share @ elevation
    far = share @ distance
    level = angle.cos()[:, None] * east + angle.sin()[:, None] * north
    position = target + far[:, None] * (high.cos()[:, None] * level + high.sin()[:, None] * up)
    return _pinhole(look_at(position, target.expand_as(position), up), cameras, middle)


def interpolate(cameras: Cameras, order: Annotated[Tensor, "M"], frames_between: int) -> Cameras:
    """Through the views of `order`, with `frames_between` new ones in each gap: (M - 1) (frames_between + 1)
    + 1 frames.

    Positions follow a centripetal Catmull-Rom spline, which neither loops nor overshoots; rotations and
    intrinsics move evenly (SLERP, linear). Every frame has the size of the first view. Raises ConfigError.
    """
    at_least("views", len(order), 1)
    # Intrinsics of all views in pixels of the first one: captures mix sizes.
    keys = cameras.select(order)
    keys = keys.resized(keys.size[:1].expand(len(keys), 2))
    frame = torch.arange((len(keys) - 1) * (frames_between + 1) + 1, device=keys.pose.device)
    gap = frame // (frames_between + 1)
    u = (frame % (frames_between + 1)) / keys.pose.new_tensor(frames_between + 1)
    after = (gap + 1).clamp(max=len(keys) - 1)
    turn = quaternions(keys.pose[:, :, :3])
    # Rotations the short way round, positions along a spline that visits every key.
    rotation = rotations(slerp(turn[gap], turn[after], u))
    position = catmull_rom(keys.pose[:, :, 3], gap, u)
    return Cameras(
        pose=torch.cat([rotation, position[:, :, None]], dim=-1),
        focal=torch.lerp(keys.focal[gap], keys.focal[after], u[:, None]),
        centre=torch.lerp(keys.centre[gap], keys.centre[after], u[:, None]),
        size=keys.size[gap],
        distortion=torch.zeros_like(keys.distortion[gap]),
        lens=torch.full_like(keys.lens[gap], PINHOLE),
    )


def tour(cameras: Cameras, indices: Annotated[Tensor, "M"]) -> Annotated[Tensor, "M"]:
    """`indices` in an order fit for `interpolate`: from an outermost view always to the nearest one not yet
    visited.
    """
    centres = cameras.pose[indices, :, 3]
    apart = torch.cdist(centres, centres)
    here = int(apart.sum(-1).argmax()) if len(indices) else 0
    order: list[int] = []
    for _ in range(len(indices)):
        order.append(here)
        apart[:, here] = torch.inf
        here = int(apart[here].argmin())
    return indices[torch.tensor(order, dtype=torch.int64, device=indices.device)]


def _pinhole(pose: Annotated[Tensor, "F 3 4"], cameras: Cameras, view: int) -> Cameras:
    """Frames at `pose` with the focal length and size of a captured view, without its distortion."""
    like = cameras.select(torch.full((len(pose),), view, device=pose.device))
    return replace(
        like,
        pose=pose,
        distortion=torch.zeros_like(like.distortion),
        lens=torch.full_like(like.lens, PINHOLE),
    )


def _unit(vector: Tensor) -> Tensor:
    return torch.nn.functional.normalize(vector, dim=-1, eps=1e-300)


def _least_axis(vector: Annotated[Tensor, "3"]) -> Annotated[Tensor, "3"]:
    """The axis that a vector is least like."""
    return torch.eye(3, dtype=vector.dtype, device=vector.device)[vector.abs().argmin()]


def _meeting(pose: Annotated[Tensor, "V 3 4"]) -> Annotated[Tensor, "3"] | None:
    """The point closest to all optical axes, in front of the cameras; None where they do not meet, or hardly.

    Of axes that all but agree in direction the closest point lies among the cameras themselves: most axes
    must pass it at less than half of its distance.
    """
    forward = -pose[:, :, 2]
    # Least squares: the sum of squared distances to the axes has the normal matrix of projections across
    # them.
    across = torch.eye(3, dtype=pose.dtype, device=pose.device) - forward[:, :, None] * forward[:, None, :]
    system = across.mean(dim=0)
    values = torch.linalg.eigvalsh(system)
    # The smallest eigenvalue is the mean squared sine between the axes: 1e-3 is 2 degrees.
    if float(values[0]) < 1e-3:
        return None
    target = torch.linalg.solve(system, (across @ pose[:, :, 3:]).mean(dim=0)[:, 0])
    way = target - pose[:, :, 3]
    ahead = (way * forward).sum(dim=-1)
    past = (way - ahead[:, None] * forward).norm(dim=-1)
    return target if float((past < 0.5 * ahead).double().mean()) > 0.75 else None


def _focus_depth(cameras: Cameras, view: int) -> float:
    """Depth along the axis of a view at which what it shows lies: where the optical axes meet."""
    pose = cameras.pose[view]
    target = _meeting(cameras.pose)
    if target is not None:
        ahead = float((pose[:, 3] - target) @ pose[:, 2])
        if ahead > 0:
            return ahead
    # Parallel axes show something far away compared with the baseline, as in any capture that can be
    # reconstructed.
    spread = float((cameras.pose[:, :, 3] - pose[:, 3]).norm(dim=-1).max())
    return _PARALLEL_SPREADS * spread if spread > 0 else 1.0


MOTIONS = ("spiral", "orbit", "interpolate", "dataset")


def make_path(
    cameras: Cameras, views: Sequence[int], motion: str, frames: int, origin: Origin = (0.0, 0.0, 0.0)
) -> Cameras:
    """Cameras of a motion, or of a camera-path JSON file, about the `origin` that the captured `cameras`
    have.

    `interpolate` and `dataset` go through `views` of the captured `cameras`, the latter with their own
    lenses. `frames` are those of a spiral or orbit, and about those of an interpolation, which leaves out
    views where they are more; a file and the captured views bring their own number. Raises UsageError for
    what is neither, DataError for a file that is no camera path.
    """
    chosen = torch.tensor(list(views), dtype=torch.int64)
    if motion == "dataset":
        return cameras.select(chosen)
    if motion == "spiral":
        return spiral(cameras, frames)
    if motion == "orbit":
        return orbit(cameras, frames)
    if motion == "interpolate":
        order = tour(cameras, chosen)
        at_least("frames", frames, 1)
        if len(order) > frames:
            order = order[torch.linspace(0, len(order) - 1, frames).round().long()]
        between = max(0, round((frames - 1) / max(1, len(order) - 1)) - 1)
        return interpolate(cameras, order, between)
    file = as_path(motion)
    if not file.is_file():
        raise UsageError(f"--path {motion}: neither a file nor one of {', '.join(MOTIONS)}")
    return read_camera_path(file, origin)[0]


def upwards(cameras: Cameras) -> Annotated[Tensor, "3"]:
    """The mean of the cameras' up, or, where they look straight down, against their view; world axes, not of
    unit length.
    """
    up = cameras.pose[:, :, 1].mean(dim=0)
    if float(up.norm()) < 0.3:
        return cameras.pose[:, :, 2].mean(dim=0)
    return up


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
        poses = []
        for k, frame in enumerate(content.camera_path):
            poses.append(_orthonormal(f"$.camera_path[{k}]", frame.camera_to_world))
    except FileNotFoundError as error:
        raise DataError(
            f"{path}: no such camera path; give spiral, interpolate, dataset or a JSON file"
        ) from error
    except (OSError, msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise DataError(f"{path}: cannot be read ({error}); export the camera path again") from error
    width = int(content.render_width)
    height = int(content.render_height)
    # Pixels are square: the vertical field of view decides both focal lengths.
    focals = []
    for frame in content.camera_path:
        focals.append(height / 2 / math.tan(math.radians(frame.fov) / 2))
    frames = ideal_cameras(torch.stack(poses), torch.tensor(focals, dtype=torch.float64), (width, height))
    return frames.shifted([-x for x in origin]), content.fps


def _orthonormal(where: str, matrix: _Matrix) -> Annotated[Tensor, "3 4"]:
    """The pose whose rotation is the nearest orthonormal one: files hold a few digits.

    Raises ValidationError where there is a scale or a mirroring.
    """
    pose = torch.tensor(matrix, dtype=torch.float64).view(4, 4)[:3]
    left, scales, right = torch.linalg.svd(pose[:, :3])
    turn = left @ right
    if float((scales - 1).abs().max()) > _MAX_ROTATION_ERROR or float(torch.linalg.det(turn)) < 0:
        raise msgspec.ValidationError(
            f"Expected a rotation and a position, without scale or mirroring - at `{where}`"
        )
    return torch.cat([turn, pose[:, 3:]], dim=1)


def write_camera_path(path: Path, cameras: Cameras, fps: float, origin: Origin = (0.0, 0.0, 0.0)) -> None:
    """Write frames about an origin, all of the first one's size.

    What the format cannot say (distortion, fx unlike fy) is left out.
    """
    if not len(cameras):
        raise DataError(f"{path}: a camera path of no frames cannot be written")
    width, height = (int(side) for side in cameras.size[0])
    # Files are in the capture's coordinates, cameras about the local origin.
    cameras = cameras.shifted(origin)
    frames = []
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


def transforms(
    cameras: Cameras, files: Sequence[str], *, train: Sequence[int], test: Sequence[int]
) -> dict[str, Any]:
    """transforms.json of V views whose images are `files`, relative to it. Intrinsics stand once if all views
    share them.
    """
    lenses = []
    for view in range(len(cameras)):
        width, height = cameras.size[view].tolist()
        (fx, fy) = cameras.focal[view].tolist()
        (cx, cy) = cameras.centre[view].tolist()
        lens = {"camera_model": _MODELS.get(int(cameras.lens[view]), "PINHOLE"), "w": width, "h": height}
        lens |= {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
        if bool(torch.any(cameras.distortion[view] != 0)):
            lens |= dict(
                zip(("k1", "k2", "k3", "k4", "p1", "p2"), cameras.distortion[view].tolist(), strict=True)
            )
        lenses.append(lens)
    shared = all(lens == lenses[0] for lens in lenses)
    frames = []
    for view, file in enumerate(files):
        rows = [*cameras.pose[view].tolist(), [0.0, 0.0, 0.0, 1.0]]
        frames.append({"file_path": file, **({} if shared else lenses[view]), "transform_matrix": rows})
    splits = {"train": train, "test": test, "val": test}
    named = {}
    for name, views in splits.items():
        named[f"{name}_filenames"] = [files[view] for view in views]
    return {**(lenses[0] if shared else {}), "frames": frames, **named}
