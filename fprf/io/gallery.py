"""One page that shows a restyled scene: compare, styles, geometry, flight, figures. A single file without any request."""

import base64
import os
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from string import Template
from urllib.parse import quote

from ..errors import DataError
from .atomic import write_text
from .figures import Metrics, figures, number
from .gallery_compare import compare
from .gallery_pieces import Reference, Style, cards_of
from .gallery_styles import overview, styles_section
from .images import Picture

__all__ = ["Reference", "Style", "write_gallery"]

_EMBEDDED_VIDEO = 8 * 2**20
"""Bytes up to which a film is put into the page."""


def write_gallery(
    path: Path,
    *,
    title: str,
    scene: Mapping[str, str | int | float],
    view_names: Sequence[str],
    originals: Sequence[Picture],
    references: Sequence[Reference],
    styles: Sequence[Style],
    depth: Sequence[Picture] = (),
    metrics: "Metrics | None" = None,
    video: Path | None = None,
) -> None:
    """Write the page to `path` (.html), whole or not at all.

    `scene` holds a few facts by their labels ("Photographs": 34). `originals` are the unstylised renders. A film is
    embedded where it is H.264 of at most 8 MiB, else linked beside the page. Every name is shown as text, whatever it
    holds. Raises DataError where numbers of views differ or a style names an unknown reference.
    """
    _fitting(view_names, originals, references, styles)
    known = {reference.name: reference for reference in references}
    parts = [
        ("", _opening(title, scene)),
        ("Compare", compare(view_names, originals, styles, known)),
        ("Overview", overview(view_names, originals, styles)),
        ("Styles", styles_section(view_names, styles, known)),
        ("Geometry", _geometry(view_names, depth)),
        ("Flight", "" if video is None else _flight(video, path)),
        ("Figures", _figures(metrics or {})),
    ]
    present = [(name, part) for name, part in parts if part]
    here = files(__package__)
    page = Template((here / "gallery.html").read_text("utf-8")).substitute(
        title=escape(title),
        css=(here / "gallery.css").read_text("utf-8"),
        script=(here / "gallery.js").read_text("utf-8"),
        nav="\n".join(f'<a href="#{name.lower()}">{name}</a>' for name, _ in present if name),
        body="\n".join(part for _, part in present),
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


def _opening(title: str, scene: Mapping[str, str | int | float]) -> str:
    facts = "\n".join(f"<div><dt>{escape(name)}</dt><dd>{escape(number(fact))}</dd></div>" for name, fact in scene.items())
    listed = f'\n<dl class="facts">\n{facts}\n</dl>' if facts else ""
    return f'<section class="opening">\n<h1>{escape(title)}</h1>{listed}\n</section>'


def _geometry(view_names: Sequence[str], depth: Sequence[Picture]) -> str:
    if not depth:
        return ""
    return f"""<section id="geometry">
<h2>Geometry</h2>
<p class="lead">Rendered depth: near is bright, far is dark, nothing is grey. All styles share it.</p>
{cards_of(depth, view_names, "depth")}
</section>"""


def _flight(video: Path, page: Path) -> str:
    with video.open("rb") as film:
        data = film.read(_EMBEDDED_VIDEO + 1)
    beside = quote(Path(os.path.relpath(video, page.parent)).as_posix())
    # The codec's box lies at the front of what we write; other codecs do not play in browsers.
    if b"avc1" not in data:
        link = f'<a href="{escape(beside)}">{escape(video.name)}</a>'
        shown = f'<p class="lead">This film needs a player outside of the browser: {link}</p>'
    else:
        small = len(data) <= _EMBEDDED_VIDEO
        source = f"data:video/mp4;base64,{base64.b64encode(data).decode('ascii')}" if small else escape(beside)
        kind = 'controls loop muted playsinline preload="metadata" aria-label="Flight through the scene"'
        shown = f'<video src="{source}" {kind}></video>'
    return f'<section id="flight">\n<h2>Flight</h2>\n<div class="film-box">{shown}</div>\n</section>'


def _figures(metrics: "Metrics") -> str:
    tables = []
    for group, rows in groupby(figures(metrics), key=lambda figure: figure.group):
        body = _cells((row.label, row.value, row.unit) for row in rows)
        tables.append(
            f"<table>\n<caption>{escape(group or 'Quality and cost')}</caption>\n{_HEAD}\n<tbody>\n{body}\n</tbody>\n</table>"
        )
    if not tables:
        return ""
    listed = "\n".join(tables)
    return f'<section id="figures">\n<h2>Figures</h2>\n<div class="figures">\n{listed}\n</div>\n</section>'


_HEAD = (
    '<thead><tr><th scope="col">Figure</th><th scope="col" class="value">Value</th>'
    '<th scope="col" class="unit">Unit</th></tr></thead>'
)


def _cells(rows: Iterable[tuple[str, str, str]]) -> str:
    return "\n".join(
        f'<tr><th scope="row">{escape(label)}</th><td class="value">{escape(value)}</td>'
        f'<td class="unit">{escape(unit)}</td></tr>'
        for label, value, unit in rows
    )
