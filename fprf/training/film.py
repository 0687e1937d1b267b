"""One frame of a flight in all that is asked for: several looks, depth, normals, match maps; for one eye or two."""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from ..interfaces import Scene
from ..io.images import Picture, srgb_to_linear, to_uint8
from ..io.maps import depth_image, depth_limits
from ..rendering.cameras import Cameras, normals
from ..rendering.paths import eye_strips
from ..style.match_maps import match_map, match_picture
from ..style.restyle import Styled
from ..types import View

Channel: TypeAlias = Literal["colour", "depth", "normals", "match"]

_PROBES, _PROBE_RESOLUTION = 4, 0.25
"""Frames, and their size, that the range of depths is taken from: one range for a whole film."""


class Take(NamedTuple):
    """A look of the scene along a flight."""

    name: str
    scene: Callable[[int], Scene]
    """In its look of each frame."""
    styled: Styled | None = None
    """The style where it is one throughout, for match maps."""


def shoot(scene: Scene, cameras: Cameras, frame: int, eyes: float | None = None) -> View:
    """One frame. With `eyes`, their distance in world units, of a stereo panorama: the left eye above the right one."""
    if eyes is None:
        return scene.render(cameras, frame)
    one = cameras.select(torch.tensor([frame]))
    left, right = (_eye(scene, eye_strips(one, offset)) for offset in (-eyes / 2, eyes / 2))
    rgb, depth, opacity = (torch.cat(pair, 0) for pair in zip(left[:3], right[:3], strict=True))
    return View(rgb, depth, opacity, (left.kept + right.kept) / 2)


def limits_of(scene: Scene, cameras: Cameras) -> tuple[float, float]:
    """The range of depth colours, from a few small frames."""
    some = sorted({k * (len(cameras) - 1) // max(1, _PROBES - 1) for k in range(_PROBES)})
    probes = [scene.render(cameras, k, resolution=_PROBE_RESOLUTION) for k in some]
    return depth_limits([view.depth for view in probes], [view.opacity for view in probes])


def panels(
    scene: Scene,
    cameras: Cameras,
    frame: int,
    takes: Sequence[Take],
    show: Sequence[Channel],
    limits: tuple[float, float] | None = None,
    eyes: float | None = None,
) -> list[Picture]:
    """Panels in their order: colour and match maps once for each take, geometry once for all."""
    views = [shoot(take.scene(frame), cameras, frame, eyes) for take in takes] if "colour" in show else []
    geometry = views[0] if views else shoot(scene, cameras, frame, eyes)
    shown: list[Picture] = []
    for channel in show:
        if channel == "colour":
            shown += [to_uint8(view.rgb) for view in views]
        elif channel == "depth":
            shown.append(depth_image(geometry.depth, geometry.opacity, limits))
        elif channel == "normals":
            shown.append(_normals_picture(cameras, frame, geometry))
        else:
            for take in takes:
                if take.styled is not None:
                    shown.append(match_picture(match_map(scene, take.styled, frame, cameras), take.styled.codes))
    return shown


def planes(cameras: Cameras, frame: int, takes: Sequence[Take], eyes: float | None = None) -> dict[str, NDArray[np.float32]]:
    """Everything of a frame as numbers: linear R G B (of each take as NAME.R ..., where there are several), A, Z, N.X N.Y N.Z.

    Z is the distance along the ray in world units, 0 where nothing is; normals are in world axes and absent in stereo.
    """
    layers: dict[str, NDArray[np.float32]] = {}
    view = None
    for take in takes:
        view = shoot(take.scene(frame), cameras, frame, eyes)
        layer = "" if len(takes) == 1 else f"{take.name}."
        light = srgb_to_linear(view.rgb.numpy())
        layers |= {f"{layer}{name}": light[..., k] for k, name in enumerate("RGB")}
    assert view is not None
    layers["A"] = view.opacity.numpy()
    layers["Z"] = torch.where(view.opacity > 0, view.depth, 0).nan_to_num(0.0, 0.0, 0.0).float().numpy()
    if eyes is None:
        facing = normals(cameras, frame, view.depth).numpy()
        layers |= {f"N.{name}": facing[..., k] for k, name in enumerate("XYZ")}
    return layers


def _eye(scene: Scene, strips: Cameras) -> View:
    # Strips of a few columns cannot be reduced.
    parts = [scene.render(strips, k, resolution=1.0) for k in range(len(strips))]
    joined = [torch.cat(columns, 1) for columns in zip(*(part[:3] for part in parts), strict=True)]
    return View(joined[0], joined[1], joined[2], sum(part.kept for part in parts) / len(parts))


def _normals_picture(cameras: Cameras, frame: int, view: View) -> Picture:
    """Normals in camera axes: red to the right, green up, blue towards the viewer; grey where nothing is."""
    turned = normals(cameras, frame, view.depth).double() @ cameras.pose[frame, :, :3]
    cover = view.opacity[..., None].clamp(0, 1).double() * (turned.norm(dim=-1, keepdim=True) > 0.5)
    return to_uint8(0.5 + 0.5 * turned * cover)
