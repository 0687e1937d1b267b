import torch
from fprf_gabor import OpacityConfig

from fprf.interfaces import LossTerm
from fprf.testing import cases, check_loss_term
from fprf.types import Rendered


def test_keeps_to_the_contract() -> None:
    check_loss_term(OpacityConfig())


def test_half_transparent_rays_cost_most() -> None:
    term = OpacityConfig().build()
    nothing = torch.zeros(3)
    assert isinstance(term, LossTerm)
    for share, cost in ((0.0, 0.0), (0.125, 0.75), (0.25, 1.0), (0.375, 0.75), (0.5, 0.0)):
        rendered = Rendered(nothing, nothing, weights=torch.full((3, 2), share))
        assert float(term(rendered, cases.batch(3), cases.parts(), step=0, generator=None)) == cost
