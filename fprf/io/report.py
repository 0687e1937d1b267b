"""Report of training: charts as SVG text in the colours of the page, the page of a run's report, TensorBoard's event files.

Measured figures are shown as a label, a rounded number and a unit. Keys are those of our JSON, units included.
"""

import math
import shutil
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from ..errors import UsageError
from .atomic import write_text

if TYPE_CHECKING:
    from ..training.run import History


Metrics: TypeAlias = "Mapping[str, float | int | str | Metrics | None]"


class Figure(NamedTuple):
    """One row of a table."""

    group: str
    """"" at the top, else the labels of the objects around it."""
    label: str
    value: str
    unit: str


_KNOWN: dict[str, tuple[str, str]] = {
    "psnr": ("PSNR", "dB"),
    "ssim": ("SSIM", ""),
    "lpips": ("LPIPS", ""),
    "rmse": ("Warp error, RMSE", "of [0, 1]"),
    "relative": ("Warp error / contrast", ""),
    "valid_share": ("Pixels compared", "%"),
    "seconds": ("Time", "s"),
    "rays_per_second": ("Rays", "1/s"),
    "frames_per_second": ("Frames", "1/s"),
    "peak_rss_mib": ("Peak memory", "MiB"),
    "short": ("next frame", ""),
    "long": ("7 frames on", ""),
}
_UNITS = {
    "_per_second": "1/s",
    "_milliseconds": "ms",
    "_seconds": "s",
    "_minutes": "min",
    "_mib": "MiB",
    "_gib": "GiB",
    "_bytes": "B",
    "_db": "dB",
    "_bits": "bit",
    "_metres": "m",
    "_share": "%",
    "_percent": "%",
}


def _named(key: str) -> tuple[str, str]:
    """Label and unit of a key."""
    if key in _KNOWN:
        return _KNOWN[key]
    for ending, unit in _UNITS.items():
        if key.endswith(ending) and key != ending:
            return _named(key.removesuffix(ending))[0], unit
    words = key.replace("_", " ").strip()
    return words[:1].upper() + words[1:], ""


def number(value: float | int | str | bool | None) -> str:
    """Three digits that matter, thousands apart; a dash for what was not measured."""
    if value is None:
        return "–"
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int) or value == 0 or abs(value) >= 100:
        return f"{value:,.0f}"
    if abs(value) < 1e-3:
        return f"{value:.1e}"
    return f"{value:.{1 if abs(value) >= 50 else 2 if abs(value) >= 1 else 3}f}"


def figures(metrics: Metrics, group: str = "") -> Iterator[Figure]:
    """Every figure of a metrics object, in its order, the objects within it after its own."""
    inner: list[tuple[str, Metrics]] = []
    for key, value in metrics.items():
        label, unit = _named(key)
        if isinstance(value, Mapping):
            inner.append((f"{group} · {label}" if group else label, value))
            continue
        if key.endswith("share") and isinstance(value, int | float):
            value = 100.0 * value
        yield Figure(group, label, number(value), unit)
    for name, content in inner:
        yield from figures(content, name)


_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 560, 260, 58, 12, 12, 34
_COLOURS = ("#2f6fd0", "#d9730d", "#2e8b57", "#b0417e", "#8a6d1d", "#5b5bd6", "#00838f", "#a33b2f")
_MOST_POINTS = 400
"""Points that a line is drawn with; more would only be thicker."""
_LEVELS = "▁▂▃▄▅▆▇█"


class Series(NamedTuple):
    """One line: points that are not known are left out."""

    name: str
    x: Sequence[float]
    y: Sequence[float | None]


def axis_ticks(low: float, high: float, most: int = 5) -> list[float]:
    """Round numbers within [low, high], evenly spaced: 1, 2 or 5 times a power of ten apart; at most `most` + 1."""
    if not high > low:
        return [low]
    raw = (high - low) / most
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * (1 - 1e-9))
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def line_chart(title: str, series: Sequence[Series], x_label: str, y_label: str, *, log: bool = False) -> str:
    """A chart of lines over a common axis. `log` spaces y by its logarithm and leaves out what is not above 0."""
    drawn = [(each.name, _points(each, log)) for each in series]
    drawn = [(name, points) for name, points in drawn if points]
    if not drawn:
        return ""
    xs, ys = ([point[axis] for _, points in drawn for point in points] for axis in (0, 1))
    x0, x1, y0, y1 = min(xs), max(xs), min(ys), max(ys)
    if y1 - y0 < 1e-12 * max(1.0, abs(y1)):
        y0, y1 = y0 - 0.5, y1 + 0.5
    x1 = x1 if x1 > x0 else x0 + 1
    across = (_WIDTH - _LEFT - _RIGHT) / (x1 - x0)
    up = (_HEIGHT - _TOP - _BOTTOM) / (y1 - y0)

    def place(x: float, y: float) -> tuple[float, float]:
        return _LEFT + (x - x0) * across, _HEIGHT - _BOTTOM - (y - y0) * up

    parts = [f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(title)}">']
    for value in axis_ticks(y0, y1):
        _, y = place(x0, value)
        shown = number(10**value if log else value)
        parts.append(f'<line class="rule" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{shown}</text>')
    for value in axis_ticks(x0, x1):
        x, _ = place(value, y0)
        parts.append(f'<text x="{x:.1f}" y="{_HEIGHT - _BOTTOM + 18}" text-anchor="middle">{value:,.4g}</text>')
    parts.append(f'<text class="axis" x="{_WIDTH - _RIGHT}" y="{_HEIGHT - 2}" text-anchor="end">{escape(x_label)}</text>')
    for k, (name, points) in enumerate(drawn):
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in (place(*point) for point in points))
        colour = _COLOURS[k % len(_COLOURS)]
        parts.append(f'<polyline points="{path}" stroke="{colour}"><title>{escape(name)}</title></polyline>')
    parts.append("</svg>")
    return f"<figure><figcaption>{escape(title)}, {escape(y_label)}</figcaption>{''.join(parts)}{_legend(drawn)}</figure>"


def bar_chart(rows: Sequence[tuple[str, float, str]]) -> str:
    """Horizontal bars with (name, value, what is written beside it); lengths are relative to the largest value."""
    longest = max((value for _, value, _ in rows), default=0.0) or 1.0
    drawn = "".join(
        f'<div class="bar-row"><dt>{escape(name)}</dt><dd><i style="width:{100 * max(0.0, value) / longest:.2f}%"></i>'
        f"<span>{escape(text)}</span></dd></div>"
        for name, value, text in rows
    )
    return f'<dl class="bars">{drawn}</dl>' if rows else ""


def sparkline(values: Sequence[float | None]) -> str:
    """A line of at most 24 blocks, low to high, for a terminal; what is not known is left out."""
    known = [value for value in values if value is not None]
    if not known:
        return ""
    count = min(24, len(known))
    means = [fmean(known[k * len(known) // count : (k + 1) * len(known) // count]) for k in range(count)]
    low, high = min(means), max(means)
    scale = (len(_LEVELS) - 1) / (high - low) if high > low else 0.0
    return "".join(_LEVELS[round((value - low) * scale)] for value in means)


def _points(series: Series, log: bool) -> list[tuple[float, float]]:
    known = [(x, y) for x, y in zip(series.x, series.y, strict=True) if y is not None and (y > 0 or not log)]
    stride = max(1, math.ceil(len(known) / _MOST_POINTS))
    kept = known[::stride]
    if known and kept[-1] != known[-1]:
        kept.append(known[-1])
    return [(x, math.log10(y)) for x, y in kept] if log else kept


def _legend(drawn: Sequence[tuple[str, object]]) -> str:
    if len(drawn) < 2:
        return ""
    items = "".join(
        f'<li><i style="background:{_COLOURS[k % len(_COLOURS)]}"></i>{escape(name)}</li>' for k, (name, _) in enumerate(drawn)
    )
    return f'<ul class="legend">{items}</ul>'


def write_report(
    path: Path,
    *,
    title: str,
    facts: Mapping[str, str | int | float],
    charts: Sequence[str],
    parts: str,
    notes: Sequence[str],
) -> None:
    """Write the page, whole or not at all. `charts` and `parts` are HTML of this module; all else is shown as text."""
    shown = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(number(fact))}</dd></div>" for name, fact in facts.items())
    sections = [f'<section class="opening"><h1>{escape(title)}</h1><dl class="facts">{shown}</dl></section>']
    if charts:
        sections.append(f'<section><h2>Training</h2><div class="charts">{"".join(charts)}</div></section>')
    if parts:
        sections.append(f"<section><h2>Where the time went</h2>{parts}</section>")
    if notes:
        listed = "".join(f"<li>{escape(note)}</li>" for note in notes)
        sections.append(f'<section><h2>What happened on the way</h2><ul class="notes">{listed}</ul></section>')
    here = files(__package__)
    css = (here / "gallery.css").read_text("utf-8") + (here / "report.css").read_text("utf-8")
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    write_text(
        path,
        f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<title>{escape(title)}</title>
<link rel="icon" href="data:,">
<style>
{css}</style>
</head>
<body>
<header class="bar"><span class="mark" aria-hidden="true">fprf</span></header>
<main>
{"".join(sections)}
</main>
<footer><p>Made with fprf. This page is one file: it loads nothing and can be sent as it is.</p></footer>
</body>
</html>
""",
    )


def write_scalars(folder: Path, histories: Sequence["History"]) -> int:
    """One run of TensorBoard for the training and each block, replaced if it is there; how many values were written.

    Times are those of training, so that a resumed run has no gap. Raises UsageError without the package `tensorboard`.
    """
    try:
        from torch.utils.tensorboard.writer import SummaryWriter
    except ImportError as fault:
        raise UsageError("--tensorboard: the package tensorboard is not installed; pip install 'fprf[tensorboard]'") from fault
    written = 0
    for history in histories:
        place = folder / (history.name or "training")
        shutil.rmtree(place, ignore_errors=True)
        writer = SummaryWriter(str(place))
        try:
            for name, values in history.values.items():
                for step, seconds, value in zip(history.step, history.seconds, values, strict=True):
                    if value is not None:
                        writer.add_scalar(name, value, step, walltime=seconds)
                        written += 1
        finally:
            writer.close()
    return written
