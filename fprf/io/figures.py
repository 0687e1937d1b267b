"""Measured figures as people read them: a label, a rounded number and a unit. Keys are those of our JSON, units included."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple, TypeAlias

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
    "cc_psnr": ("PSNR in the photograph's exposure", "dB"),
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
