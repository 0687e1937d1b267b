"""What every part of the gallery is made of: pictures as data, styles and their references."""

from collections.abc import Sequence
from html import escape
from types import MappingProxyType
from typing import NamedTuple

from .figures import Metrics
from .images import Picture, data_uri, shrink

__all__ = ["MAP_SIDE", "SMALL_SIDE", "TINY_SIDE", "VIEW_SIDE", "Reference", "Style", "cards_of", "img", "ratio"]

VIEW_SIDE, MAP_SIDE, SMALL_SIDE, TINY_SIDE = 1024, 512, 224, 80
"""Longest sides in pixels of embedded views, of maps and references, of the overview, and of thumbnails."""


class Reference(NamedTuple):
    """A photograph that a style was taken from."""

    name: str
    image: Picture


class Style(NamedTuple):
    """A restyled scene: one picture per view, in the order of the originals."""

    name: str
    views: Sequence[Picture]
    references: Sequence[str] = ()
    """Names of its references, in dictionary order."""
    shares: Sequence[float] = ()
    """How much of the scene each of them styled (`maps.match_summary`); none where that was not measured."""
    matches: Sequence[Picture] = ()
    """Match maps (`maps.match_image`), one per view or fewer."""
    metrics: "Metrics" = MappingProxyType({})
    """What was measured of this style alone."""


def img(picture: Picture, side: int, alt: str, *, eager: bool = False, of: str = "") -> str:
    """A picture as part of the page, its longest side at most `side` pixels; `of` is its class."""
    small = shrink(picture, side)
    height, width = small.shape[:2]
    lazy = "" if eager else ' loading="lazy"'
    kind = f' class="{of}"' if of else ""
    # width and height hold the place while the picture is decoded; data-* survive CSS for the script.
    return (
        f'<img{kind} src="{data_uri(small)}" alt="{escape(alt)}" width="{width}" height="{height}" '
        f'data-width="{width}" data-height="{height}" decoding="async"{lazy}>'
    )


def ratio(picture: Picture) -> str:
    """Width by height, for the style sheet."""
    return f"{picture.shape[1] / picture.shape[0]:.5f}"


def cards_of(pictures: Sequence[Picture], view_names: Sequence[str], what: str, style: int | None = None) -> str:
    """Small pictures of views with their names; the script finds match maps by their style."""
    cards = "\n".join(
        f'<figure class="card" data-match="{"" if style is None else style}-{view}" style="--ratio:{ratio(picture)}">'
        f"{img(picture, MAP_SIDE, f'View {name}, {what}')}<figcaption>{escape(name)}</figcaption></figure>"
        for view, (name, picture) in enumerate(zip(view_names, pictures, strict=False))
    )
    return f'<div class="grid small">\n{cards}\n</div>'
