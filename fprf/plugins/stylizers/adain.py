"""AdaIN of all points, towards one style or each towards its own mixture of style codes.

Letters: N points, C content channels, D semantic channels, T style codes; F features [N C], mu and sigma
their means and deviations, c of the whole scene, s of a style.

Global (paper, single reference):    sigma_s (F - mu_c) / sigma_c + mu_s
Local (paper, Eq. 5 and 6):          Sigma_w (F - mu_c) / sigma_c + M_w,      M_w = R^S M,  Sigma_w = R^S Sigma

over the codes' means M and deviations Sigma. With dot products, not centred, at the absolute temperature 1,
R^S is the paper's softmax(R).
"""

from typing import Annotated

import torch
from torch import Tensor

from ...interfaces import Stylizer
from ...ops.backend import double
from ...style.dictionary import StyleDictionary, code_odds, whole_style
from ...style.matching import point_shares, score_spread, share_mean, unit
from ...style.scene_style import SceneStyle, check_fit, mixed_gains
from ...style.statistics import deviation
from ...types import Want
from .config import LocalAdainConfig


class AdainStylizer(Stylizer):
    """Local AdaIN; global where the config is None, and with one code or without semantics, which mix alike
    everywhere.
    """

    content_mean: Annotated[Tensor, "C"]
    odds: Annotated[Tensor, "T"]
    style_mean: Annotated[Tensor, "T C"]
    """M of the codes; one row for all of them where nothing is matched, as of `gain`."""
    gain: Annotated[Tensor, "T C"]
    """Sigma / sigma_c of each code."""
    keys: Annotated[Tensor, "T D"]
    prior: Annotated[Tensor, "T"]
    centre: Annotated[Tensor, "D"] | None
    """Origin of directions; None for dot products."""
    origin: Annotated[Tensor, "D"] | None
    """The encoder's zero, for dot products of features as it gives them."""

    def __init__(
        self, dictionary: StyleDictionary, scene: SceneStyle, config: LocalAdainConfig | None
    ) -> None:
        super().__init__()
        odds = code_odds(dictionary).to(dictionary.keys)
        mean = double(dictionary.mean)
        covariance = double(dictionary.covariance)
        self.matched = config is not None and len(dictionary.keys) > 1 and dictionary.keys.shape[1] > 0
        if config is not None:
            check_fit(dictionary, scene)
        if config is not None and self.matched:
            # Both sides, such that their inner products are the scores R (paper, Eq. 5).
            theirs = share_mean(dictionary.keys, odds)
            if dictionary.origin is None:
                zero = torch.zeros_like(scene.semantic_mean)
            else:
                zero = dictionary.origin
            if config.centred:
                centre = scene.semantic_mean
            else:
                centre = zero
            cosine = config.similarity == "cosine"
            if cosine:
                queries = unit(scene.keys, centre)
                keys = unit(dictionary.keys, theirs if config.centred else zero)
            else:
                # Softmax does not see what is subtracted from all keys; the smaller numbers round less.
                if config.centred:
                    queries = scene.keys
                else:
                    queries = scene.keys - zero
                keys = dictionary.keys - theirs
            # The only region of an undivided scene lies at its mean, where it says nothing about scores.
            if config.relative:
                spread = score_spread(queries if len(queries) > 1 else keys, keys)
            else:
                spread = 1.0
            self.temperature = config.temperature * spread
            self.register_buffer("keys", keys.float())
            self.register_buffer("prior", (dictionary.weight / dictionary.weight.amax()).float())
            self.register_buffer("centre", centre.float() if cosine else None)
            self.register_buffer("origin", None if cosine or config.centred else zero.float())
        else:
            mean, covariance = (part[None] for part in whole_style(dictionary))
        scene_sigma = deviation(double(scene.mean), double(scene.covariance).diagonal())
        gain = deviation(mean, covariance.diagonal(dim1=-2, dim2=-1)) / scene_sigma
        self.register_buffer("content_mean", scene.mean.float())
        self.register_buffer("odds", odds.float())
        self.register_buffer("style_mean", mean.to(scene.mean.device).float())
        self.register_buffer("gain", gain.to(scene.mean.device).float())

    @property
    def needs(self) -> Want:
        if self.matched:
            return Want.CONTENT | Want.SEMANTIC
        return Want.CONTENT

    def forward(
        self, content: Annotated[Tensor, "N C"], semantic: Annotated[Tensor, "N D"] | None
    ) -> Annotated[Tensor, "N C"]:
        """AdaIN; the mean is subtracted first, since a x + b loses digits where the mean is large."""
        features = content.to(self.gain)
        if self.matched:
            assert semantic is not None, "Want.SEMANTIC was asked for"
            share = self.match(semantic)
            styled = mixed_gains(features, self.content_mean, share, self.gain, self.style_mean)
        else:
            styled = (features - self.content_mean) * self.gain + self.style_mean
        return styled.to(content)

    def match(self, semantic: Annotated[Tensor, "N D"]) -> Annotated[Tensor, "N T"]:
        if not self.matched:
            return self.odds.expand(len(semantic), -1)
        query = semantic.to(self.keys)
        if self.origin is not None:
            query = query - self.origin
        return point_shares(query, self.keys, self.temperature, centre=self.centre, prior=self.prior)
