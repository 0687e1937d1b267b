"""Blocks start as their surroundings are: the same densities, features and proposals at the same places."""

import math

import pytest
import torch
from torch import Tensor, nn

from fprf.blocks.fields import Member, inherit, relay
from fprf.blocks.routing import Chart, chart_of, surroundings_of
from fprf.fields.config import PlanesConfig, SemanticPlanesConfig
from fprf.fields.planes import Planes
from fprf.interfaces import SemanticField
from fprf.plugins.samplers.config import ProposalConfig, UniformConfig
from fprf.types import Boxes

EYE = torch.eye(3, dtype=torch.float64)


def row(count: int = 3, angle: float = 0.0) -> Boxes:
    low = torch.tensor([[2.0 * i, -1.0, 0.0] for i in range(count)], dtype=torch.float64)
    high = torch.tensor([[2.0 * i + 2, 1.0, 1.5] for i in range(count)], dtype=torch.float64)
    c, s = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return Boxes(low, high, turn.expand(count, 3, 3), 0.2)


def member(chart: Chart, seed: int, resolutions: tuple[int, ...] = (9, 17)) -> Member:
    field = PlanesConfig(resolutions=resolutions, channels=8, hidden=16, layers=1).build(channels=5, seed=seed)
    semantic = SemanticPlanesConfig(resolutions=(9,), channels=8, hidden=16, layers=1).build(channels=4, seed=seed)
    sampler = ProposalConfig(samples=(12,), final=8, resolutions=(9,), channels=8).build(seed=seed)
    return Member(chart, sampler, field, semantic)


def smooth(part: nn.Module) -> None:
    """Planes that change slowly: their bilinear samples at finer nodes are then near what lies between."""
    draw = torch.Generator().manual_seed(3)
    for module in part.modules():
        if isinstance(module, Planes):
            tables = []
            for r in module.resolutions:
                at = torch.linspace(-1, 1, r)
                for _ in range(3):
                    a, b, c = (torch.rand(module.table.shape[1], generator=draw) for _ in range(3))
                    tables.append((0.4 + 0.1 * a * at[:, None, None] + 0.1 * b * at[None, :, None] + 0 * c).reshape(r * r, -1))
            with torch.no_grad():
                module.table.copy_(torch.cat(tables))


def points_in(chart: Chart, count: int = 200) -> Tensor:
    cube = torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 2 - 1
    middle, half = (chart.low + chart.high) / 2, (chart.high - chart.low) / 2
    return ((cube * 0.95 * half + middle) @ chart.turn).float()


@pytest.mark.parametrize("block", [0, 1, 2])
def test_a_block_says_what_its_surroundings_say(block: int) -> None:
    boxes = row()
    around, own = member(surroundings_of(boxes), 0), member(chart_of(boxes, block), 7)
    smooth(around)
    inherit(own, around)
    points = points_in(own.chart)
    # Within the bounds of all blocks the contraction is linear, and so are these planes: nothing is lost.
    inner = points[around.chart.inside(points)]
    mine, theirs = own.field.density(own.chart.locate(inner)), around.field.density(around.chart.locate(inner))
    torch.testing.assert_close(mine.density, theirs.density, rtol=2e-3, atol=1e-5)
    view = torch.nn.functional.normalize(torch.randn(len(inner), 3), dim=-1)
    torch.testing.assert_close(
        own.field.content(mine.latent, view), around.field.content(theirs.latent, view), rtol=1e-3, atol=1e-3
    )
    assert own.semantic is not None and around.semantic is not None
    torch.testing.assert_close(
        own.semantic(own.chart.locate(inner)), around.semantic(around.chart.locate(inner)), rtol=1e-3, atol=1e-3
    )
    torch.testing.assert_close(own.proposal(0, inner), around.proposal(0, inner), rtol=2e-3, atol=1e-5)


def test_a_little_turned_chart_is_near_and_a_quarter_turn_is_exact() -> None:
    for angle, tolerance in ((0.05, 0.05), (math.pi / 2, 1e-4)):
        boxes = row(3, angle)
        around, own = member(surroundings_of(boxes), 0), member(chart_of(boxes, 1), 7)
        smooth(around)
        inherit(own, around)
        points = points_in(own.chart)
        inner = points[around.chart.inside(points)]
        mine = own.field.density(own.chart.locate(inner)).density
        theirs = around.field.density(around.chart.locate(inner)).density
        torch.testing.assert_close(mine, theirs, rtol=tolerance, atol=1e-6)


def test_nodes_take_the_old_value_exactly() -> None:
    boxes = row(1)
    chart = Chart(boxes.low[0], boxes.high[0], EYE)
    planes = Planes((5, 9), 4, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(relay(planes, chart, chart), planes.table.detach())


class Odd(SemanticField):
    """A field that keeps something else than planes and linear maps."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.cells = nn.Parameter(torch.rand(4, 4, 4, generator=torch.Generator().manual_seed(seed)))

    def forward(self, points: Tensor) -> Tensor:
        return self.cells.mean() * points

    def penalties(self) -> dict[str, Tensor]:
        return {}


def test_parts_of_another_make_start_from_their_seed() -> None:
    boxes = row()
    around, own = member(surroundings_of(boxes), 0), member(chart_of(boxes, 1), 7)
    around.semantic, own.semantic = Odd(1), Odd(2)
    around.sampler, own.sampler = UniformConfig().build(seed=0), UniformConfig().build(seed=0)
    inherit(own, around)
    assert torch.equal(own.semantic.cells, Odd(2).cells)
    own.semantic = around.semantic = None
    inherit(own, around)
