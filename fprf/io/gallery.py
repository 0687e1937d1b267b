"""One page that shows a restyled scene: compare, styles, geometry, flight, figures. A single file without any request."""

import base64
import os
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from string import Template
from types import MappingProxyType
from typing import NamedTuple
from urllib.parse import quote

from ..errors import DataError
from .atomic import write_text
from .figures import Metrics, figures, number
from .images import Picture, data_uri, shrink, to_uint8
from .maps import palette

_VIEW_SIDE, _MAP_SIDE, _SMALL_SIDE, _TINY_SIDE = 1024, 512, 224, 80
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
    """Share of the scene that each of them styled (`maps.match_summary`); none where that was not measured."""
    matches: Sequence[Picture] = ()
    """Match maps (`maps.match_image`), one per view or fewer."""
    metrics: Metrics = MappingProxyType({})
    """Figures of this style alone."""


def _img(picture: Picture, side: int, alt: str, *, eager: bool = False, of: str = "") -> str:
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


def _ratio(picture: Picture) -> str:
    """Width by height, for the style sheet."""
    return f"{picture.shape[1] / picture.shape[0]:.5f}"


def _cards(pictures: Sequence[Picture], view_names: Sequence[str], what: str, style: int | None = None) -> str:
    """Small pictures of views with their names; the script finds match maps by their style."""
    cards = "\n".join(
        f'<figure class="card" data-match="{"" if style is None else style}-{view}" style="--ratio:{_ratio(picture)}">'
        f"{_img(picture, _MAP_SIDE, f'View {name}, {what}')}<figcaption>{escape(name)}</figcaption></figure>"
        for view, (name, picture) in enumerate(zip(view_names, pictures, strict=False))
    )
    return f'<div class="grid small">\n{cards}\n</div>'


def _section(title: str, body: str, lead: str = "", *, of: str = "") -> str:
    """A part of the page that its navigation names; `of` is its class."""
    kind = f' class="{of}"' if of else ""
    told = f'<p class="lead">{lead}</p>\n' if lead else ""
    return f'<section{kind} id="{title.lower()}">\n<h2>{title}</h2>\n{told}{body}\n</section>'


_LEAST, _MOST = 760, 2.6
"""Width in pixels up to which any view is shown, and how often larger than it is otherwise."""


def _compare(
    view_names: Sequence[str],
    originals: Sequence[Picture],
    styles: Sequence[Style],
    known: Mapping[str, Reference],
    film: str = "",
) -> str:
    """The stage with its choices: what lies left and right of the wipe, and of which view; nothing without styles.

    A film stands beside the wipe.
    """
    if not styles:
        return ""
    first = originals[0]
    most = max(_LEAST, _MOST * min(_VIEW_SIDE, first.shape[1]))
    picks = "\n".join(
        f'<button class="pick" type="button" data-style="{index}" aria-pressed="{str(index == 0).lower()}">'
        f"{_stack(style, known)}<span>{escape(style.name)}</span></button>"
        for index, style in enumerate(styles)
    )
    strip = "\n".join(
        f'<button type="button" data-view="{index}" aria-pressed="{str(index == 0).lower()}" title="{escape(name)}">'
        f"{_img(picture, _VIEW_SIDE, f'View {name}, original', eager=True)}</button>"
        for index, (name, picture) in enumerate(zip(view_names, originals, strict=True))
    )
    beside = film and f'\n<figure class="beside" style="--ratio:{_ratio(first)}">{film}</figure>'
    return f"""<section class="compare" id="compare" aria-label="Compare">
<div class="stage">
<figure class="wipe" style="--at:50%;--ratio:{_ratio(first)};--most:{most:.0f}px">
{_img(styles[0].views[0], _VIEW_SIDE, f"View {view_names[0]}, {styles[0].name}", eager=True, of="after")}
{_img(first, _VIEW_SIDE, f"View {view_names[0]}, original", eager=True, of="before")}
<span class="tag one">Original</span><span class="tag two">{escape(styles[0].name)}</span>
<input type="range" min="0" max="100" step="any" value="50" aria-label="How much of the original is shown">
<span class="seam"></span>
</figure>{beside}
</div>
<div class="choose">
<div class="against"><label for="left">Left side</label>
<select id="left">
{_left(styles)}
</select></div>
<div><h2 id="pick-style">Right side</h2>
<div class="picks" role="group" aria-labelledby="pick-style">
{picks}
</div></div>
<div><h2 id="pick-view">View</h2>
<div class="film" role="group" aria-labelledby="pick-view">
{strip}
</div></div>
</div>
</section>"""


def _left(styles: Sequence[Style]) -> str:
    """Pictures that the restyled view can be compared with."""
    options = [("original", "Original")]
    if any(style.matches for style in styles):
        options.append(("match", "Which reference is where"))
    options += [(str(index), style.name) for index, style in enumerate(styles)] if len(styles) > 1 else []
    return "\n".join(f'<option value="{value}">{escape(name)}</option>' for value, name in options)


def _stack(style: Style, known: Mapping[str, Reference]) -> str:
    small = [_img(known[name].image, _TINY_SIDE, "", eager=True) for name in style.references[:3]]
    return f'<span class="stack">{"".join(small)}</span>' if small else ""


def _overview(view_names: Sequence[str], originals: Sequence[Picture], styles: Sequence[Style]) -> str:
    """A table of thumbnails, views by styles; each goes to the stage. Nothing where it would repeat what is seen anyway."""
    if len(styles) < 2 or len(view_names) < 2:
        return ""
    heads = "".join(f'<th scope="col">{escape(name)}</th>' for name in ("Original", *(style.name for style in styles)))
    rows = []
    for view, (name, original) in enumerate(zip(view_names, originals, strict=True)):
        cells = [_cell(original, f"View {name}, original", f"-{view}")]
        cells += [
            _cell(style.views[view], f"View {name}, {style.name}", f"{index}-{view}") for index, style in enumerate(styles)
        ]
        rows.append(f'<tr><th scope="row">{escape(name)}</th>{"".join(cells)}</tr>')
    body = "\n".join(rows)
    table = f"""<div class="scroller" tabindex="0" role="region" aria-label="Every view in every style">
<table class="matrix" style="--pictures:{len(styles) + 1}">
<thead><tr><th scope="col">View</th>{heads}</tr></thead>
<tbody>
{body}
</tbody>
</table></div>"""
    return _section("Overview", table, "Every view in every style. Choose one to compare it above.")


def _cell(picture: Picture, what: str, goes: str) -> str:
    shown = _img(picture, _SMALL_SIDE, what)
    return f'<td><button type="button" data-go="{goes}" style="--ratio:{_ratio(picture)}">{shown}</button></td>'


def _style(index: int, style: Style, view_names: Sequence[str], known: Mapping[str, Reference]) -> str:
    """A style with its references and figures beside its views, its match maps below."""
    cards = "\n".join(
        f'<button class="card" type="button" data-shot="{index}-{view}" style="--ratio:{_ratio(picture)}">'
        f"{_img(picture, _VIEW_SIDE, f'View {name}, {style.name}')}<span>{escape(name)}</span></button>"
        for view, (name, picture) in enumerate(zip(view_names, style.views, strict=True))
    )
    matches = ""
    if style.matches:
        maps = _cards(style.matches, view_names, "reference of every place", index)
        matches = f'\n<div class="under"><p class="label">Which reference each place took its style from</p>\n{maps}\n</div>'
    return f"""<article class="style">
<div><h3>{escape(style.name)}</h3>
{_sources(style, known)}{_measured(style)}</div>
<div><div class="grid">
{cards}
</div>{matches}</div>
</article>"""


def _measured(style: Style) -> str:
    rows = "".join(
        f"<div><dt>{escape(row.label)}</dt><dd>{escape(row.value)} <small>{escape(row.unit)}</small></dd></div>"
        for row in figures(style.metrics)
    )
    return f'<dl class="measured">{rows}</dl>' if rows else ""


def _sources(style: Style, known: Mapping[str, Reference]) -> str:
    """The references of a style: with the colours of its match maps and with shares, where there are any."""
    rows = []
    colours = to_uint8(palette(len(style.references))[None])[0] if style.references else []
    for place, name in enumerate(style.references):
        chip = f'<i class="chip" style="background:rgb({",".join(map(str, colours[place]))})"></i>' if style.matches else ""
        share = f'<data value="{style.shares[place]:.4f}">{style.shares[place]:.0%}</data>' if style.shares else ""
        image = _img(known[name].image, _MAP_SIDE, f"Reference {name}")
        rows.append(f'<figure class="source">{image}<figcaption>{chip}<span>{escape(name)}</span>{share}</figcaption></figure>')
    return f'<div class="sources">{"".join(rows)}</div>' if rows else ""


_EMBEDDED_VIDEO = 8 * 2**20
"""Bytes up to which a film is put into the page."""


def write_gallery(
    path: Path,
    *,
    title: str,
    lead: str = "",
    scene: Mapping[str, str | int | float],
    view_names: Sequence[str],
    originals: Sequence[Picture],
    references: Sequence[Reference],
    styles: Sequence[Style],
    depth: Sequence[Picture] = (),
    metrics: "Metrics | None" = None,
    video: Path | None = None,
    credits: Sequence[str] = (),
) -> None:
    """Write the page to `path` (.html), whole or not at all.

    `scene` holds a few facts by their labels ("Photographs": 34). `originals` are the unstylised renders. A film is
    embedded where it is H.264 or WebP of at most 8 MiB, else linked beside the page. Where views are higher than wide it
    stands beside the comparison. Every name, `lead` and every line of `credits` are shown as text, whatever they hold.
    Raises DataError where numbers of views differ or a style names an unknown reference.
    """
    _fitting(view_names, originals, references, styles)
    known = {reference.name: reference for reference in references}
    film = "" if video is None else _film(video, path)
    upright = originals[0].shape[0] > originals[0].shape[1]
    beside = film if upright and styles else ""
    blocks = "\n".join(_style(index, style, view_names, known) for index, style in enumerate(styles))
    told = "The same trained scene, restyled by photographs. Choose a view to compare it above."
    near = "Rendered depth: near is bright, far is dark, nothing is grey. All styles share it."
    parts = [
        ("", _opening(title, lead, scene)),
        ("Compare", _compare(view_names, originals, styles, known, beside)),
        ("Flight", _section("Flight", f'<div class="film-box">{film}</div>') if film and not beside else ""),
        ("Overview", _overview(view_names, originals, styles)),
        ("Styles", _section("Styles", blocks, told, of="styles") if styles else ""),
        ("Geometry", _section("Geometry", _cards(depth, view_names, "depth"), near) if depth else ""),
        ("Figures", _figures(metrics or {})),
    ]
    present = [(name, part) for name, part in parts if part]
    here = files(__package__)
    page = Template((here / "gallery.html").read_text("utf-8")).substitute(
        title=escape(title),
        shape="upright" if upright else "",
        css=(here / "gallery.css").read_text("utf-8"),
        script=(here / "gallery.js").read_text("utf-8"),
        nav="\n".join(f'<a href="#{name.lower()}">{name}</a>' for name, _ in present if name),
        body="\n".join(part for _, part in present),
        credits="\n".join(f"<p>{escape(line)}</p>" for line in credits),
    )
    write_text(path, page)


def _fitting(
    view_names: Sequence[str], originals: Sequence[Picture], references: Sequence[Reference], styles: Sequence[Style]
) -> None:
    if len(view_names) != len(originals) or not originals:
        raise DataError(f"gallery: {len(originals)} originals and {len(view_names)} view names; at least one, as many of each")
    known = {reference.name for reference in references}
    for style in styles:
        if len(style.views) != len(originals):
            raise DataError(f"gallery: style {style.name} has {len(style.views)} views, there are {len(originals)} originals")
        for name in style.references:
            if name not in known:
                raise DataError(f"gallery: style {style.name} names reference {name}; known are {', '.join(sorted(known))}")
        if style.shares and len(style.shares) != len(style.references):
            raise DataError(f"gallery: style {style.name} has {len(style.shares)} shares of {len(style.references)} references")


def _opening(title: str, lead: str, scene: Mapping[str, str | int | float]) -> str:
    facts = "\n".join(f"<div><dt>{escape(name)}</dt><dd>{escape(number(fact))}</dd></div>" for name, fact in scene.items())
    listed = f'\n<dl class="facts">\n{facts}\n</dl>' if facts else ""
    told = f'\n<p class="lead">{escape(lead)}</p>' if lead else ""
    return f'<section class="opening">\n<h1>{escape(title)}</h1>{told}{listed}\n</section>'


def _film(video: Path, page: Path) -> str:
    with video.open("rb") as film:
        data = film.read(_EMBEDDED_VIDEO + 1)
    small = len(data) <= _EMBEDDED_VIDEO
    beside = quote(Path(os.path.relpath(video, page.parent)).as_posix())
    # The codec's box lies at the front of what we write; other codecs do not play in browsers.
    animated, plays = video.suffix.lower() == ".webp", b"avc1" in data
    media = "image/webp" if animated else "video/mp4"
    source = f"data:{media};base64,{base64.b64encode(data).decode('ascii')}" if small else escape(beside)
    if animated and small:
        return f'<img class="flight" src="{source}" alt="Flight through the scene" decoding="async">'
    if not plays:
        link = f'<a href="{escape(beside)}">{escape(video.name)}</a>'
        return f'<p class="lead">This film needs a player outside of the browser: {link}</p>'
    kind = 'controls loop muted playsinline preload="metadata" aria-label="Flight through the scene"'
    return f'<video class="flight" src="{source}" {kind}></video>'


def _figures(metrics: Metrics) -> str:
    tables = []
    heads = '<th scope="col">Figure</th><th scope="col" class="value">Value</th><th scope="col" class="unit">Unit</th>'
    for group, rows in groupby(figures(metrics), key=lambda figure: figure.group):
        body = "\n".join(
            f'<tr><th scope="row">{escape(row.label)}</th><td class="value">{escape(row.value)}</td>'
            f'<td class="unit">{escape(row.unit)}</td></tr>'
            for row in rows
        )
        tables.append(f"""<table>
<caption>{escape(group or "Quality and cost")}</caption>
<thead><tr>{heads}</tr></thead>
<tbody>
{body}
</tbody>
</table>""")
    listed = "\n".join(tables)
    return _section("Figures", f'<div class="figures">\n{listed}\n</div>') if tables else ""
