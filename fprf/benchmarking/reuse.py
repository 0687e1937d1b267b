"""What a style need not do again: a cached view in another style, and matching with the dictionary folded into the field."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor, nn

from ..fields.networks import weights
from ..fields.semantic import ProjectedPlanes, SemanticPlanes
from ..interfaces import Stylizer
from ..ops import dense
from ..plugins.stylizers.config import LocalAdainConfig, StylizerConfig
from ..rendering.cameras import Cameras
from ..rendering.renderer import march
from ..style.look import Restyle
from ..training.cached_view import cache_view
from ..training.folding import folded
from ..training.restyle import restyle
from ..training.views import render_view
from .config import SpeedConfig
from .report import Row
from .subject import Subject, size_of, small_view, watch_of
from .timing import ratio, spread
from .views import difference, view_rays

__all__ = ["CACHED", "cached_rows", "folding_rows"]

CACHED = 135 * 240
"""Pixels of a cached view, where the run's views have so many."""
_FAST = 100.0
"""Milliseconds for a new style on that many pixels."""
_FOLDED = 1.5
"""How many times faster the folded layers should be."""
SIDES = ("folded", "plain")
HEAD = 4096
"""Samples whose hidden units go on to shares, so many times: a cache holds them."""
TIMES = 20
_Way = tuple[nn.Module, Stylizer, Tensor, int]
"""A field or a layer, what matches its outputs, its inputs, how often."""


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
    small, plain, folding = found.model.semantic, styled.restyle.stylizer, found.look.stylizer
    pairs: dict[str, tuple[_Way, _Way, float | None]] = {
        "semantics and matching, dictionary folded": ((small, folding, points, 1), (field, plain, points, 1), None)
    }
    if isinstance(field, SemanticPlanes) and isinstance(small, ProjectedPlanes):
        with torch.inference_mode():
            # What a cache holds: in the field, units never leave it.
            units = field.planes.network(points[:HEAD], weights(field.network)[:-1], [None] * (len(small.maps) - 1)).relu()
            units = units.repeat(-(-HEAD // max(1, len(units))), 1)[:HEAD]
        heads = _Head(list(small.maps)[-1]), _Head(weights(field.network)[-1])
        pairs[f"the same from hidden units to shares, {TIMES} x {HEAD} samples"] = (
            (heads[0], folding, units, TIMES),
            (heads[1], plain, units, TIMES),
            _FOLDED,
        )
    ways = {f"{side} {name}": way for name, pair in pairs.items() for side, way in zip(SIDES, pair[:2], strict=True)}
    calls = {name: partial(_shares, *way) for name, way in ways.items()}
    seconds = watch_of(config, trained).in_turn(calls)
    about = f"{len(points)} samples of a view, {len(styled.dictionary.keys)} codes, {known.facts.dim} semantic channels"
    rows = []
    for name, (_, _, goal) in pairs.items():
        ours, peer = (f"{side} {name}" for side in SIDES)
        taken, shares = spread(seconds[ours]).map(lambda s: 1e3 * s), calls[peer]()
        rows.append(
            Row(
                name=name,
                figure=taken.median,
                low=taken.low,
                high=taken.high,
                unit="ms",
                peer=1e3 * spread(seconds[peer]).median,
                ratio=ratio(seconds[peer], seconds[ours]),
                ratio_goal=goal,
                error=difference(calls[ours](), shares).largest / float(shares.max()),
                error_kind="largest difference of a share from the unfolded one, relative to the largest share",
                note=about,
            )
        )
    return rows


class _Head(nn.Module):
    """A last layer alone."""

    def __init__(self, weight: Tensor) -> None:
        super().__init__()
        self.weight = weight

    def forward(self, units: Tensor) -> Tensor:
        return dense.network(units, [self.weight], [None])


@torch.inference_mode()
def _shares(field: nn.Module, stylizer: Stylizer, points: Tensor, times: int) -> Tensor:
    for _ in range(times):
        shares = stylizer.match(field(points))
    return shares
