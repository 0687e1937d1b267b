"""The light of a style, with the sun of its references where it asks for that (`--sun auto`)."""

import functools
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from ..datamanagers.images import load_cutout, load_mask
from ..errors import UsageError
from ..light.config import SunConfig
from ..light.seen import SHARP_DEGREES, SeenSun, facing_strength, seen_sun
from ..light.sky import elevation_of_warmth, light_of
from .config import NO_MASK, StyleConfig, labels


class KnownLight(NamedTuple):
    """The light of a style."""

    config: SunConfig | None
    """None = the captured one."""
    note: str
    """One line about the sun of the references; empty where they were not asked."""


def light_of_style(style: StyleConfig) -> KnownLight:
    """The light of a style; that of `sun` auto is of the reference that tells most.

    Raises UsageError where there are no references to ask, DataError for unreadable ones.
    """
    if not style.lit:
        return KnownLight(None, "")
    values = {}
    for field in fields(SunConfig):
        values[field.name] = getattr(style, field.name)
    config = SunConfig(**values)
    if config.sun != "auto":
        return KnownLight(config, "")
    if not style.references:
        raise UsageError(
            "--sun auto: takes the sun from references; name at least one, for example --references noon.jpg"
        )
    surest: SeenSun | None = None
    shown_by = ""
    for path, mask, name in zip(style.references, _masks(style), labels(style.references), strict=True):
        sun = _seen_sun(path, mask, path.stat().st_mtime_ns)
        if sun is not None and (surest is None or sun.score > surest.score):
            surest = sun
            shown_by = name
    if surest is not None:
        return _with_sun(config, surest, shown_by)
    left = replace(config, sun=None)
    nothing = "sun of the references: they show too little lit and shaded of one kind, so the light"
    if left.light_asked:
        return KnownLight(left, f"{nothing} is as without --sun auto")
    return KnownLight(None, f"{nothing} stays as captured")


def _with_sun(config: SunConfig, sun: SeenSun, name: str) -> KnownLight:
    """A light with a sun that a reference shows; what the flags say of it stays."""
    elevation = config.sun_elevation
    if elevation is None and config.light is None:
        elevation = elevation_of_warmth(sun.strength[0] / sun.strength[2])
    config = replace(config, sun_elevation=elevation)
    degrees = light_of(config).elevation
    over = config.sun_over_sky or facing_strength(sun, degrees)
    size = config.sun_size
    if size == SHARP_DEGREES:
        size = sun.degrees
    times = ", ".join(f"{each:.1f}" for each in sun.strength)
    note = (
        f"sun of the references: {times} times the light of the sky in red, green, blue; shadows as of a sun of "
        f"{sun.degrees:.1f} degrees, {degrees:.0f} degrees high ({name})"
    )
    return KnownLight(replace(config, sun_over_sky=over, sun_size=size), note)


def _masks(style: StyleConfig) -> Sequence[Path]:
    return style.masks or [NO_MASK] * len(style.references)


@functools.lru_cache(maxsize=256)
def _seen_sun(path: Path, mask: Path, changed: int) -> SeenSun | None:
    """The sun of a photograph within a mask; `changed` is when its file was written."""
    photo = load_cutout(path)
    shown = photo.opaque
    if mask != NO_MASK:
        white = load_mask(mask, upright=True).astype(np.uint8)
        size = (photo.pixels.shape[1], photo.pixels.shape[0])
        within = np.asarray(cv2.resize(white, size, interpolation=cv2.INTER_NEAREST)) > 0
        shown = within if shown is None else shown & within
    return seen_sun(photo.pixels, shown)
