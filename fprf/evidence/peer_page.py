"""The page of a peer's scores, from the document alone."""

from collections.abc import Mapping
from typing import Any

from .provenance import words

__all__ = ["peer_page"]

_ROWS = (
    ("steadiness", "score", "consistency (0 = as steady and sharp as unstylised)", ".3f"),
    ("steadiness", "short", "error of neighbouring frames / contrast", ".3f"),
    ("steadiness", "plain_short", "the same, unstylised", ".3f"),
    ("steadiness", "long", "error 7 frames apart / contrast", ".3f"),
    ("steadiness", "plain_long", "the same, unstylised", ".3f"),
    ("steadiness", "sharpness", "sharpness (1 = as unstylised)", ".3f"),
    ("truth", "psnr", "PSNR to the truth, dB", ".2f"),
    ("truth", "ssim", "SSIM to the truth", ".3f"),
    ("truth", "delta_e", "ΔE2000 to the truth", ".1f"),
    ("style", "style_distance", "distance to the references (1 = no change)", ".3f"),
    ("style", "structure", "structure kept", ".3f"),
)
_PUBLISHED = (("short", "t, t-1"), ("long", "t, t-7"))


def peer_page(document: Mapping[str, Any]) -> str:
    """Markdown: what is known, and which flag would tell what is not."""
    width, height = document["size"]
    lines = [f"{document['frames']} frames of {width}x{height}. {words(document['provenance'])}.", "", "| | |", "|---|---:|"]
    for part, key, label, form in _ROWS:
        value = None if document[part] is None else document[part][key]
        lines.append(f"| {label} | {'–' if value is None else format(value, form)} |")
    for key, label in _PUBLISHED:
        found = document["published"] and document["published"][key]
        for figure, name, form in (("rmse", "RMSE", ".4f"), ("e_warp", "E_warp", ".2e")):
            value = None if not found else found[figure]
            lines.append(f"| as others report it: {name} ({label}) | {'–' if value is None else format(value, form)} |")
    if document["missing"]:
        lines += ["", *(f"- {part}: not known without {flag}" for part, flag in document["missing"].items())]
    return "\n".join(lines) + "\n"
