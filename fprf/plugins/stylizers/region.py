"""Two-sided stylizers: points belong to scene regions, regions match style codes, each region is one affine map.

    f'  =  sum_k a_k(point) ((f - centre) A_k + b_k)          a = membership [N K], the same for every style

A_k and b_k carry region k's statistics to those of the codes that it matches, through a [K T] table that a user can read
and edit. The source statistics are mixed over the scene's own regions just as the target's are over the codes: a
dictionary that equals the scene gives the identity, and a high temperature gives the global style.
"""

from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ...errors import DataError
from ...interfaces import Stylizer
from ...style.dictionary import StyleDictionary, code_odds, whole_style
from ...style.matching import attention, full_precision, score_spread, share_mean, unit
from ...style.scene import SceneStyle, check_fit, membership, own_style, region_units
from ...style.statistics import deviation, double
from ...style.transport import monge
from ...types import Want

__all__ = ["RegionAdainStylizer", "RegionOtStylizer", "region_table"]


def region_table(scene: SceneStyle, dictionary: StyleDictionary, temperature: float) -> Annotated[Tensor, "K T"]:
    """Share of each style code in each region, float64; rows sum to 1. Temperature is relative."""
    if len(scene.keys) == 1 or scene.keys.shape[1] == 0:
        return code_odds(dictionary).expand(len(scene.keys), -1)
    queries, keys = double(scene.keys), double(dictionary.keys)
    queries = unit(queries, share_mean(queries, double(scene.share)))
    keys = unit(keys, share_mean(keys, code_odds(dictionary)))
    return attention(queries, keys, temperature * score_spread(queries, keys), double(dictionary.weight))


class RegionAdainStylizer(Stylizer):
    """The affine map of each region is per channel: sigma_s / sigma_c."""

    centre: Annotated[Tensor, "C"]
    semantic_mean: Annotated[Tensor, "D"]
    units: Annotated[Tensor, "K D"]
    table: Annotated[Tensor, "K T"]
    gain: Annotated[Tensor, "K C"]
    bias: Annotated[Tensor, "K C"]

    def __init__(
        self,
        dictionary: StyleDictionary,
        scene: SceneStyle,
        *,
        temperature: float,
        blend: float,
        gain: float,
        table: Annotated[Tensor, "K T"] | None = None,
    ) -> None:
        super().__init__()
        plan = _plan(dictionary, scene, temperature, blend, table)
        ratio = (plan.style.sigma / plan.scene.sigma).clamp_max(gain)
        bias = plan.style.mean - (plan.scene.mean - double(scene.mean)) * ratio
        units, self.softness = region_units(scene.keys, scene.semantic_mean)
        self.register_buffer("centre", scene.mean.float())
        self.register_buffer("semantic_mean", scene.semantic_mean.float())
        self.register_buffer("units", units.float())
        self.register_buffer("table", plan.table.to(units.device).float())
        self.register_buffer("gain", ratio.to(units.device).float())
        self.register_buffer("bias", bias.to(units.device).float())

    @property
    def needs(self) -> Want:
        """Semantics only where there is more than one region."""
        return _needs(self.units)

    def forward(self, content: Annotated[Tensor, "N C"], semantic: Annotated[Tensor, "N D"] | None) -> Annotated[Tensor, "N C"]:
        """Each point by its regions' maps."""
        with full_precision(content):
            away = content.to(self.gain) - self.centre
            if len(self.units) == 1:
                return (away * self.gain + self.bias).to(content)
            assert semantic is not None, "Want.SEMANTIC was asked for"
            share = membership(semantic.to(self.units), self.semantic_mean, self.units, self.softness)
            return (away * (share @ self.gain) + share @ self.bias).to(content)

    def match(self, semantic: Annotated[Tensor, "N D"]) -> Annotated[Tensor, "N T"]:
        """Memberships times the table."""
        with full_precision(semantic):
            return membership(semantic.to(self.units), self.semantic_mean, self.units, self.softness) @ self.table


class RegionOtStylizer(Stylizer):
    """The affine map of each region is the optimal-transport one, on all channels at once.

    `matrix`, `bias` and `centre` are buffers, so that a renderer can multiply them into a decoder's first layer.
    """

    centre: Annotated[Tensor, "C"]
    semantic_mean: Annotated[Tensor, "D"]
    units: Annotated[Tensor, "K D"]
    table: Annotated[Tensor, "K T"]
    matrix: Annotated[Tensor, "K C C"]
    bias: Annotated[Tensor, "K C"]

    def __init__(
        self,
        dictionary: StyleDictionary,
        scene: SceneStyle,
        *,
        temperature: float,
        blend: float,
        gain: float,
        table: Annotated[Tensor, "K T"] | None = None,
    ) -> None:
        super().__init__()
        plan = _plan(dictionary, scene, temperature, blend, table)
        matrix = monge(plan.scene.covariance, plan.style.covariance, gain=gain)
        bias = plan.style.mean - torch.einsum("kc,kcd->kd", plan.scene.mean - double(scene.mean), matrix)
        units, self.softness = region_units(scene.keys, scene.semantic_mean)
        self.register_buffer("centre", scene.mean.float())
        self.register_buffer("semantic_mean", scene.semantic_mean.float())
        self.register_buffer("units", units.float())
        self.register_buffer("table", plan.table.to(units.device).float())
        self.register_buffer("matrix", matrix.to(units.device).float())
        self.register_buffer("bias", bias.to(units.device).float())

    @property
    def needs(self) -> Want:
        """Semantics only where there is more than one region."""
        return _needs(self.units)

    def forward(self, content: Annotated[Tensor, "N C"], semantic: Annotated[Tensor, "N D"] | None) -> Annotated[Tensor, "N C"]:
        """Each point by the maps of the regions that it belongs to; others are not computed."""
        with full_precision(content):
            away = content.to(self.matrix) - self.centre
            if len(self.units) == 1:
                return (away @ self.matrix[0] + self.bias[0]).to(content)
            assert semantic is not None, "Want.SEMANTIC was asked for"
            share = membership(semantic.to(self.units), self.semantic_mean, self.units, self.softness)
            out = share @ self.bias
            for k in range(len(self.units)):
                inside = share[:, k].nonzero().squeeze(1)
                out.index_add_(0, inside, (away[inside] * share[inside, k, None]) @ self.matrix[k])
            return out.to(content)

    def match(self, semantic: Annotated[Tensor, "N D"]) -> Annotated[Tensor, "N T"]:
        """Memberships times the table."""
        with full_precision(semantic):
            return membership(semantic.to(self.units), self.semantic_mean, self.units, self.softness) @ self.table


class _Side(NamedTuple):
    """Statistics of one side, region by region, float64."""

    mean: Annotated[Tensor, "K C"]
    sigma: Annotated[Tensor, "K C"]
    covariance: Annotated[Tensor, "K C C"]


class _Plan(NamedTuple):
    table: Annotated[Tensor, "K T"]
    scene: _Side
    style: _Side


def _plan(dictionary: StyleDictionary, scene: SceneStyle, temperature: float, blend: float, table: Tensor | None) -> _Plan:
    """What each region has and what it gets."""
    check_fit(dictionary, scene)
    own = own_style(scene, blend)
    same = _mixed(own, region_table(scene, own, temperature))
    if table is not None:
        if table.shape != (len(scene.share), len(dictionary.share)):
            raise DataError(
                f"region table: {tuple(table.shape)}, but there are {len(scene.share)} regions and "
                f"{len(dictionary.share)} style codes; edit the table of this scene and these references"
            )
        return _Plan(double(table), same, _mixed(dictionary, double(table)))
    table = region_table(scene, dictionary, temperature)
    if len(table) > 1:
        return _Plan(table, same, _mixed(dictionary, table))
    # An undivided scene gets the global style: codes taken together, with what lies between them.
    mean, covariance = (part[None] for part in whole_style(dictionary))
    return _Plan(table, same, _Side(mean, deviation(mean, covariance.diagonal(dim1=-2, dim2=-1)), covariance))


def _mixed(d: StyleDictionary, table: Tensor) -> _Side:
    """Codes mixed by the rows of a table: means, deviations (paper, Eq. 6) and, for transport, covariances."""
    mean, covariance = double(d.mean), double(d.covariance)
    sigma = deviation(mean, covariance.diagonal(dim1=-2, dim2=-1))
    return _Side(table @ mean, table @ sigma, torch.einsum("kt,tij->kij", table, covariance))


def _needs(units: Tensor) -> Want:
    return Want.CONTENT if len(units) == 1 else Want.CONTENT | Want.SEMANTIC
