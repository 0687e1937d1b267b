"""Two-sided stylizers: points belong to scene regions, regions match style codes, each region is one affine map.

    f'  =  sum_k a_k(point) ((f - centre) A_k + b_k)          a = membership [N K], the same for every style

A_k and b_k carry region k's statistics to those of the codes that it matches, through a [K T] table that a user can read.
The source statistics are mixed over the scene's own regions just as the target's are over the codes: a dictionary that
equals the scene gives the identity, and a high temperature gives the global style. `region-tone` and `region-ot` differ in
A_k: per channel sigma_s / sigma_c (AdaIN), or the optimal transport of all channels at once.
"""

from abc import ABC, abstractmethod
from typing import Annotated, NamedTuple

import torch
from torch import Tensor, nn

from ...interfaces import Stylizer
from ...ops import mixture
from ...ops.precision import double, full_precision
from ...style.dictionary import StyleDictionary, choose, code_odds, whole_style
from ...style.matching import match_keys, unit
from ...style.scene_style import Membership, SceneStyle, check_fit, own_style
from ...style.statistics import deviation, monge
from ...types import Want
from .config import RegionConfig

_UNMATCHED, _MATCHED = 0.1, 0.4
"""Cosines with the nearest code, from the scene's mean: up to the first a region is unmatched, from the second on matched."""
_SIMILAR = 0.2
"""Squared distance of contents, in total variances of the scene, at which the weight of another region falls to 1/e."""


def region_table(scene: SceneStyle, dictionary: StyleDictionary, config: RegionConfig) -> Annotated[Tensor, "K T"]:
    """Share of each style code in each region, float64; rows sum to 1.

    A region that may not take from all references is matched with the codes of the others as if there were only these.
    """
    if dictionary.allowed is None:
        return _matched(scene, dictionary, config)
    table = torch.zeros(len(scene.share), len(dictionary.share), dtype=torch.float64)
    for k, chosen in enumerate(dictionary.allowed):
        part, codes = choose(dictionary, chosen)
        table[k, codes] = _matched(scene, part, config)[k]
    return table


class Side(NamedTuple):
    """Statistics of one side, region by region, float64."""

    mean: Annotated[Tensor, "K C"]
    sigma: Annotated[Tensor, "K C"]
    covariance: Annotated[Tensor, "K C C"]


class RegionPlan(NamedTuple):
    """Statistics of each region, its own and its style's."""

    table: Annotated[Tensor, "K T"]
    scene: Side
    style: Side


def plan_regions(
    dictionary: StyleDictionary, scene: SceneStyle, config: RegionConfig, smoothing: Annotated[Tensor, "K K"] | None = None
) -> RegionPlan:
    """Match the regions with the codes. The scene's statistics are blended and smoothed as the dictionary's are."""
    check_fit(dictionary, scene)
    own = own_style(scene, dictionary.blend)._replace(origin=dictionary.origin)
    same, table = region_table(scene, own, config), region_table(scene, dictionary, config)
    if smoothing is not None:
        same, table = smoothing @ same, smoothing @ table
    before = _mixed(own, same)
    if len(table) > 1:
        return RegionPlan(table, before, _mixed(dictionary, table))
    # An undivided scene gets the global style: codes taken together, with what lies between them.
    left = dictionary if dictionary.allowed is None else choose(dictionary, dictionary.allowed[0])[0]
    mean, covariance = (part[None] for part in whole_style(left))
    return RegionPlan(table, before, Side(mean, deviation(mean, covariance.diagonal(dim1=-2, dim2=-1)), covariance))


class RegionMaps(nn.Module, ABC):
    """The affine map of each region, applied to features less the scene's mean."""

    @abstractmethod
    def forward(
        self, content: Annotated[Tensor, "N C"], share: Annotated[Tensor, "N K"], centre: Annotated[Tensor, "C"]
    ) -> Annotated[Tensor, "N C"]:
        """Each point by the maps of its regions."""


class ChannelMaps(RegionMaps):
    """AdaIN: one gain a channel, sigma_s / sigma_c, at most `gain`."""

    gain: Annotated[Tensor, "K C"]
    bias: Annotated[Tensor, "K C"]

    def __init__(self, plan: RegionPlan, scene: SceneStyle, gain: float) -> None:
        super().__init__()
        ratio = (plan.style.sigma / plan.scene.sigma).clamp_max(gain)
        self.register_buffer("gain", ratio.to(scene.mean))
        self.register_buffer("bias", (plan.style.mean - (plan.scene.mean - double(scene.mean)) * ratio).to(scene.mean))

    def forward(
        self, content: Annotated[Tensor, "N C"], share: Annotated[Tensor, "N K"], centre: Annotated[Tensor, "C"]
    ) -> Annotated[Tensor, "N C"]:
        """Gains and biases are mixed before they are applied."""
        return mixture.scaled(content, share, self.gain, self.bias, centre=centre)


class MatrixMaps(RegionMaps):
    """Optimal transport: one matrix a region, no direction amplified more than `gain`."""

    matrix: Annotated[Tensor, "K C C"]
    bias: Annotated[Tensor, "K C"]

    def __init__(self, plan: RegionPlan, scene: SceneStyle, gain: float) -> None:
        super().__init__()
        matrix = monge(plan.scene.covariance, plan.style.covariance, gain=gain)
        moved = torch.einsum("kc,kcd->kd", plan.scene.mean - double(scene.mean), matrix)
        self.register_buffer("matrix", matrix.to(scene.mean))
        self.register_buffer("bias", (plan.style.mean - moved).to(scene.mean))

    def forward(
        self, content: Annotated[Tensor, "N C"], share: Annotated[Tensor, "N K"], centre: Annotated[Tensor, "C"]
    ) -> Annotated[Tensor, "N C"]:
        """Regions that a point does not belong to are not computed."""
        return mixture.affine(content, share, self.matrix, self.bias, centre=centre)


class TwoSidedStylizer(Stylizer):
    """Membership of points, and the map of each region."""

    centre: Annotated[Tensor, "C"]
    table: Annotated[Tensor, "K T"]

    def __init__(self, plan: RegionPlan, scene: SceneStyle, maps: RegionMaps) -> None:
        super().__init__()
        self.maps, self.membership = maps, Membership(scene)
        self.register_buffer("centre", scene.mean.float())
        self.register_buffer("table", plan.table.to(scene.mean))

    @property
    def needs(self) -> Want:
        return Want.CONTENT | Want.SEMANTIC if self.membership.divided else Want.CONTENT

    def forward(self, content: Annotated[Tensor, "N C"], semantic: Annotated[Tensor, "N D"] | None) -> Annotated[Tensor, "N C"]:
        """Each point by the maps of the regions that it belongs to."""
        return self.shared(content, semantic)[0]

    def shared(
        self, content: Annotated[Tensor, "N C"], semantic: Annotated[Tensor, "N D"] | None
    ) -> tuple[Annotated[Tensor, "N C"], Annotated[Tensor, "N K"]]:
        """`forward`, and the regions that points belong to."""
        with full_precision(content):
            share = self.membership(content[:, :0] if semantic is None else semantic)
            moved: Tensor = self.maps(content.to(self.centre), share, self.centre)
            return moved.to(content), share

    def match(self, semantic: Annotated[Tensor, "N D"]) -> Annotated[Tensor, "N T"]:
        with full_precision(semantic):
            share: Tensor = self.membership(semantic)
            return share @ self.table

    def region_match(self, keys: Annotated[Tensor, "K D"]) -> Annotated[Tensor, "K T"]:
        """The table of the plan."""
        return self.table


def _matched(scene: SceneStyle, dictionary: StyleDictionary, config: RegionConfig) -> Annotated[Tensor, "K T"]:
    odds = code_odds(dictionary)
    if len(scene.keys) == 1 or scene.keys.shape[1] == 0:
        return odds.expand(len(scene.keys), -1)
    table = match_keys(
        *(scene.keys, scene.share, dictionary.keys, odds, dictionary.weight),
        temperature=config.temperature,
        similarity=config.similarity,
        whitening=config.whitening,
        recentred=config.recentred,
        centred=config.centred,
        origin=dictionary.origin,
    )
    # Whether the references show such a thing at all is asked from the scene's mean: centred on its own, each side always fits.
    score = (unit(scene.keys, scene.semantic_mean) @ unit(dictionary.keys, scene.semantic_mean).T).amax(1)
    return _replace_unmatched(table, scene, (double(score) - _UNMATCHED) / (_MATCHED - _UNMATCHED))


def _replace_unmatched(
    table: Annotated[Tensor, "K T"], scene: SceneStyle, trust: Annotated[Tensor, "K"]
) -> Annotated[Tensor, "K T"]:
    """Rows of regions that are not in the references, by those of matched regions of similar content.

    The softmax gives such a region whichever code is the least unlike: sky between twigs the colour of a lamp.
    """
    trust = trust.clamp(0, 1)
    mean = double(scene.region_mean)
    distance = torch.cdist(mean, mean).square() / double(scene.covariance).trace().clamp_min(1e-12)
    weight = torch.exp(-distance / _SIMILAR) * (trust * double(scene.share))
    total = weight.sum(1, keepdim=True)
    return torch.where(total > 0, torch.lerp(weight / total.clamp_min(1e-30) @ table, table, trust[:, None]), table)


def _mixed(d: StyleDictionary, table: Tensor) -> Side:
    """Codes mixed by the rows of a table: means, deviations (paper, Eq. 6) and, for transport, covariances."""
    mean, covariance = double(d.mean), double(d.covariance)
    sigma = deviation(mean, covariance.diagonal(dim1=-2, dim2=-1))
    return Side(table @ mean, table @ sigma, torch.einsum("kt,tij->kij", table, covariance))
