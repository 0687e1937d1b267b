"""The page of one of the paper's tables, from its document alone."""

from collections.abc import Mapping
from typing import Any

from .provenance import words
from .table import Column, markdown

__all__ = ["COLUMNS", "paper_page"]

COLUMNS: tuple[Column, ...] = (
    ("psnr", "PSNR dB", ".2f"),
    ("ssim", "SSIM", ".3f"),
    ("styled_psnr", "styled PSNR dB", ".2f"),
    ("styled_ssim", "styled SSIM", ".3f"),
    ("styled_delta_e", "styled ΔE2000", ".1f"),
    ("style_distance", "style distance", ".3f"),
    ("structure", "structure", ".3f"),
    ("match_inside", "match inside", ".1%"),
    ("match_border", "match at borders", ".1%"),
    ("paper_styled_psnr", "local-adain PSNR dB", ".2f"),
    ("paper_styled_delta_e", "local-adain ΔE2000", ".1f"),
    ("paper_style_distance", "local-adain style distance", ".3f"),
    ("paper_structure", "local-adain structure", ".3f"),
    ("consistency", "consistency", ".3f"),
    ("warp_short", "error to the next frame", ".3f"),
    ("warp_long", "error seven frames on", ".3f"),
    ("train_seconds", "training s", ".1f"),
    ("style_seconds", "style s", ".2f"),
    ("view_seconds", "view s", ".3f"),
)
_ABOUT = {
    "reconstruction": "The frozen, scene-agnostic decoder against one that the scene trains for itself, from nothing.",
    "ablation": "What the content loss and the pre-trained decoder are good for: the scene as it is, and restyled.",
    "guided-filter": "Feature targets with the guided filter, and merely interpolated between cells.",
    "clusters": "Local styles per reference, one training; and no clusters, every cell of 8x8 pixels a style of its own.",
    "multi-reference": "One reference, and three that share the work (see [restyle.md](restyle.md)), one training.",
    "time": "Seconds to train, to make a style of three references, and to colour a view whose geometry is there.",
    "statistics": "What styles start from: statistics and regions of the whole scene, or of each view by itself.",
    "large-scale": "The same places seen from far apart (frames half a metre and 3 degrees from each other): every picture "
    "restyled alone, and the scene restyled once.",
}
_KEPT = " *Structure*: of the unstylised render, 1 = all of it."
_DISTANCE = (
    " *Style distance*: of VGG-19's relu1_1 and relu2_1 statistics in regions that the run's semantic encoder finds in both, "
    "0 = the references' own, 1 = no change."
)
_STEADY = " *Consistency*: what a style adds to the error between frames, and loses in sharpness; 0 is best."


def paper_page(document: Mapping[str, Any]) -> str:
    """Markdown. Columns that no row has are left out."""
    settings, rows = document["settings"], document["rows"]
    columns = [each for each in COLUMNS if any(row.get(each[0]) is not None for row in rows.values())]
    seeds = ", ".join(map(str, settings["trainings"]))
    styled = any("styled_psnr" in row for row in rows.values())
    how = f" *Styled*: against the truth of the palettes {', '.join(settings['palettes'])}.{_KEPT}" if styled else ""
    if settings.get("references"):
        how += f" Restyled by {', '.join(settings['references'])}.{_DISTANCE}{_KEPT}"
    how += _STEADY if any("consistency" in row for row in rows.values()) else ""
    return (
        f"# {document['table'].capitalize()}\n\n{_ABOUT[document['table']]}{how}\n\n"
        f"{settings['data']} at 1/{settings['downscale']}, {settings['method']}, {settings['steps']} steps, seeds {seeds}, "
        f"{settings['views']} held-out views. {words(document['provenance'])}.\n\n{markdown(rows, columns)}\n"
    )
