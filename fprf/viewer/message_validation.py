"""Which messages a page may send: the few kinds that ours does, with nothing in them but numbers and short texts.

viser takes whatever attribute of a control a client names; a client that names another one than its value could take a
control out of service for all. So every message is looked at before viser sees it.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

from ..errors import DataError

__all__ = ["check_message"]

_TEXT = 4096
"""Characters of a text; names of photographs and controls are shorter."""


def check_message(message: object) -> None:
    """Raise DataError unless the page could have sent this decoded message."""
    if not isinstance(message, dict) or not all(isinstance(key, str) for key in message):
        raise DataError("message: not an object with names")
    kind = message.get("type")
    check = _KINDS.get(kind) if isinstance(kind, str) else None
    if check is None:
        raise DataError(f"message: {str(kind)[:60]!r} is none that this page sends")
    for key, value in message.items():
        _plain(key, value, depth=3)
    check(message)


def _plain(where: str, value: object, depth: int) -> None:
    """Finite numbers, short texts, and short lists or objects of those."""
    if value is None or isinstance(value, bool):
        return
    if isinstance(value, int | float):
        if not math.isfinite(value) or abs(value) > 1e15:
            raise DataError(f"message: {where} is {value}")
        return
    if isinstance(value, str):
        if len(value) > _TEXT:
            raise DataError(f"message: {where} has {len(value)} characters")
        return
    if depth > 0 and isinstance(value, list | tuple | dict) and len(value) <= 64:
        inner = value.values() if isinstance(value, dict) else value
        for each in inner:
            _plain(where, each, depth - 1)
        return
    raise DataError(f"message: {where} is of a kind that this page does not send")


def _camera(message: Mapping[str, Any]) -> None:
    for key, count in (("wxyz", 4), ("position", 3), ("look_at", 3), ("up_direction", 3)):
        value = message.get(key)
        if not isinstance(value, list | tuple) or len(value) != count or not all(_number(x) for x in value):
            raise DataError(f"message: {key} of a camera is {count} numbers")
    for key in ("fov", "near", "far", "image_height", "image_width"):
        if not _number(message.get(key)):
            raise DataError(f"message: {key} of a camera is a number")


def _control(message: Mapping[str, Any]) -> None:
    updates = message.get("updates")
    if not isinstance(message.get("uuid"), str) or not isinstance(updates, dict) or not updates.keys() <= {"value"}:
        raise DataError("message: of a control, its value alone can be changed")


def _pointer(message: Mapping[str, Any]) -> None:
    if message.get("event_type") != "click":
        raise DataError("message: this page knows clicks alone")
    for key, count in (("ray_origin", 3), ("ray_direction", 3)):
        value = message.get(key)
        if not isinstance(value, list | tuple) or len(value) != count or not all(_number(x) for x in value):
            raise DataError(f"message: {key} of a click is {count} numbers")


def _anything(message: Mapping[str, Any]) -> None:
    """Nothing more to check."""


def _number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


_KINDS: Mapping[str, Callable[[Mapping[str, Any]], None]] = {
    "ViewerCameraMessage": _camera,
    "GuiUpdateMessage": _control,
    "ScenePointerMessage": _pointer,
    "GuiSetPanelCollapsedMessage": _anything,
    "GuiFormDirtyMessage": _anything,
}
