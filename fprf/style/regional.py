"""Regions that may take from some of the references alone (pinned, or forbidden one).

A region that is pinned to a reference looks as it would if that were the only one, whatever the stylizer, and by its own
matching. Stylizers that are made of regions heed the choice themselves, at no cost. No other needs to know of it: each choice
gets a stylizer of its own, and a point takes of each as much as it belongs to its regions.
"""

from typing import TYPE_CHECKING, Annotated

import torch
from torch import Tensor, nn

from ..interfaces import Stylizer
from ..types import Want
from .dictionary import StyleDictionary, choose
from .scene import Membership, SceneStyle

if TYPE_CHECKING:
    from ..plugins.stylizers.config import StylizerConfig


def regional(
    dictionary: StyleDictionary, scene: SceneStyle, allowed: Annotated[Tensor, "K references"], config: "StylizerConfig"
) -> Stylizer:
    """The stylizer that heeds which references each region may take from; that of all of them where nothing is excluded."""
    if bool(allowed.all()):
        return config.build(dictionary=dictionary, scene=scene)
    if config.handles_allowed_references:
        return config.build(dictionary=dictionary._replace(allowed=allowed), scene=scene)
    rows = [tuple(row) for row in allowed.tolist()]
    choices = sorted(set(rows))
    made = [choose(dictionary, torch.tensor(chosen)) for chosen in choices]
    codes, of = torch.stack([codes for _, codes in made]), torch.tensor([choices.index(row) for row in rows])
    return RegionStylizer(scene, [config.build(dictionary=part, scene=scene) for part, _ in made], codes, of)


class RegionWeight(nn.Module):
    """One number a region, at points: by how much they belong to each."""

    values: Annotated[Tensor, "K X"]

    def __init__(self, scene: SceneStyle, values: Annotated[Tensor, "K X"]) -> None:
        super().__init__()
        self.membership = Membership(scene)
        self.register_buffer("values", values.float())

    def forward(
        self, semantic: Annotated[Tensor, "N D"], belongs: Annotated[Tensor, "N K"] | None = None
    ) -> Annotated[Tensor, "N X"]:
        """The values, mixed by membership (`belongs`, where it is known): exactly 0 where all of a point's regions have 0."""
        share: Tensor = self.membership(semantic) if belongs is None else belongs
        return share.to(self.values) @ self.values


class RegionStylizer(Stylizer):
    """P stylizers, each for the regions of one choice of references."""

    codes: Annotated[Tensor, "P T"]

    def __init__(
        self,
        scene: SceneStyle,
        parts: list[Stylizer],
        codes: Annotated[Tensor, "P T"],
        of: Annotated[Tensor, "K"],
    ) -> None:
        super().__init__()
        self.parts = nn.ModuleList(parts)
        self.weight = RegionWeight(scene, nn.functional.one_hot(of, len(parts)))
        self.register_buffer("codes", codes)
        self.alone = len(parts) == 1

    @property
    def needs(self) -> Want:
        return self._part(0).needs if self.alone else Want.CONTENT | Want.SEMANTIC

    def forward(self, content: Annotated[Tensor, "N C"], semantic: Annotated[Tensor, "N D"] | None) -> Annotated[Tensor, "N C"]:
        """Each point by the stylizers of its regions; the others are not called for it."""
        if self.alone:
            only: Tensor = self._part(0)(content, semantic)
            return only
        assert semantic is not None, "Want.SEMANTIC was asked for"
        share = self.weight(semantic).to(content)
        out = torch.zeros_like(content)
        for p, column in enumerate(share.T.contiguous()):
            inside = column.nonzero().squeeze(1)
            styled: Tensor = self._part(p)(content.index_select(0, inside), semantic.index_select(0, inside))
            out.index_add_(0, inside, styled * column.index_select(0, inside)[:, None])
        return out

    def match(self, semantic: Annotated[Tensor, "N D"]) -> Annotated[Tensor, "N T"]:
        """The parts' own matches, each in its place among the codes of all references."""
        share = semantic.new_ones(len(semantic), 1) if self.alone else self.weight(semantic)
        out = share.new_zeros(len(semantic), self.codes.shape[1])
        for p in range(len(self.parts)):
            out[:, self.codes[p]] += share[:, p, None] * self._part(p).match(semantic)
        return out

    def _part(self, p: int) -> Stylizer:
        part = self.parts[p]
        assert isinstance(part, Stylizer)  # nn.ModuleList forgets it
        return part
