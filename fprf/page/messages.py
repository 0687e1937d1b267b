"""The messages that a page may send: small JSON objects of few kinds, with bounded numbers and short texts.

Those of an open scene come by its WebSocket, those of the start page as bodies of requests.
"""

from typing import Annotated, Any, Literal, TypeAlias

import msgspec
from msgspec import Meta, Struct

from ..errors import DataError
from ..light.config import LightName

SHELF = 12
"""Photographs on the shelf; the oldest that no look needs makes room."""
READ_SHARE = 0.12
"""Of the time in which a scene is opened, what has passed when its file is read (a capture of a million Gaussians)."""
SEARCHED_SHARE = 0.44
"""Of the same, when it is known where to look at it from; the rest prepares it for browsers."""
READ_SHARE = 0.12
"""Of the time in which a scene is opened, what has passed when its file is read (a capture of a million Gaussians)."""
SEARCHED_SHARE = 0.44
"""Of the same, when it is known where to look at it from; the rest prepares it for browsers."""

Text: TypeAlias = Annotated[str, Meta(max_length=80)]
Number: TypeAlias = Annotated[float, Meta(ge=-1e9, le=1e9)]  # NaN fails either bound
Share: TypeAlias = Annotated[float, Meta(ge=0, le=1)]
Count: TypeAlias = Annotated[int, Meta(ge=0, le=10**9)]
Vector: TypeAlias = tuple[Number, Number, Number]
Side: TypeAlias = Annotated[float, Meta(ge=1, le=8192)]
Positive: TypeAlias = Annotated[float, Meta(gt=0, le=1e6)]

Slider: TypeAlias = Literal[
    "strength", "bold", "luminance", "clusters", "blend", "stylizer.temperature", "stylizer.smoothness"
]
"""Fields of `StyleConfig` that the page shows, where its stylizer has them."""


class Camera(Struct, forbid_unknown_fields=True, frozen=True):
    """Camera of a client, in the scene's coordinates."""

    place: Vector
    axes: tuple[Vector, Vector, Vector]
    """Right, down and forward."""
    lens: tuple[Positive, Positive, Number, Number]
    """fx, fy, cx, cy in pixels of its canvas."""
    size: tuple[Side, Side]


class Message(Struct, tag=True, forbid_unknown_fields=True):
    """A message."""


class ViewRequest(Message, tag="view"):
    """A camera has moved, of a scene that is drawn here; with `captured` the scene as captured is shown
    beside the look.
    """

    camera: Camera
    captured: bool = False


class Set(Message, tag="set"):
    """A control of the look was moved."""

    name: Slider
    value: Number


class Sun(Message, tag="sun"):
    """The light of the look was changed; neither `light` nor `sun` = the captured one."""

    light: LightName | None = None
    sun: tuple[Annotated[float, Meta(ge=-360, le=360)], Annotated[float, Meta(ge=0.5, le=90)]] | None = None
    """Azimuth, as `SunConfig` counts it from north, and elevation in degrees."""
    strength: Share = 1.0
    moving: bool = False
    """It is being dragged: it may be shown coarsely."""


class Preset(Message, tag="preset"):
    """A preset was chosen."""

    name: Literal["gentle"]


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
    """Rule of the picked region; `close` picks none."""

    action: Literal["pin", "forbid", "keep", "free", "close"]
    card: Count | None = None


class Map(Message, tag="map"):
    """Map in the place of colours."""

    map: Literal["none", "matches", "regions"]


class Keep(Message, tag="keep"):
    """A look is kept under a name, or taken up again."""

    name: Text
    action: Literal["keep", "restore", "remove"]
    replace: bool = False
    """Take the place of another look that has this name."""


class Undo(Message, tag="undo"):
    """Undo what was made last, or do it again."""

    again: bool = False


class Key(Message, tag="key"):
    """A keyframe of the film."""

    action: Literal["add", "earlier", "remove"]
    at: Count = 0
    camera: Camera | None = None
    shown: Text = "Now"
    """Name of the look that the client sees: what is kept is what is shown."""


class Film(Message, tag="film"):
    """The film is to be made."""

    seconds: Annotated[float, Meta(ge=0.1, le=60)] = 2.0
    """From each key to the next."""
    side: Annotated[int, Meta(ge=16, le=3840)] = 960
    """Longest side in pixels."""
    fps: Annotated[float, Meta(ge=1, le=60)] = 24.0
    """Frames a second."""


class PictureRequest(Message, tag="picture"):
    """A picture of a scene that is drawn here, to be saved."""

    camera: Camera
    side: Annotated[int, Meta(ge=64, le=4096)]
    """Longest side in pixels."""
    shown: Text = "Now"
    wipe: Annotated[float, Meta(ge=-1, le=1)] = -1.0
    """Share of the width, from the left, that is shown as captured; below 0 none."""


Change: TypeAlias = Set | Sun | Preset | Card | Region | Map | Keep | Key
"""Messages that change what all clients see."""
AnyMessage: TypeAlias = ViewRequest | Pick | Film | Undo | Change

Minutes: TypeAlias = Annotated[float, Meta(ge=0.05, le=600)]


class New(Message, tag="new"):
    """Files of a new scene are coming, under a name like this one."""

    name: Annotated[str, Meta(max_length=1000)] = ""


class Discard(Message, tag="discard"):
    """The files that came for a scene are not wanted after all."""

    scene: Text


class Rename(Message, tag="rename"):
    """A scene of the list gets another name."""

    scene: Text
    name: Annotated[str, Meta(min_length=1, max_length=80)]


class Remove(Message, tag="remove"):
    """A scene of the list is deleted, with all that was made of it."""

    scene: Text


class Make(Message, tag="make"):
    """A scene is to be made of the files that came."""

    scene: Text
    minutes: Minutes = 2.0


class Open(Message, tag="open"):
    """A file or folder of this machine is to be opened, or to become a scene."""

    path: Annotated[str, Meta(max_length=4096)]
    minutes: Minutes = 2.0


class Stop(Message, tag="stop"):
    """End what is being made; a scene that was trained so far is kept and shown."""


class Leave(Message, tag="leave"):
    """The scene that is shown, or made, is to be closed."""


StartRequest: TypeAlias = New | Discard | Make | Open | Rename | Remove | Stop | Leave
_KINDS: tuple[Any, ...] = (AnyMessage, StartRequest, PictureRequest)
_decoders: dict[Any, Any] = {kinds: msgspec.json.Decoder(kinds) for kinds in _KINDS}


def read_message(text: str | bytes, kinds: Any = AnyMessage) -> Any:
    """The message of a JSON text, of one of the `kinds`. Raises DataError unless the page could have sent
    it.
    """
    try:
        return _decoders[kinds].decode(text)
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise DataError(f"message: {error}") from error
