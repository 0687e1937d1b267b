"""Styles along a camera path: `keys.json` says which frame has which style; between two of them one fades into the other.

    {"format": 1, "keyframes": [{"frame": 0, "style": "day/style.json"}, {"frame": 48, "style": null}]}

Paths are relative to the file, or absolute; null is the scene as it is. The fade is a smoothstep, so it starts and ends
without a jerk; before the first key and after the last, their styles hold.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ..errors import ConfigError
from ..plugins.codec import from_json, read_json

if TYPE_CHECKING:
    from ..interfaces import Scene
    from .look import Restyle

_FORMAT = 1


class Key(NamedTuple):
    """A frame, from 0, and its style file; None = the scene as it is."""

    frame: int
    style: Path | None


def read_keyframes(path: Path) -> tuple[Key, ...]:
    """The keys of a file, by frame. Raises ConfigError naming the file and the key."""
    whole = read_json(path, 'a keyframe file: {"format": 1, "keyframes": [{"frame": 0, "style": "style.json"}]}')
    try:
        if not isinstance(whole, dict) or whole.keys() != {"format", "keyframes"} or whole["format"] != _FORMAT:
            raise ConfigError(f'expected an object with "format": {_FORMAT} and "keyframes", and nothing else')
        rows = from_json(whole["keyframes"], list[dict[str, int | str | None]])
        keys = [_key(path, number, row) for number, row in enumerate(rows)]
        frames = [key.frame for key in keys]
        if not keys or len(set(frames)) < len(frames):
            raise ConfigError("keyframes: at least one is needed, and no two at one frame")
    except ConfigError as fault:
        raise ConfigError(f"{path}: {fault}") from fault
    return tuple(sorted(keys, key=lambda key: key.frame))


def fade(frames: Sequence[int], at: int) -> tuple[int, int, float]:
    """The keys before and after a frame, as places in `frames` (sorted), and how far it is from one to the other, in [0, 1]."""
    after = next((i for i, frame in enumerate(frames) if frame > at), len(frames))
    if after == 0 or after == len(frames):
        only = min(after, len(frames) - 1)
        return only, only, 0.0
    way = (at - frames[after - 1]) / (frames[after] - frames[after - 1])
    return after - 1, after, way * way * (3 - 2 * way)


def keyed_looks(scene: "Scene", keys: Sequence[Key]) -> "Callable[[int], Restyle | None]":
    """The look of each frame; every style is built once, before the first frame."""
    from .files import check_photographs, read_style
    from .restyle import apply_style

    encoders = scene.encoders()
    looks: dict[Path | None, Restyle | None] = {None: None}
    for key in keys:
        if key.style is not None and key.style not in looks:
            file = read_style(key.style)
            check_photographs(key.style, file)
            styled = apply_style(scene, file, encoders, (key.style.resolve(),))
            looks[key.style] = styled.restyle
            for note in styled.controls.notes:
                print(f"{key.style}: {note}")
    frames = [key.frame for key in keys]

    def look(at: int) -> "Restyle | None":
        before, after, way = fade(frames, at)
        first, second = looks[keys[before].style], looks[keys[after].style]
        if way == 0:
            return first
        if first is None:
            return None if second is None else second.faded.mixed(second, way)
        return first.mixed(first.faded if second is None else second, way)

    return look


def _key(path: Path, number: int, row: dict[str, int | str | None]) -> Key:
    frame, style = row.get("frame"), row.get("style")
    if row.keys() != {"frame", "style"} or not isinstance(frame, int) or frame < 0 or isinstance(style, int):
        raise ConfigError(f'keyframes.{number}: expected {{"frame": a number from 0, "style": a file or null}}')
    return Key(frame, None if style is None else path.parent / style)
