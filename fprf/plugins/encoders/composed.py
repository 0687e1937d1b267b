"""Several encoders side by side: what they see together, each counting by its weight whatever its units and
channels.

A part's unit is the root mean square length of its centred features on five views of a rendered town
(`street`), so that an image's features depend on the image alone. On photographs the units of nine encoders
were 0.7 to 1.3 of that (measured;
0.4 to 1.5 with noise of a photograph's spectrum in the town's place).
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ...interfaces import Encoder
from .frozen import FrozenEncoder, freeze, street

Cells = Literal["finest", "first"]
DIGITS = 3
"""Of a unit: more would differ between machines, and with them the identity."""


class ConcatEncoder(FrozenEncoder):
    """`parts` side by side, each divided by its `unit` and multiplied by its weight."""

    def __init__(
        self,
        parts: Sequence[Encoder],
        weights: Sequence[float],
        units: Sequence[float],
        *,
        cells: Cells = "finest",
    ) -> None:
        # Weights and units are part of the identity.
        names = []
        for weight, unit, part in zip(weights, units, parts, strict=True):
            names.append(f"{weight!r}/{unit!r}*[{part.identity}]")
        if cells == "finest":
            kind = "concat:"
        else:
            kind = f"concat:{cells}:"
        super().__init__(kind + "+".join(names), sum(part.channels for part in parts))
        self._cells = cells
        self.parts = nn.ModuleList(parts)
        self._encoders = tuple(parts)
        self._factors = [weight / unit for weight, unit in zip(weights, units, strict=True)]
        freeze(self)

    @torch.no_grad()
    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B C h w"]:
        """Features on the cells of the finest part, or of the first; coarser ones are interpolated, finer
        ones averaged.
        """
        return self._side_by_side([part(image) for part in self._encoders])

    @torch.no_grad()
    def cutout(
        self, image: Annotated[Tensor, "B 3 H W"], opacity: Annotated[Tensor, "B H W"]
    ) -> Annotated[Tensor, "B C h w"]:
        """Each part leaves the backdrop out as it can."""
        return self._side_by_side([part.cutout(image, opacity) for part in self._encoders])

    def _side_by_side(self, maps: Sequence[Annotated[Tensor, "B C h w"]]) -> Annotated[Tensor, "B C h w"]:
        maps = [each * factor for each, factor in zip(maps, self._factors, strict=True)]
        if self._cells == "first":
            size = maps[0].shape[2:]
            # Finer maps are averaged over the cells of the first, coarser ones interpolated.
            least = []
            for each in maps:
                least.append((min(each.shape[2], size[0]), min(each.shape[3], size[1])))
            maps = [F.adaptive_avg_pool2d(each, cells) for each, cells in zip(maps, least, strict=True)]
            parts = []
            for each in maps:
                parts.append(F.interpolate(each, size, mode="bilinear"))
            return torch.cat(parts, dim=1)
        height = max(each.shape[2] for each in maps)
        width = max(each.shape[3] for each in maps)
        size = torch.Size((height, width))
        fine = []
        for each in maps:
            fine.append(each if each.shape[2:] == size else F.interpolate(each, size, mode="bilinear"))
        return torch.cat(fine, dim=1)


UNITS: Mapping[str, float] = {
    "dinov2-small:block9:tokens:cells22:baafd5682cf3": 3.23,
    "bundled-semantic:f3992247b7b2": 5.84,
}
"""Units of the encoders that are semantics by default, by identity: to measure them takes a second."""


def build_concat(parts: Sequence[Encoder], weights: Sequence[float], *, cells: Cells) -> ConcatEncoder:
    """The encoder, the parts' units measured where they are not known."""
    units = []
    for part in parts:
        units.append(UNITS[part.identity] if part.identity in UNITS else unit_of(part, street()))
    return ConcatEncoder(parts, weights, units, cells=cells)


def unit_of(encoder: Encoder, images: Annotated[Tensor, "B 3 H W"]) -> float:
    """Root mean square length of the encoder's features about their mean, rounded; 1 where they don't change
    at all.
    """
    # Over cells, of the vector of all channels.
    features: Tensor = encoder(images).double()
    length = float((features - features.mean(dim=(0, 2, 3), keepdim=True)).square().sum(dim=1).mean().sqrt())
    return float(f"{length:.{DIGITS}g}") or 1.0
