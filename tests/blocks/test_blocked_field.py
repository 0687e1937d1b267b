"""Fields of blocks against a plain loop, seams, gradients; routers and weights: a partition of unity,
continuous, local.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from block_scenes import cell, grid, points_around, row
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from fprf.blocks.fields import (
    BlockedField,
    BlockedSampler,
    BlockedSemantic,
    Member,
    ResidentMembers,
    emission,
    inherit,
)
from fprf.blocks.routing import (
    BlendRouter,
    Chart,
    Group,
    InsetRouter,
    chart_of,
    shares,
    surroundings_of,
    to_single,
    window,
)
from fprf.fields.config import PlanesConfig, SemanticPlanesConfig
from fprf.fields.planes import Planes
from fprf.plugins.samplers.config import ProposalConfig
from fprf.rendering.space import Space
from fprf.types import Cell, Rays

CHANNELS = 5
DIMS = 4
EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
SPACE = Space("open", (0.0, 0.0, 0.0), EYE, 1.0, 0.05, 1e3)


SAMPLER = ProposalConfig(samples=(12, 10), final=8, resolutions=(4, 8), channels=8)


def member(chart: Chart, seed: int, resolutions: tuple[int, int] = (4, 8)) -> Member:
    field = PlanesConfig(resolutions=resolutions, channels=8, hidden=16, layers=1)
    semantic = SemanticPlanesConfig(resolutions=resolutions[:1], channels=8, hidden=16, layers=1)
    sampler = replace(SAMPLER, resolutions=resolutions).build(seed=seed)
    return Member(
        chart, sampler, field.build(channels=CHANNELS, seed=seed), semantic.build(channels=DIMS, seed=seed)
    )


def members(cells: list[Cell], spread: float = 3.0) -> list[Member]:
    """One a block and one for the surroundings, with densities that differ widely."""
    charts = [*(chart_of(cell) for cell in cells), surroundings_of(cells)]
    made = [member(chart, number) for number, chart in enumerate(charts)]
    with torch.no_grad():
        for number, each in enumerate(made):
            each.field.get_parameter("to_density.weight").mul_(spread * (number + 1))
    return made


class Counting(ResidentMembers):
    """Members that remember who was asked for."""

    asked: set[int]

    def member(self, number: int) -> Member:
        self.asked.add(number)
        return super().member(number)


def plain(
    cells: list[Cell], parts: Sequence[Member], points: Tensor, view: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Density, content and semantics by a loop over points and members."""
    weight = shares(points.double(), cells)
    densities = []
    contents = []
    semantics = []
    for p, v, w in zip(points, view, weight, strict=True):
        sigma = []
        content = []
        semantic = []
        for member in parts:
            at = member.chart.locate(p[None])
            sample = member.field.density(at)
            sigma.append(sample.density[0].double())
            content.append(member.field.content(sample.latent, v[None])[0].double())
            assert member.semantic is not None
            semantic.append(member.semantic(at)[0].double())
        emitted = torch.stack(sigma) * w
        densities.append(emitted.sum())
        contents.append((torch.stack(content) * (emitted / emitted.sum())[:, None]).sum(0))
        semantics.append((torch.stack(semantic) * (emitted / emitted.sum())[:, None]).sum(0))
    return torch.stack(densities), torch.stack(contents), torch.stack(semantics)


@torch.no_grad()
def test_against_a_loop() -> None:
    cells = row(3)
    parts = members(cells)
    points = points_around(cells, 150)
    view = torch.nn.functional.normalize(torch.randn(150, 3), dim=1)
    held = ResidentMembers(parts)
    router = BlendRouter(cells)
    field = BlockedField(held, router)
    semantic = BlockedSemantic(held, router)
    sample = field.density(points)
    density, content, semantics = plain(cells, parts, points, view)
    assert torch.allclose(sample.density.double(), density, rtol=3e-5, atol=0)
    assert torch.allclose(field.content(sample.latent, view).double(), content, rtol=1e-4, atol=1e-5)
    assert torch.allclose(semantic(points).double(), semantics, rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_only_the_blocks_that_points_meet_are_asked() -> None:
    cells = row(6)
    counting = Counting(members(cells))
    counting.asked = set()
    field = BlockedField(counting, BlendRouter(cells))
    semantic = BlockedSemantic(counting, BlendRouter(cells))
    points = torch.tensor([[3.0, 0.0, 0.7], [3.9, 0.1, 0.7]])
    field.content(field.density(points).latent, torch.eye(3)[:2])
    semantic(points)
    assert counting.asked == {1, 2}


def test_emission_is_exact_over_thirty_orders_of_magnitude() -> None:
    density = torch.tensor([[1e-30, 3e6], [0.0, 0.0], [1e-30, 3e-30], [5.0, 0.0], [float("inf"), 1.0]])
    weight = torch.tensor([[0.5, 0.5], [0.3, 0.7], [0.5, 0.5], [1e-6, 1 - 1e-6], [0.5, 0.5]])
    found = emission(density.clamp(max=3e6), weight)
    assert torch.allclose(found.sum(1), torch.ones(5), atol=1e-6)
    assert found[0].tolist() == pytest.approx([0.0, 1.0])
    assert found[1].tolist() == pytest.approx([0.3, 0.7]), "nothing anywhere: by weight alone"
    assert found[2].tolist() == pytest.approx([0.25, 0.75], rel=1e-5)
    assert float(found[3, 0]) == pytest.approx(1.0), "who finds a place empty has no say about it"
    assert emission(density[:1], torch.tensor([[1.0, 0.0]])).tolist() == [[1.0, 0.0]]


def test_an_inset_block_learns_inside_and_its_surroundings_outside() -> None:
    cells = row(2)
    parts = members(cells)
    chart = chart_of(cells[0])
    field = BlockedField(ResidentMembers([parts[0], parts[2]]), InsetRouter(chart))
    points = points_around(cells, 200)
    inside = chart.inside(points)
    view = torch.nn.functional.normalize(torch.randn(200, 3), dim=1)
    for chosen, learns, rests in ((inside, 0, 1), (~inside, 1, 0)):
        field.zero_grad()
        sample = field.density(points)
        features = field.content(sample.latent, view)
        (sample.density[chosen].sum() + features[chosen].sum()).backward()
        touched = [
            sum(float(p.grad.abs().sum()) for p in m.field.parameters() if p.grad is not None)
            for m in field.members.held
        ]
        assert touched[learns] > 0 and touched[rests] == 0


def rays(count: int = 20) -> Rays:
    direction = torch.nn.functional.normalize(torch.randn(count, 3), dim=1)
    origin = torch.tensor([[1.0, 0.0, 0.5]]).expand(count, 3)
    return Rays(origin, direction, direction, torch.full((count,), 0.05), torch.full((count,), 1e3))


def test_the_sampler_asks_the_blocks_where_to_look() -> None:
    """One member everywhere is the sampler itself; blocks that differ give other edges."""
    cells = row(1)
    parts = members(cells)

    class Charted(nn.Module):
        def __init__(self, inner: nn.Module) -> None:
            super().__init__()
            self.inner = inner

        def forward(self, points: Tensor) -> Tensor:
            out: Tensor = self.inner(parts[1].chart.locate(points))
            return out

    itself = SAMPLER.build(seed=1)
    for level in range(2):
        itself.fields[level] = Charted(parts[1].sampler.fields[level])
    r = rays()
    lone = BlockedSampler(SAMPLER.build(seed=9), ResidentMembers([parts[1]]), to_single)
    found = lone(r, space=SPACE, step=0, generator=None)
    wanted = itself(r, space=SPACE, step=0, generator=None)
    assert torch.equal(found.t, wanted.t) and len(found.levels) == len(wanted.levels) == 2
    blended = BlockedSampler(SAMPLER.build(seed=9), ResidentMembers(parts), BlendRouter(cells))(
        r, space=SPACE, step=0, generator=None
    )
    assert not torch.equal(blended.t, wanted.t) and bool((blended.t[:, 1:] >= blended.t[:, :-1]).all())


def smooth(part: nn.Module) -> None:
    """Planes that change slowly: their bilinear samples at finer nodes are then near what lies between."""
    draw = torch.Generator().manual_seed(3)
    for module in part.modules():
        if isinstance(module, Planes):
            tables = []
            for r in module.resolutions:
                at = torch.linspace(-1, 1, r)
                for _ in range(3):
                    a, b = torch.rand(2, module.table.shape[1], generator=draw)
                    tables.append(
                        (0.4 + 0.1 * a * at[:, None, None] + 0.1 * b * at[None, :, None]).reshape(r * r, -1)
                    )
            with torch.no_grad():
                module.table.copy_(torch.cat(tables))


@pytest.mark.parametrize("block", [0, 1])
def test_a_block_says_what_its_surroundings_say(block: int) -> None:
    cells = row(3, 0.2)
    around = member(surroundings_of(cells), 0, (9, 17))
    own = member(chart_of(cells[block]), 7, (9, 17))
    smooth(around)
    inherit(own, around)
    points = points_around(cells, 2000)
    # Within the bounds of all blocks the contraction is linear, and so are these planes: nothing is lost.
    inner = points[around.chart.inside(points) & own.chart.inside(points)]
    assert len(inner) > 100
    mine = own.field.density(own.chart.locate(inner))
    theirs = around.field.density(around.chart.locate(inner))
    torch.testing.assert_close(mine.density, theirs.density, rtol=2e-3, atol=1e-5)
    view = torch.nn.functional.normalize(torch.randn(len(inner), 3), dim=-1)
    torch.testing.assert_close(
        own.field.content(mine.latent, view), around.field.content(theirs.latent, view), rtol=1e-3, atol=1e-3
    )
    assert own.semantic is not None and around.semantic is not None
    torch.testing.assert_close(
        own.semantic(own.chart.locate(inner)),
        around.semantic(around.chart.locate(inner)),
        rtol=1e-3,
        atol=1e-3,
    )
    first, second = (each.sampler.fields[0](each.chart.locate(inner)) for each in (own, around))
    torch.testing.assert_close(first, second, rtol=2e-3, atol=1e-5)


UNEVEN = [
    cell((0, 0, 0), (2, 3, 1), 0.25),
    cell((2, 0, 0), (5, 1, 1), 0.25),
    cell((2, 1, 0), (5, 3, 1), 0.25),
]
"""As bisection leaves them: a face of one is shared by two."""


def dense(groups: list[Group], points: int, members: int) -> torch.Tensor:
    """Groups as a table of weights."""
    weight = torch.zeros(points, members, dtype=torch.float64)
    for group in groups:
        columns = torch.tensor(group.members)
        share = torch.ones(len(group.at), 1) if group.weight is None else group.weight
        weight[group.at[:, None], columns[None]] = share.double()
    return weight


@settings(max_examples=5, deadline=None)
@given(st.sampled_from([row(1), row(4), row(3, 0.9), grid(3, 3), UNEVEN]), st.integers(0, 2**31 - 1))
def test_blending_is_what_the_windows_say(cells: list[Cell], seed: int) -> None:
    points = points_around(cells, 400, seed)
    groups = BlendRouter(cells)(points)
    assert sorted(torch.cat([g.at for g in groups]).tolist()) == list(range(400)), "each point in one group"
    found = dense(groups, 400, len(cells) + 1)
    wanted = shares(points, cells).double()
    # What is left out is slight, and float32 windows round by 1e-6 or so of a margin.
    assert float((found - wanted).abs().max()) < 1e-5
    assert torch.allclose(found.sum(1), torch.ones(400).double(), atol=1e-6)
    for group in groups:
        assert (group.weight is None) == (len(group.members) == 1)
        assert bool((group.at[1:] > group.at[:-1]).all()), "ascending"


def test_surroundings_hold_everything_and_blocks_fill_their_inner_half() -> None:
    around = surroundings_of(UNEVEN)
    assert around.contracted
    corners = torch.cat([torch.stack([each.low, each.high]) for each in UNEVEN])
    assert float(around.locate(corners).abs().max()) <= 0.5 + 1e-12
    far = around.locate(torch.tensor([[1e6, 0.0, 0.0], [0.0, -1e20, 3.0]]))
    assert bool((far.abs() <= 1).all()) and float(far[0, 0]) == pytest.approx(1.0, abs=1e-5)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 3), st.integers(1, 3), st.floats(0.01, 0.5), st.integers(0, 2**31 - 1))
def test_weights_sum_to_one_and_need_no_scaling_in_a_grid(
    columns: int, rows: int, border: float, seed: int
) -> None:
    cells = grid(columns, rows, border)
    draw = torch.Generator().manual_seed(seed)
    points = (
        torch.rand(200, 3, dtype=torch.float64, generator=draw)
        * torch.tensor([columns + 2.0, rows + 2.0, 3.0])
        - 1
    )
    weight = shares(points, cells)
    assert weight.shape == (200, columns * rows + 1) and bool((weight >= 0).all())
    assert torch.allclose(weight.sum(1), torch.ones(200, dtype=torch.float64), atol=1e-12)
    bare = torch.stack([window(points, each) for each in cells], 1).sum(1)
    assert bool((bare <= 1 + 1e-12).all()), "windows of cells that share faces never sum to more than 1"
    inside = (points > 2 * border).all(1) & (points < torch.tensor([columns, rows, 1.0]) - 2 * border).all(1)
    assert torch.allclose(bare[inside], torch.ones(int(inside.sum())).double(), atol=1e-12), (
        "no surroundings inside"
    )


@pytest.mark.parametrize("cells", [grid(3, 2), UNEVEN], ids=["grid", "uneven"])
def test_weights_change_no_faster_than_the_borders_allow(cells: list[Cell]) -> None:
    """Steepest slope of a smoothstep over two borders is 3 / (4 b) an axis; scaling at most doubles it."""
    draw = torch.Generator().manual_seed(3)
    start = torch.rand(4000, 3, dtype=torch.float64, generator=draw) * 6 - 2.5
    step = (
        torch.nn.functional.normalize(torch.randn(4000, 3, dtype=torch.float64, generator=draw), dim=1) * 1e-3
    )
    jump = (shares(start + step, cells) - shares(start, cells)).abs().amax(1)
    assert float(jump.max()) <= 1e-3 * math.sqrt(3) * 2 * 0.75 / float(cells[0].border[0]) + 1e-12
    assert float(jump.max()) > 0, "the test crosses a border"
