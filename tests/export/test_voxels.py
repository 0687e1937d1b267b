import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.export.point_cloud import LEVELS, SPAN, cells, finest_only, keys, pooled, spacing

seeds = st.integers(0, 2**31)


def drawn(seed: int, *shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@settings(deadline=None, max_examples=30)
@given(seed=seeds)
def test_keys_tell_voxels_and_levels_apart(seed: int) -> None:
    draw = torch.Generator().manual_seed(seed)
    cell = torch.randint(-2, 2, (60, 3), generator=draw) * torch.tensor([1, SPAN // 2 - 1, SPAN - 2]).roll(seed % 3)
    cell = cell.clamp(-SPAN + 1, SPAN - 1)
    level = torch.randint(0, LEVELS, (60,), generator=draw)
    key = keys(cell, level)
    same = (cell[:, None] == cell).all(-1) & (level[:, None] == level)
    assert torch.equal(key[:, None] == key, same)


def test_cells_are_floors() -> None:
    points = torch.tensor([[0.0, 0.99, -0.01], [1.0, -1.0, 2.5]], dtype=torch.float64)
    assert cells(points, 1.0).tolist() == [[0, 0, -1], [1, -1, 2]]
    assert cells(points, torch.tensor([0.5, 2.0], dtype=torch.float64)).tolist() == [[0, 1, -1], [0, -1, 1]]


@settings(deadline=None, max_examples=30)
@given(seed=seeds)
def test_pooled_is_the_weighted_mean_of_each_group(seed: int) -> None:
    group = torch.randint(0, 5, (40,), generator=torch.Generator().manual_seed(seed))
    values, weight = drawn(seed, 40, 3), drawn(seed + 1, 40) + 0.1
    mean = pooled(group, values, weight, 5)
    for k in range(5):
        mine = group == k
        if bool(mine.any()):
            expected = (values[mine] * weight[mine, None]).sum(0) / weight[mine].sum()
            assert torch.allclose(mean[k], expected, atol=1e-12)


@settings(deadline=None, max_examples=30)
@given(seed=seeds)
def test_coarse_points_give_way_to_finer_ones_in_their_voxel(seed: int) -> None:
    points = drawn(seed, 60, 3) * 8
    level = torch.randint(0, 3, (60,), generator=torch.Generator().manual_seed(seed))
    alone = finest_only(points, level, 1.0)
    for i in range(60):
        edge = 2.0 ** int(level[i])
        inside = (torch.floor(points / edge) == torch.floor(points[i] / edge)).all(-1)
        assert bool(alone[i]) == (not bool((inside & (level < level[i])).any()))


@settings(deadline=None, max_examples=30)
@given(seed=seeds, edge=st.sampled_from([0.5, 1.0, 3.0]))
def test_spacing_is_the_mean_distance_to_the_nearest(seed: int, edge: float) -> None:
    """Against all pairs; one point a voxel, as it is used."""
    cell = torch.unique((drawn(seed, 80, 3) * 5).floor(), dim=0)
    points = (cell + drawn(seed + 1, len(cell), 3)) * edge - 2 * edge
    away = torch.linalg.vector_norm(points[:, None] - points, dim=-1)
    away.fill_diagonal_(torch.inf)
    nearest = torch.where(away <= 2 * edge, away, torch.inf).topk(4, largest=False).values.mean(-1)
    assert torch.allclose(spacing(points, torch.full((len(points),), edge, dtype=torch.float64)), nearest, rtol=1e-12)


def test_spacing_of_two_levels_and_of_a_lonely_point() -> None:
    """A grid of step 1 and one of step 2 far from it; each point's neighbours are looked for at its own size."""
    grid = torch.stack(torch.meshgrid(torch.arange(6.0), torch.arange(6.0), indexing="ij"), -1).view(-1, 2).double()
    fine = torch.cat([grid, torch.zeros(36, 1, dtype=torch.float64)], 1)
    coarse = 2 * fine + torch.tensor([0, 0, 100.0], dtype=torch.float64)
    lonely = torch.tensor([[500.0, 0, 0]], dtype=torch.float64)
    edge = torch.cat([torch.full((36,), 1.0), torch.full((36,), 2.0), torch.tensor([1.0])]).double()
    found = spacing(torch.cat([fine, coarse, lonely]), edge)
    inner = (grid.amin(1) > 0) & (grid.amax(1) < 5)
    assert torch.allclose(found[:36][inner], torch.ones(16, dtype=torch.float64))
    assert torch.allclose(found[36:72][inner], torch.full((16,), 2.0, dtype=torch.float64))
    assert bool(found[-1].isinf())
