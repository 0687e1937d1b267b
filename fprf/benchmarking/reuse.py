"""What a style need not do again: a cached view in another style, and matching with the dictionary folded into the field."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from ..engine.cached_view import cache_view
from ..engine.folding import folded
from ..engine.restyle import restyle
from ..engine.views import render_view
from ..interfaces import SemanticField, Stylizer
from ..plugins.stylizers.config import LocalAdainConfig, StylizerConfig
from ..rendering.cameras import Cameras
from ..rendering.renderer import march
from ..style.look import Restyle
from .config import SpeedConfig
from .report import Row
from .subject import Subject, size_of, small_view, watch_of
from .timing import ratio, spread
from .views import difference, double, view_rays

__all__ = ["CACHED", "cached_rows", "folding_rows"]

CACHED = 135 * 240
"""Pixels of a cached view, where the run's views have so many."""
_FAST = 100.0
"""Milliseconds for a new style on that many pixels."""
_FOLDED = 1.5
"""How many times faster folded matching should be."""


def cached_rows(config: SpeedConfig, subject: Subject, styles: dict[str, StylizerConfig]) -> list[Row]:
    """A cached view in each style, beside rendering it anew."""
    trained = subject.trained
    known, render = trained.known, trained.config.render
    camera = small_view(known.cameras, (known.test or known.train)[0], CACHED)
    whole = int(camera.size[0].prod()) > 0.9 * CACHED
    view = cache_view(trained.model, known.facts, camera, 0, render)
    looks = {name: restyle(trained, subject.references, s, clusters=config.clusters).restyle for name, s in styles.items()}
    calls: dict[str, Callable[[], Tensor]] = {}
    for name, look in looks.items():
        calls[name] = lambda look=look: view.restyled(look).rgb  # type: ignore[misc]
        calls[f"anew {name}"] = partial(_drawn, subject, camera, look)
    seconds = watch_of(config, trained).in_turn(calls)
    rows = []
    for name in looks:
        taken = spread(seconds[name]).map(lambda s: 1e3 * s)
        rows.append(
            Row(
                name=f"cached view restyled, {name}",
                figure=taken.median,
                low=taken.low,
                high=taken.high,
                unit="ms",
                goal=_FAST if whole else None,
                peer=1e3 * spread(seconds[f"anew {name}"]).median,
                ratio=ratio(seconds[f"anew {name}"], seconds[name]),
                error=difference(calls[name](), calls[f"anew {name}"]()).largest,
                error_kind="largest colour difference from the view rendered anew",
                note=f"{size_of(camera)}, {view.bytes / 2**20:.0f} MiB cached",
            )
        )
    return rows


def _drawn(subject: Subject, camera: Cameras, look: Restyle) -> Tensor:
    trained = subject.trained
    return render_view(trained.model, trained.known.facts, camera, 0, trained.config.render, look).rgb


def folding_rows(config: SpeedConfig, subject: Subject) -> list[Row]:
    """Semantics and shares of a view's samples, folded and not: local AdaIN by dot products, one reference."""
    trained, chosen = subject.trained, LocalAdainConfig(similarity="dot")
    known = trained.known
    styled = restyle(trained, subject.references[:1], chosen, clusters=config.clusters)
    found = folded(trained.model, styled, chosen)
    field = trained.model.semantic
    if found is None or found.model.semantic is None or field is None:
        return []
    camera = small_view(known.cameras, (known.test or known.train)[0], config.rays)
    with torch.inference_mode():
        rays = view_rays(trained.model, camera, 0)
        points = march(rays, trained.model.parts, budget=trained.config.render.budget).kept.point
    calls = {
        "folded": partial(_shares, found.model.semantic, found.look.stylizer, points),
        "plain": partial(_shares, field, styled.restyle.stylizer, points),
    }
    seconds = watch_of(config, trained).in_turn(calls)
    taken = spread(seconds["folded"]).map(lambda s: 1e3 * s)
    wide = _shares(double(field), double(styled.restyle.stylizer), points.double())
    errors = {name: difference(call(), wide).largest / float(wide.max()) for name, call in calls.items()}
    return [
        Row(
            name="semantics and matching, dictionary folded into the field",
            figure=taken.median,
            low=taken.low,
            high=taken.high,
            unit="ms",
            peer=1e3 * spread(seconds["plain"]).median,
            ratio=ratio(seconds["plain"], seconds["folded"]),
            ratio_goal=_FOLDED,
            error=errors["folded"],
            error_kind="largest error of a share against float64, relative to the largest share",
            peer_error=errors["plain"],
            note=f"{len(points)} samples of a view, {len(styled.dictionary.keys)} codes, {known.facts.dim} semantic channels, "
            f"largest difference {difference(calls['folded'](), calls['plain']()).largest:.1e}",
        )
    ]


@torch.inference_mode()
def _shares(field: SemanticField, stylizer: Stylizer, points: Tensor) -> Tensor:
    return stylizer.match(field(points))
