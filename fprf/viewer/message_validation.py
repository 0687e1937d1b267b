"""The WebSocket messages that a page may send to viser: few kinds, with finite numbers and short texts.

viser sets whichever attribute of a control a client names; naming another one than its value could break that control for
all clients. So every message is checked before viser receives it.
"""

from typing import Annotated, Literal, TypeAlias

import msgspec
from msgspec import Meta, Struct

from ..errors import DataError

Text: TypeAlias = Annotated[str, Meta(max_length=4096)]
Number: TypeAlias = Annotated[float, Meta(ge=-1e15, le=1e15)]  # NaN fails either bound
Vector: TypeAlias = tuple[Number, Number, Number]


class ViewerCameraMessage(Struct, tag=True):
    """A client's camera has moved."""

    wxyz: tuple[Number, Number, Number, Number]
    position: Vector
    look_at: Vector
    up_direction: Vector
    fov: Number
    near: Number
    far: Number
    image_height: Number
    image_width: Number


class ControlValue(Struct, forbid_unknown_fields=True):
    """The only attribute of a control that clients may set."""

    value: bool | Number | Text | None


class GuiUpdateMessage(Struct, tag=True):
    """A control was moved or pressed."""

    uuid: Text
    updates: ControlValue


class ScenePointerMessage(Struct, tag=True):
    """A click on the scene."""

    event_type: Literal["click"]
    ray_origin: Vector
    ray_direction: Vector
    screen_pos: Annotated[tuple[tuple[Number, Number], ...], Meta(max_length=64)]
    modifier: Text | None = None


class GuiSetPanelCollapsedMessage(Struct, tag=True):
    """A panel was folded; nothing of it is used."""


class GuiFormDirtyMessage(Struct, tag=True):
    """A form was edited; nothing of it is used."""


_decoder = msgspec.msgpack.Decoder(
    ViewerCameraMessage | GuiUpdateMessage | ScenePointerMessage | GuiSetPanelCollapsedMessage | GuiFormDirtyMessage
)


def check_message(payload: bytes) -> None:
    """Raise DataError unless the page could have sent this MessagePack message."""
    try:
        _decoder.decode(payload)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise DataError(f"message: {error}") from error
