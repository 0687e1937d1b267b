"""How bright and how coloured each view was taken: a factor a channel and view, learnt with the scene, which stays free of it.

Cameras expose anew in every picture. Without factors the scene learns the mean of all, and floaters for the rest. Factors
apply to rendered colours (sRGB), never to features or density: styles know nothing of them. Known exposures enter through one
learnt exponent; what they leave is free, and sums to nothing over the training views: the scene itself is their mean.

Blocks do not learn factors: they use those that their surroundings have learnt on everything. So all blocks mean the same by a
view's light, and nothing has to be matched between them afterwards.
"""

from typing import Annotated

import torch
from torch import Tensor, nn

from ..datamanagers.scene import GAMMA
from ..types import Rendered

__all__ = ["Tones", "relative", "toned"]


class Tones(nn.Module):
    """Factors of V views."""

    exposure: Tensor
    learned: Tensor

    def __init__(self, exposure: Annotated[Tensor, "V"], held: tuple[int, ...]) -> None:
        """`exposure` is `relative`; `held` are views that are not learnt from."""
        super().__init__()
        views = len(exposure)
        self.gain = nn.Parameter(torch.zeros(views, 3))
        self.exponent = nn.Parameter(torch.tensor(GAMMA))
        learned = torch.ones(views, 1)
        learned[list(held)] = 0
        self.register_buffer("exposure", exposure.float(), persistent=False)
        self.register_buffer("learned", learned, persistent=False)

    def forward(self, view: Annotated[Tensor, "R"]) -> Annotated[Tensor, "R 3"]:
        """Factors of views; of one that is not learnt from, what its exposure alone says."""
        centre = (self.gain * self.learned).sum(0) / self.learned.sum().clamp_min(1)
        free = (self.gain - centre) * self.learned
        at = view.to(self.gain.device)
        return torch.exp(free.index_select(0, at) + self.exponent * self.exposure.index_select(0, at)[:, None])

    def mixed(self, views: tuple[int, ...], weights: tuple[float, ...]) -> Annotated[Tensor, "3"]:
        """Factors between those of some views, weighted; weights sum to 1. Means are taken of logarithms."""
        factor = self(torch.tensor(views)).log()
        between: Tensor = (factor * torch.tensor(weights).to(factor)[:, None]).sum(0)
        return between.exp()


def relative(exposure: Annotated[Tensor, "V"] | None, views: int) -> tuple[float, ...]:
    """Logarithm of each view's exposure over their geometric mean; zeros where nothing is known."""
    if exposure is None:
        return (0.0,) * views
    log = exposure.double().log()
    return tuple((log - log.mean()).tolist())


def toned(rendered: Rendered, tones: Tones | None, view: Annotated[Tensor, "R"]) -> Rendered:
    """The render as the cameras of its rays took it."""
    if tones is None or rendered.rgb is None:
        return rendered
    factor = tones(view)
    frozen_rgb = None if rendered.frozen_rgb is None else rendered.frozen_rgb * factor
    return rendered._replace(rgb=rendered.rgb * factor, frozen_rgb=frozen_rgb)
