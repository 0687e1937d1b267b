"""One frame of a flight in all that is asked for: several looks, depth, normals, match maps."""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, TypeAlias

from ..interfaces import Scene
from ..io.images import Picture, to_uint8
from ..io.maps import depth_image, depth_limits
from ..rendering.cameras import Cameras, normals
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
) -> list[Picture]:
    """Panels in their order: colour and match maps once for each take, geometry once for all."""
    views = [take.scene(frame).render(cameras, frame) for take in takes] if "colour" in show else []
    geometry = views[0] if views else scene.render(cameras, frame)
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


def _normals_picture(cameras: Cameras, frame: int, view: View) -> Picture:
    """Normals in camera axes: red to the right, green up, blue towards the viewer; grey where nothing is."""
    turned = normals(cameras, frame, view.depth).double() @ cameras.pose[frame, :, :3]
    cover = view.opacity[..., None].clamp(0, 1).double() * (turned.norm(dim=-1, keepdim=True) > 0.5)
    return to_uint8(0.5 + 0.5 * turned * cover)
