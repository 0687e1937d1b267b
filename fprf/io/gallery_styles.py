"""The styles of the gallery: all views in all styles at a glance, then each style with its references, maps and figures."""

from collections.abc import Mapping, Sequence
from html import escape

from .figures import figures
from .gallery_pieces import MAP_SIDE, SMALL_SIDE, VIEW_SIDE, Reference, Style, cards_of, img, ratio
from .images import Picture, to_uint8
from .maps import palette

__all__ = ["overview", "styles_section"]


def overview(view_names: Sequence[str], originals: Sequence[Picture], styles: Sequence[Style]) -> str:
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
    return f"""<section id="overview">
<h2>Overview</h2>
<p class="lead">Every view in every style. Choose one to compare it above.</p>
<div class="scroller" tabindex="0" role="region" aria-label="Every view in every style">
<table class="matrix" style="--pictures:{len(styles) + 1}">
<thead><tr><th scope="col">View</th>{heads}</tr></thead>
<tbody>
{body}
</tbody>
</table></div>
</section>"""


def _cell(picture: Picture, what: str, goes: str) -> str:
    shown = img(picture, SMALL_SIDE, what)
    return f'<td><button type="button" data-go="{goes}" style="--ratio:{ratio(picture)}">{shown}</button></td>'


def styles_section(view_names: Sequence[str], styles: Sequence[Style], known: Mapping[str, Reference]) -> str:
    """Each style with its references and figures beside its views, its match maps below."""
    if not styles:
        return ""
    blocks = "\n".join(_style(index, style, view_names, known) for index, style in enumerate(styles))
    return f"""<section class="styles" id="styles">
<h2>Styles</h2>
<p class="lead">The same trained scene, restyled by photographs. Choose a view to compare it above.</p>
{blocks}
</section>"""


def _style(index: int, style: Style, view_names: Sequence[str], known: Mapping[str, Reference]) -> str:
    cards = "\n".join(
        f'<button class="card" type="button" data-shot="{index}-{view}" style="--ratio:{ratio(picture)}">'
        f"{img(picture, VIEW_SIDE, f'View {name}, {style.name}')}<span>{escape(name)}</span></button>"
        for view, (name, picture) in enumerate(zip(view_names, style.views, strict=True))
    )
    matches = ""
    if style.matches:
        maps = cards_of(style.matches, view_names, "reference of every place", index)
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
        image = img(known[name].image, MAP_SIDE, f"Reference {name}")
        rows.append(f'<figure class="source">{image}<figcaption>{chip}<span>{escape(name)}</span>{share}</figcaption></figure>')
    return f'<div class="sources">{"".join(rows)}</div>' if rows else ""
