"""The WebSocket messages that a page may send: small JSON objects of few kinds, with bounded numbers and short texts."""

from typing import Annotated, Literal, TypeAlias

import msgspec
import torch
from msgspec import Meta, Struct

from ..errors import DataError, UsageError
from ..rendering.cameras import Cameras, ideal_cameras

Text: TypeAlias = Annotated[str, Meta(max_length=80)]
Number: TypeAlias = Annotated[float, Meta(ge=-1e9, le=1e9)]  # NaN fails either bound
Share: TypeAlias = Annotated[float, Meta(ge=0, le=1)]
Count: TypeAlias = Annotated[int, Meta(ge=0, le=10**9)]
Vector: TypeAlias = tuple[Number, Number, Number]
Side: TypeAlias = Annotated[float, Meta(ge=1, le=8192)]
Positive: TypeAlias = Annotated[float, Meta(gt=0, le=1e6)]
_MIN_SIDE, _MAX_SIDE = 8, 4096


class Camera(Struct, forbid_unknown_fields=True, frozen=True):
    """Where a client stands, in the scene's coordinates."""

    place: Vector
    axes: tuple[Vector, Vector, Vector]
    """Right, down and forward."""
    lens: tuple[Positive, Positive, Number, Number]
    """fx, fy, cx, cy in pixels of its canvas."""
    size: tuple[Side, Side]


class Message(Struct, tag=True, forbid_unknown_fields=True):
    """A message."""


class View(Message, tag="view"):
    """A camera has moved, of a scene that is drawn here; with `captured` the scene as captured is shown beside the look."""

    camera: Camera
    captured: bool = False


class Set(Message, tag="set"):
    """A control of the look was moved."""

    name: Literal["strength", "bold", "luminance", "temperature", "clusters", "blend", "smoothness"]
    value: Number


class Preset(Message, tag="preset"):
    """A preset was chosen."""

    name: Text


class Card(Message, tag="card"):
    """A photograph of the shelf: alone, with a weight in the mix, or off the shelf."""

    card: Count
    action: Literal["alone", "weight", "remove"]
    weight: Annotated[float, Meta(ge=0, le=4)] = 1.0


class Pick(Message, tag="pick"):
    """A place of the picture was clicked, in shares of its width and height."""

    camera: Camera
    x: Share
    y: Share


class Region(Message, tag="region"):
    """What the picked region takes; `close` picks none."""

    action: Literal["pin", "forbid", "keep", "free", "close"]
    card: Count | None = None


class Map(Message, tag="map"):
    """What is shown in the place of colours."""

    map: Literal["none", "matches", "regions", "depth"]


class Keep(Message, tag="keep"):
    """A look is kept under a name, taken up again, or dropped."""

    name: Text
    action: Literal["keep", "restore", "drop"]


class Key(Message, tag="key"):
    """A keyframe of the film."""

    action: Literal["add", "replace", "earlier", "later", "remove"]
    at: Count = 0
    camera: Camera | None = None


class Film(Message, tag="film"):
    """The film is to be made."""

    seconds: Annotated[float, Meta(ge=0.1, le=60)] = 2.0
    fps: Annotated[float, Meta(ge=1, le=60)] = 24.0
    side: Annotated[int, Meta(ge=64, le=1920)] = 960


class Picture(Message, tag="picture"):
    """A picture of this view is to be saved."""

    camera: Camera


AnyMessage: TypeAlias = View | Set | Preset | Card | Pick | Region | Map | Keep | Key | Film | Picture
_decoder = msgspec.json.Decoder(AnyMessage)


def read_message(text: str | bytes) -> AnyMessage:
    """The message of a JSON text. Raises DataError unless the page could have sent it."""
    try:
        return _decoder.decode(text)  # type: ignore[no-any-return]  # msgspec is not there where types are checked
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise DataError(f"message: {error}") from error


def cameras_of(cameras: "list[Camera]", size: tuple[int, int] | None = None, longest: int = 640) -> Cameras:
    """Pinhole cameras of one size: `size`, or the shape of the first one's canvas, `longest` pixels at its longer side.

    Each keeps its vertical angle. Raises UsageError for axes that are no rotation.
    """
    if size is None:
        width, height = cameras[0].size
        by = max(_MIN_SIDE, min(longest, _MAX_SIDE)) / max(width, height)
        size = (max(1, round(width * by)), max(1, round(height * by)))
    poses, focal, centre = [], [], []
    for camera in cameras:
        axes = torch.tensor(camera.axes, dtype=torch.float64)
        if not torch.allclose(axes @ axes.T, torch.eye(3).double(), atol=1e-3) or float(torch.linalg.det(axes)) < 0:
            raise UsageError("camera: its axes are no rotation")
        # Rows right, down, forward; a pose has columns right, up, back.
        turn = axes.T * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
        poses.append(torch.cat([turn, torch.tensor(camera.place, dtype=torch.float64)[:, None]], 1))
        by = size[1] / camera.size[1]
        focal.append([camera.lens[0] * by, camera.lens[1] * by])
        offset = [(camera.lens[2 + k] - camera.size[k] / 2) * by for k in (0, 1)]
        centre.append([size[0] / 2 + offset[0], size[1] / 2 + offset[1]])
    made = ideal_cameras(torch.stack(poses), 1.0, size)
    return type(made)(
        made.pose,
        torch.tensor(focal, dtype=torch.float64),
        torch.tensor(centre, dtype=torch.float64),
        made.size,
        made.distortion,
        made.lens,
    )
