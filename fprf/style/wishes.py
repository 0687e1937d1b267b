"""What users write about regions, `REGION`, `REGION=REFERENCE`, `REGION=NUMBER`, as pairs of texts.

A region is named by its number, by its name in a style file, by a pixel of a view (`VIEW:X,Y`) or by a mask over one
(`VIEW:MASK.png`); a reference by its file or by its number, from 0 in the order given. What each text means is found out on
a scene (`training.regions`); here is only the grammar.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ..checks import between
from ..errors import ConfigError, UsageError

__all__ = ["Pixel", "Wish", "find_reference", "labels", "parse_strength", "parse_wish", "pixel_of"]

_PIXEL = re.compile(r"(-?\d+(?:\.\d+)?),(-?\d+(?:\.\d+)?)")


class Wish(NamedTuple):
    """What is wanted of a region."""

    region: str
    value: str


class Pixel(NamedTuple):
    """A place in a view: x to the right, y down, in pixels of the rendered view."""

    x: float
    y: float


def parse_wish(field: str, text: str) -> Wish:
    """`REGION=VALUE`, at the last equals sign. Raises ConfigError naming the field."""
    region, equals, value = text.rpartition("=")
    if not (equals and region and value):
        raise ConfigError(f"{field}: {text!r} is not REGION=VALUE; write for example 3=autumn.jpg or IMG_0012:120,80=0")
    return Wish(region, value)


def parse_strength(field: str, text: str) -> tuple[str, float]:
    """`REGION=STRENGTH` with a strength in [0, 1]. Raises ConfigError."""
    region, value = parse_wish(field, text)
    try:
        strength = float(value)
    except ValueError:
        raise ConfigError(f"{field}: {text!r}: {value!r} is no number; write for example 3=0.5") from None
    between(field, strength, 0.0, 1.0)
    return region, strength


def pixel_of(text: str) -> Pixel | None:
    """`X,Y` as a pixel; None where it is something else, such as the name of a mask."""
    found = _PIXEL.fullmatch(text)
    return Pixel(float(found[1]), float(found[2])) if found else None


def labels(paths: Sequence[Path]) -> tuple[str, ...]:
    """A name for each reference, all different: the file's, with folders before it or a number behind where files agree."""
    for folders in range(3):
        names = ["/".join([*(f.name for f in p.parents[:folders][::-1] if f.name), p.name]) for p in paths]
        if len(set(names)) == len(names):
            return tuple(names)
    plain = [p.name for p in paths]
    return tuple(f"{name} ({plain[:i].count(name) + 1})" if name in plain[:i] else name for i, name in enumerate(plain))


def find_reference(text: str, paths: Sequence[Path]) -> int:
    """Which reference is meant: by label, else path or name, else number from 0, else stem. Raises UsageError."""
    names = labels(paths)
    for matches in (
        [i for i, name in enumerate(names) if text == name],
        [i for i, p in enumerate(paths) if text in (str(p), p.name)],
        [int(text)] if text.isascii() and text.isdigit() and int(text) < len(paths) else [],
        [i for i, p in enumerate(paths) if text == p.stem],
    ):
        if len(matches) == 1:
            return matches[0]
        if matches:
            raise UsageError(f"reference {text!r}: {len(matches)} references are called so; use the number, from 0")
    given = ", ".join(f"{i} {name}" for i, name in enumerate(names))
    raise UsageError(f"reference {text!r}: no such reference; there are {given}")
