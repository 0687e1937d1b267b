"""The page of the restyle benchmark, from its document alone."""

from collections.abc import Mapping
from typing import Any

from .provenance import words
from .table import Column, markdown

__all__ = ["COLUMNS", "restyle_page"]

COLUMNS: tuple[Column, ...] = (
    ("psnr", "PSNR dB", ".2f"),
    ("ssim", "SSIM", ".3f"),
    ("delta_e", "ΔE2000", ".1f"),
    ("match", "match", ".1%"),
    ("match_inside", "match inside", ".1%"),
    ("match_kind", "match kind", ".1%"),
    ("consistency", "consistency", ".3f"),
    ("style_seconds", "style s", ".2f"),
    ("view_seconds", "view s", ".3f"),
)
_GOALS = {
    "over_no_change_db": ("PSNR over no change", "dB", "≥"),
    "over_best_global_db": ("PSNR over the best of reinhard, histogram and adain", "dB", "≥"),
    "over_2d_db": ("PSNR over itself on single pictures (2d)", "dB", "≥"),
    "match_inside": ("match inside", "", "≥"),
    "consistency": ("consistency", "", "≤"),
}
_ABOUT = """# Restyling with a true answer

Nobody knows what a photographed scene would look like at night. Of the embedded town we know: a palette changes colours and
light and nothing else. A scene is trained on one town in one palette; references are pictures of *other* towns in another
palette; the truth is the scene's own town rendered in that palette from the same, held-out cameras.

`one` reference is a view along a street. `three` are pictures of three towns: one shows mostly façades, one mostly plants, one
the street and its sky.

- **PSNR, SSIM, ΔE2000** against the truth. The scene as it is, against its own palette, is the line *reconstruction*: a style
  cannot be sharper than the render that it changes.
- **match**: pixels that take most of a style code of their own true class (12 classes; a code's class is that of most pixels
  that it was made of). **match inside**: the same without pixels at the border of two classes. **match kind**: of their own
  kind (sky, plants, ground, buildings, lamps, cars).
- **consistency**: what a method adds to the error between frames of a path, warped by true depth, plus the sharpness that it
  loses; 0 = as steady and sharp as the unstylised render (`fprf/evaluation/steadiness.py`).
- **style s**: to make the style of the references, once. **view s**: to colour a view whose geometry is there (for `reinhard`,
  `histogram` and `2d`: a rendered picture).
- **LPIPS** is not given (null in the JSON): its weights do not ship with the package, and no dependency brings them.
- **2d** is the recommended stylizer on each picture alone, with the picture's own statistics and regions.
- **true classes** is no method: it knows the classes, and carries the colours of each to those of the same class in the
  references, as a perfect match would.
- **best class maps** is none either: it knows the truth, and gives every true class the affine map of colours that comes
  nearest to it. What it misses is light: shadows, lit windows and the lamps' cones lie where the town's geometry puts them,
  another town's picture cannot tell where, and no map of colours makes them.
"""
_USE = """## Use it for another system

`fprf bench restyle RUN --output restyle.json --page restyle.md --sheet restyle.jpg` makes all of this again. The town in any
palette comes from the parser (`--datamanager.parser town --datamanager.parser.palette night` when a scene is trained) or from
`fprf.town.write.write_town`. Another system's frames of the same cameras are scored by `fprf bench peer`
([protocol.md](protocol.md)).
"""


def restyle_page(document: Mapping[str, Any], *, picture: str | None = None) -> str:
    """Markdown; `picture` is the sheet's path as the page should name it."""
    settings, parts = document["settings"], [_ABOUT]
    lights = ", ".join(document["palettes"])
    size = "x".join(str(side) for side in settings["view_size"])
    parts.append(
        f"Town {settings['town_seed']} in palette {settings['trained_palette']}, {settings['method']}, "
        f"{settings['trained_steps']} steps in {settings['train_seconds']:.0f} s; palettes {lights}; references of towns "
        f"{', '.join(map(str, settings['reference_seeds']))}; {settings['views']} held-out views and "
        f"{settings['frames']} frames of {size}; seed {settings['seed']}. {words(document['provenance'])}.\n"
    )
    parts += [_verdict(document), ""]
    for name, rows in document["means"].items():
        parts += [
            f"## Mean over palettes, {name} reference{'s' * (name != 'one')}\n",
            markdown(rows, COLUMNS, first="method"),
            "",
        ]
    own = document["reconstruction"]
    parts.append(f"Reconstruction: {own['psnr']:.2f} dB, SSIM {own['ssim']:.3f}, ΔE {own['delta_e']:.1f}.\n")
    if picture:
        parts.append(f"![all methods, one view of each palette, three references]({picture})\n")
    parts.append("## By palette\n")
    for light, sets in document["palettes"].items():
        for name, found in sets.items():
            parts += [f"### {light}, {name}\n", markdown(found["rows"], COLUMNS, first="method"), ""]
    parts += ["## ΔE2000 by class, three references, mean over palettes\n", _by_class(document), "", _USE]
    return "\n".join(parts)


def _verdict(document: Mapping[str, Any]) -> str:
    found = document["verdict"]
    lines = [f"Recommended: `{document['recommended']}`; the best global baseline is `{found['best_global']}`.\n"]
    lines += ["| with three references | reached | goal | |", "|---|---:|---:|---|"]
    for name, (label, unit, sign) in _GOALS.items():
        reached, met = found["reached"][name], found["met"][name]
        value = "–" if reached is None else f"{reached:.3g} {unit}".strip()
        verdict = {None: "not known", True: "met", False: "**not met**"}[met]
        lines.append(f"| {label} | {value} | {sign} {found['goals'][name]:g} {unit} | {verdict} |")
    return "\n".join(lines)


def _by_class(document: Mapping[str, Any]) -> str:
    tables = [sets["three"]["delta_e_by_class"] for sets in document["palettes"].values()]
    methods, kinds = list(tables[0]), list(tables[0][next(iter(tables[0]))])
    rows = {method: {kind: sum(t[method][kind] for t in tables) / len(tables) for kind in kinds} for method in methods}
    return markdown(rows, [(kind, kind, ".1f") for kind in kinds], first="method")
