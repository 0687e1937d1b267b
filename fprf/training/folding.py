"""The keys of a style dictionary multiplied into the last layer of the semantic field, where matching is linear.

Scores of dot products (paper, Eq. 5) are R = X K^T with X = H W^T for hidden units H: R = H (K W)^T. The field then gives T
scores in place of D features, nothing of size D is computed, and the matching multiplies by nothing. The algebra is exact: what
differs is rounding.

In the terms of the folded field, the key of code t is the t-th unit vector. Nothing else of the stylizer changes, so it is
built by its own config from a dictionary and a scene that are projected alike. Cosines need the length of the features
too, which costs as much as the features: they are not folded.
"""

from dataclasses import replace
from typing import NamedTuple

import torch

from ..plugins.stylizers.config import StylizerConfig
from ..style.dictionary import code_odds
from ..style.look import Restyle
from ..style.matching import share_mean
from .model import Model
from .restyle import Styled

__all__ = ["Folded", "folded"]


class Folded(NamedTuple):
    """A model and a look that belong together: neither means anything with another."""

    model: Model
    look: Restyle


@torch.no_grad()
def folded(model: Model, styled: Styled, config: StylizerConfig) -> Folded | None:
    """The same pictures for less; None where nothing can be folded, or nothing would be saved.

    `config` is that of the style's stylizer. Looks that read semantics besides (strengths or colours by region, mixes of
    styles, references that some regions may not take) stay as they are.
    """
    look, dictionary, scene = styled.restyle, styled.dictionary, styled.scene
    reads_more = look.regions is not None or look.colours is not None or look.others or not bool(styled.orders.allowed.all())
    if model.semantic is None or not config.reads_products or reads_more or len(dictionary.keys) < 2:
        return None
    # Softmax does not see what is subtracted from all keys; the smaller numbers round less.
    directions = (dictionary.keys - share_mean(dictionary.keys, code_odds(dictionary).to(dictionary.keys))).T
    device = model.device
    field = model.semantic.projected(directions.to(device))
    if field is None:
        return None
    origin = None if dictionary.origin is None else dictionary.origin @ directions
    stylizer = config.build(
        dictionary=dictionary._replace(keys=torch.eye(directions.shape[1]).to(dictionary.keys), origin=origin),
        scene=scene._replace(keys=scene.keys @ directions, semantic_mean=scene.semantic_mean @ directions),
    )
    return Folded(
        Model(model.parts._replace(semantic=field)).to(device).eval(), replace(look, stylizer=stylizer.to(device).eval())
    )
