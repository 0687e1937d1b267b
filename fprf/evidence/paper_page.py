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
    ("match_inside", "match inside", ".1%"),
    ("train_seconds", "training s", ".1f"),
    ("style_seconds", "style s", ".2f"),
    ("view_seconds", "view s", ".3f"),
)
_ABOUT = {
    "reconstruction": "The frozen, scene-agnostic decoder against one that the scene trains for itself, from nothing.",
    "ablation": "What the content loss and the pre-trained decoder are good for: the scene as it is, and restyled.",
    "guided-filter": "Feature targets with the guided filter, and merely interpolated between cells.",
    "clusters": "Local styles per reference, one training.",
    "multi-reference": "One reference, and three that share the work (see [restyle.md](restyle.md)), one training.",
    "time": "Seconds to train, to make a style of three references, and to colour a view whose geometry is there.",
}


def paper_page(document: Mapping[str, Any]) -> str:
    """Markdown. Columns that no row has are left out."""
    settings, rows = document["settings"], document["rows"]
    columns = [each for each in COLUMNS if any(row.get(each[0]) is not None for row in rows.values())]
    seeds = ", ".join(map(str, settings["trainings"]))
    styled = any("styled_psnr" in row for row in rows.values())
    how = f" *Styled*: against the truth of the palettes {', '.join(settings['palettes'])}." if styled else ""
    return (
        f"# {document['table'].capitalize()}\n\n{_ABOUT[document['table']]}{how}\n\n"
        f"{settings['data']} at 1/{settings['downscale']}, {settings['method']}, {settings['steps']} steps, seeds {seeds}, "
        f"{settings['views']} held-out views. {words(document['provenance'])}.\n\n{markdown(rows, columns)}\n"
    )
