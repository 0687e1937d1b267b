"""The stage of the gallery: two pictures of a view under a wipe, and what is put there."""

from collections.abc import Mapping, Sequence
from html import escape

from .gallery_pieces import TINY_SIDE, VIEW_SIDE, Reference, Style, img, ratio
from .images import Picture

__all__ = ["compare"]


_LEAST, _MOST = 760, 2.6
"""Width in pixels up to which any view is shown, and how often larger than it is otherwise."""


def compare(
    view_names: Sequence[str], originals: Sequence[Picture], styles: Sequence[Style], known: Mapping[str, Reference]
) -> str:
    """The stage with its choices: what lies left and right of the wipe, and of which view; nothing without styles."""
    if not styles:
        return ""
    first = originals[0]
    most = max(_LEAST, _MOST * min(VIEW_SIDE, first.shape[1]))
    picks = "\n".join(
        f'<button class="pick" type="button" data-style="{index}" aria-pressed="{str(index == 0).lower()}">'
        f"{_stack(style, known)}<span>{escape(style.name)}</span></button>"
        for index, style in enumerate(styles)
    )
    film = "\n".join(
        f'<button type="button" data-view="{index}" aria-pressed="{str(index == 0).lower()}" title="{escape(name)}">'
        f"{img(picture, VIEW_SIDE, f'View {name}, original', eager=True)}</button>"
        for index, (name, picture) in enumerate(zip(view_names, originals, strict=True))
    )
    return f"""<section class="compare" id="compare" aria-label="Compare">
<div class="stage">
<figure class="wipe" style="--at:50%;--ratio:{ratio(first)};--most:{most:.0f}px">
{img(styles[0].views[0], VIEW_SIDE, f"View {view_names[0]}, {styles[0].name}", eager=True, of="after")}
{img(first, VIEW_SIDE, f"View {view_names[0]}, original", eager=True, of="before")}
<span class="tag one">Original</span><span class="tag two">{escape(styles[0].name)}</span>
<input type="range" min="0" max="100" step="any" value="50" aria-label="How much of the original is shown">
<span class="seam"></span>
</figure>
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
{film}
</div></div>
</div>
</section>"""


def _left(styles: Sequence[Style]) -> str:
    """What the restyled view can be compared with."""
    options = [("original", "Original")]
    if any(style.matches for style in styles):
        options.append(("match", "Which reference is where"))
    options += [(str(index), style.name) for index, style in enumerate(styles)] if len(styles) > 1 else []
    return "\n".join(f'<option value="{value}">{escape(name)}</option>' for value, name in options)


def _stack(style: Style, known: Mapping[str, Reference]) -> str:
    small = [img(known[name].image, TINY_SIDE, "", eager=True) for name in style.references[:3]]
    return f'<span class="stack">{"".join(small)}</span>' if small else ""
