"""Quality against training time as one drawing (SVG): `docs/images/minutes.svg`, written by `python -m
benchmarks tables`.
"""

import math
from typing import Any

SCENES = {
    "fox": "#e8710a",
    "llff_flower": "#1a73e8",
    "city_ochota": "#188038",
    "llff_fern": "#a142f4",
    "garden_seattle": "#d93025",
}
"""Scenes that are drawn, and the colours of their lines."""
PANELS = (
    ("psnr", "PSNR in dB, higher is better", 20.0, 34.0, 2.0),
    ("ssim", "SSIM, higher is better", 0.65, 0.95, 0.05),
    ("lpips", "LPIPS, lower is better", 0.05, 0.30, 0.05),
)
"""Key of the results, title, ends and steps of the axis."""
MINUTES = (0.5, 1, 3, 5)
WIDTH = 300
HEIGHT = 230
MARGIN = 34
TOP = 34
GAP = 26
"""Pixels of a panel's plot, beside, above and between them."""


def points(found: Any, scene: str, key: str) -> list[tuple[float, float]]:
    """Minutes and values of the runs of a scene, by minutes."""
    return sorted((row["minutes"], row[key]) for row in found.values() if row["scene"] == scene)


def drawing(found: Any) -> str:
    """Three panels over the minutes of training, a line for each scene."""
    whole = len(PANELS) * (MARGIN + WIDTH + GAP)
    tall = TOP + HEIGHT + 24 + 18 * math.ceil(len(SCENES) / 3) + 6
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {whole} {tall}" width="{whole}" height="{tall}" role="img" '
        'font-family="system-ui, sans-serif" font-size="12">',
        "<title>Held-out PSNR, SSIM and LPIPS of five captures against minutes of training</title>",
        f'<rect width="{whole}" height="{tall}" fill="#fff"/>',
    ]

    def x_of(left: float, minutes: float) -> float:
        return left + WIDTH * math.log(minutes / MINUTES[0]) / math.log(MINUTES[-1] / MINUTES[0])

    for i, (key, title, low, high, step) in enumerate(PANELS):
        left = i * (MARGIN + WIDTH + GAP) + MARGIN
        bottom = TOP + HEIGHT
        parts.append(f'<text x="{left}" y="{TOP - 12}" font-weight="600" fill="#202124">{title}</text>')
        # The grid: values across, minutes upwards.
        for j in range(round((high - low) / step) + 1):
            value = low + j * step
            y = bottom - HEIGHT * (value - low) / (high - low)
            parts.append(f'<path d="M{left} {y:.1f}h{WIDTH}" stroke="#e0e0e0"/>')
            parts.append(
                f'<text x="{left - 5}" y="{y + 4:.1f}" text-anchor="end" fill="#5f6368">{value:.3g}</text>'
            )
        for minutes in MINUTES:
            x = x_of(left, minutes)
            parts.append(f'<path d="M{x:.1f} {TOP}v{HEIGHT}" stroke="#e0e0e0"/>')
            unit = " min" if minutes == MINUTES[-1] else ""
            parts.append(
                f'<text x="{x:.1f}" y="{bottom + 17}" text-anchor="middle" fill="#5f6368">{minutes}{unit}</text>'
            )
        for scene, colour in SCENES.items():
            place = [
                (x_of(left, m), bottom - HEIGHT * (v - low) / (high - low))
                for m, v in points(found, scene, key)
            ]
            line = " ".join(f"{x:.1f},{y:.1f}" for x, y in place)
            parts.append(f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="2"/>')
            parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{colour}"/>' for x, y in place]
    for i, (scene, colour) in enumerate(SCENES.items()):
        x = MARGIN + i % 3 * (MARGIN + WIDTH + GAP)
        y = TOP + HEIGHT + 40 + 18 * (i // 3)
        parts.append(f'<path d="M{x} {y - 4}h22" stroke="{colour}" stroke-width="2"/>')
        parts.append(f'<text x="{x + 28}" y="{y}" fill="#202124">{scene}</text>')
    return "\n".join([*parts, "</svg>"]) + "\n"
