"""Methods of restyling side by side: how much of the picture each keeps, and how near it comes to the references.

Every method shows the same views; all are judged by the same encoders in the same regions, which no method chose.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..errors import DataError
from ..interfaces import Encoder
from ..plugins.stylizers.config import (
    AdainConfig,
    LocalAdainConfig,
    RegionAdainConfig,
    RegionOtConfig,
    RegionToneConfig,
    StylizerConfig,
)
from .colour_transfer import histogram_matching, reinhard
from .structure import luminance_ssim, structure
from .style_distance import style_distances

__all__ = ["GOALS", "PLAIN", "RECOMMENDED", "STYLIZERS", "Exhibit", "colour_baselines", "judge_exhibit", "mean_rows", "verdict"]

PLAIN = "unstylised"
STYLIZERS: Mapping[str, StylizerConfig] = {
    "adain": AdainConfig(),
    "local-adain": LocalAdainConfig(),
    "region-adain": RegionAdainConfig(),
    "region-ot": RegionOtConfig(),
    "region-tone": RegionToneConfig(),
}
RECOMMENDED = "region-tone"

GOALS: Mapping[str, float] = {"adain": 0.30, "local-adain": 0.15}
"""By what share the recommended stylizer shall come nearer to the style than these."""
_SLACK = 0.02
"""How much structure it may lose against them."""

Row = dict[str, float | None]


class Exhibit(NamedTuple):
    """What methods are judged by: one scene in one style. Lists of views run in parallel."""

    plain: Sequence[Annotated[Tensor, "H W 3"]]
    styled: Mapping[str, Sequence[Annotated[Tensor, "H W 3"]]]
    regions: Sequence[Annotated[Tensor, "h w"]]
    """Region ids of the views, at any resolution."""
    references: Sequence[Annotated[Tensor, "G F 3"]]
    reference_regions: Sequence[Annotated[Tensor, "g f"]]


def colour_baselines(
    plain: Sequence[Annotated[Tensor, "H W 3"]], references: Sequence[Annotated[Tensor, "G F 3"]]
) -> dict[str, list[Annotated[Tensor, "H W 3"]]]:
    """Colour transfers of every view on its own, towards all pixels of all references."""
    style = torch.cat([image.reshape(-1, 3) for image in references])
    methods = {"reinhard": reinhard, "histogram": histogram_matching}
    return {
        name: [transfer(view.reshape(-1, 3), style).reshape(view.shape) for view in plain] for name, transfer in methods.items()
    }


def judge_exhibit(exhibit: Exhibit, judges: Mapping[str, Encoder], *, full: bool = False) -> dict[str, Row]:
    """By method: `structure` and `ssim` (means over the views), and `style_distance`, also by judge and, with `full`, of whole
    covariances.

    Raises DataError where the lists of views differ in length.
    """
    lengths = {len(exhibit.plain), len(exhibit.regions), *(len(views) for views in exhibit.styled.values())}
    if len(lengths) != 1 or len(exhibit.references) != len(exhibit.reference_regions):
        raise DataError("contest: every method needs a picture of each view, and every picture its regions")
    plain = list(zip(exhibit.plain, exhibit.regions, strict=True))
    styled = {name: list(zip(views, exhibit.regions, strict=True)) for name, views in exhibit.styled.items()}
    style = list(zip(exhibit.references, exhibit.reference_regions, strict=True))
    kinds = {"style_distance": False, "full_distance": True} if full else {"style_distance": False}
    distances = {name: style_distances(judges, plain, styled, style, full=exact) for name, exact in kinds.items()}
    rows: dict[str, Row] = {}
    for name, views in exhibit.styled.items():
        pairs = list(zip(exhibit.plain, views, strict=True))
        row: Row = {
            "structure": math.fsum(structure(a, b) for a, b in pairs) / len(pairs),
            "ssim": math.fsum(luminance_ssim(a, b) for a, b in pairs) / len(pairs),
        }
        for kind, found in distances.items():
            row[kind] = found[name].pop("mean")
            row |= {f"{kind}_{judge}": value for judge, value in found[name].items()}
        rows[name] = row
    return rows


def mean_rows(contests: Iterable[Mapping[str, Row]]) -> dict[str, Row]:
    """Mean of every figure over contests with the same methods; what is None in one of them is left out there."""
    gathered: dict[str, dict[str, list[float]]] = {}
    for contest in contests:
        for method, row in contest.items():
            for key, value in row.items():
                kept = gathered.setdefault(method, {}).setdefault(key, [])
                kept += [] if value is None else [value]
    return {
        method: {key: math.fsum(values) / len(values) if values else None for key, values in row.items()}
        for method, row in gathered.items()
    }


def verdict(rows: Mapping[str, Row], recommended: str = RECOMMENDED) -> dict[str, dict[str, float | bool | None]]:
    """Against each method of GOALS: by what share the recommended one is nearer to the style, the structure that it loses, and
    whether both goals are met (None where a distance is not known).
    """
    found: dict[str, dict[str, float | bool | None]] = {}
    for method, goal in GOALS.items():
        ours, theirs = (rows[name]["style_distance"] for name in (recommended, method))
        kept, theirs_kept = (rows[name]["structure"] for name in (recommended, method))
        if ours is None or theirs is None or theirs <= 0 or kept is None or theirs_kept is None:
            found[method] = {"nearer_share": None, "goal_share": goal, "structure_lost": None, "met": None}
            continue
        nearer, lost = 1 - ours / theirs, theirs_kept - kept
        found[method] = {
            "nearer_share": nearer,
            "goal_share": goal,
            "structure_lost": lost,
            "met": nearer >= goal and lost <= _SLACK,
        }
    return found
