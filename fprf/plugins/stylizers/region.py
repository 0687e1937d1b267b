"""Two-sided stylizers: points belong to scene regions, regions match style codes, each region is one affine
map.

    f'  =  sum_k a_k(point) ((f - centre) A_k + b_k)          a = membership [N K], the same for every style

Letters: N points, C content channels, D semantic channels, T style codes, K regions of the scene. Tables of
regions and codes are float64, buffers float32.

A_k and b_k carry region k's statistics to those of the codes that it matches, through a [K T] table that a
user can read. The source statistics are mixed over the scene's own regions just as the target's are over the
codes: a dictionary that equals the scene gives the identity, and a high temperature gives the global style.
`region-tone` and `region-ot` differ in A_k: per channel sigma_s / sigma_c (AdaIN), or the optimal transport
of all channels at once.
"""

from typing import Annotated

import torch
from torch import Tensor

from ...interfaces import Stylizer
from ...ops.backend import double
from ...style.dictionary import StyleDictionary, choose, code_odds, whole_style
from ...style.matching import match_keys, unit
from ...style.scene_style import Membership, SceneStyle, check_fit, mixed_gains, mixed_maps, own_style
from ...style.statistics import deviation, monge
from ...types import Want
from .config import RegionConfig

_UNMATCHED_COSINE = 0.1
"""Cosine with the nearest code, from the scene's mean, up to which a region is unmatched; by eye."""
_MATCHED_COSINE = 0.4
"""Cosine from which on it is matched; by eye."""
_SIMILAR = 0.2
"""Squared distance of contents, in total variances of the scene, at which the weight of another region falls
to 1/e.
"""


def region_table(
    scene: SceneStyle, dictionary: StyleDictionary, config: RegionConfig
) -> Annotated[Tensor, "K T"]:
    """Share of each style code in each region, float64; rows sum to 1.

    A region that may not take from all references is matched with the codes of the others as if there were
    only these.
    """
    if dictionary.allowed is not None:
        table = torch.zeros(len(scene.share), len(dictionary.share), dtype=torch.float64)
        for k, chosen in enumerate(dictionary.allowed):
            part, codes = choose(dictionary, chosen)
            table[k, codes] = region_table(scene, part, config)[k]
        return table
    odds = code_odds(dictionary)
    if len(scene.keys) == 1 or scene.keys.shape[1] == 0:
        return odds.expand(len(scene.keys), -1)
    table = match_keys(
        *(scene.keys, scene.share, dictionary.keys, odds, dictionary.weight),
        temperature=config.temperature,
        whitening=config.whitening,
        recentred=config.recentred,
        centred=config.centred,
        origin=dictionary.origin,
    )
    # Rows of regions that are not in the references become those of matched regions of similar content: the
    # softmax gives such a region whichever code is the least unlike, sky between twigs the colour of a lamp.
    # Whether the references show such a thing at all is asked from the scene's mean: centred on its own, each
    # side always fits.
    score = (unit(scene.keys, scene.semantic_mean) @ unit(dictionary.keys, scene.semantic_mean).T).amax(1)
    trust = ((double(score) - _UNMATCHED_COSINE) / (_MATCHED_COSINE - _UNMATCHED_COSINE)).clamp(0, 1)
    mean = double(scene.region_mean)
    distance = torch.cdist(mean, mean).square() / double(scene.covariance).trace().clamp_min(1e-12)
    weight = torch.exp(-distance / _SIMILAR) * (trust * double(scene.share))
    total = weight.sum(1, keepdim=True)
    return torch.where(
        total > 0, torch.lerp(weight / total.clamp_min(1e-30) @ table, table, trust[:, None]), table
    )


def mixed_codes(
    d: StyleDictionary, table: Annotated[Tensor, "K T"]
) -> tuple[Annotated[Tensor, "K C"], Annotated[Tensor, "K C"], Annotated[Tensor, "K C C"]]:
    """Codes mixed by the rows of a table, float64: means and deviations (paper, Eq. 6) and, for transport,
    covariances.
    """
    mean = double(d.mean)
    covariance = double(d.covariance)
    sigma = deviation(mean, covariance.diagonal(dim1=-2, dim2=-1))
    return table @ mean, table @ sigma, torch.einsum("kt,tij->kij", table, covariance)


class TwoSidedStylizer(Stylizer):
    """Membership of points, and the affine map of each region, applied to features less the scene's mean."""

    centre: Annotated[Tensor, "C"]
    table: Annotated[Tensor, "K T"]
    matrix: Annotated[Tensor, "K C C"] | Annotated[Tensor, "K C"]
    """A of each region; for AdaIN its diagonal."""
    bias: Annotated[Tensor, "K C"]

    def __init__(self, dictionary: StyleDictionary, scene: SceneStyle, config: RegionConfig) -> None:
        super().__init__()
        check_fit(dictionary, scene)
        # Both sides are matched, blended and smoothed alike: the scene with itself, then with the references.
        own = own_style(scene, dictionary.blend)._replace(origin=dictionary.origin)
        same = region_table(scene, own, config)
        table = region_table(scene, dictionary, config)
        smoothing = config.smoothing(scene, dictionary.allowed)
        if smoothing is not None:
            same = smoothing @ same
            table = smoothing @ table
        mean, sigma, covariance = mixed_codes(own, same)
        style_mean, style_sigma, style_covariance = mixed_codes(dictionary, table)
        if len(table) == 1:
            # An undivided scene gets the global style: codes taken together, with what lies between them.
            if dictionary.allowed is None:
                left = dictionary
            else:
                left = choose(dictionary, dictionary.allowed[0])[0]
            style_mean, style_covariance = (part[None] for part in whole_style(left))
            style_sigma = deviation(style_mean, style_covariance.diagonal(dim1=-2, dim2=-1))
        # A and b: optimal transport of all channels, or AdaIN (paper), sigma_s / sigma_c of each; nothing
        # more than `gain`.
        away = mean - double(scene.mean)
        if config.transport:
            matrix = monge(covariance, style_covariance, gain=config.gain)
            bias = style_mean - torch.einsum("kc,kcd->kd", away, matrix)
        else:
            matrix = (style_sigma / sigma).clamp_max(config.gain)
            bias = style_mean - away * matrix
        self.membership = Membership(scene.keys, scene.semantic_mean)
        self.register_buffer("centre", scene.mean.float())
        self.register_buffer("table", table.to(scene.mean))
        self.register_buffer("matrix", matrix.to(scene.mean))
        self.register_buffer("bias", bias.to(scene.mean))

    @property
    def needs(self) -> Want:
        if self.membership.divided:
            return Want.CONTENT | Want.SEMANTIC
        return Want.CONTENT

    def forward(
        self, content: Annotated[Tensor, "N C"], semantic: Annotated[Tensor, "N D"] | None
    ) -> Annotated[Tensor, "N C"]:
        """Each point by the maps of the regions that it belongs to."""
        return self.shared(content, semantic)[0]

    def shared(
        self, content: Annotated[Tensor, "N C"], semantic: Annotated[Tensor, "N D"] | None
    ) -> tuple[Annotated[Tensor, "N C"], Annotated[Tensor, "N K"]]:
        """`forward`, and the regions that points belong to."""
        share = self.membership(content[:, :0] if semantic is None else semantic)
        features = content.to(self.centre)
        if self.matrix.ndim == 2:
            styled = mixed_gains(features, self.centre, share, self.matrix, self.bias)
        else:
            styled = mixed_maps(features, share, self.matrix, self.bias, centre=self.centre)
        return styled.to(content), share

    def match(self, semantic: Annotated[Tensor, "N D"]) -> Annotated[Tensor, "N T"]:
        share: Tensor = self.membership(semantic)
        return share @ self.table

    def region_match(self, keys: Annotated[Tensor, "K D"]) -> Annotated[Tensor, "K T"]:
        """The table itself."""
        return self.table
