import math

import torch
from hypothesis import given
from hypothesis import strategies as st

from fprf.rendering.splines import catmull_rom, quaternions, rotations, slerp


def turn(axis: torch.Tensor, angle: float) -> torch.Tensor:
    """Rodrigues' formula."""
    x, y, z = torch.nn.functional.normalize(axis, dim=-1).tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64) + math.sin(angle) * cross + 2 * math.sin(angle / 2) ** 2 * cross @ cross


def axis(seed: int) -> torch.Tensor:
    return torch.randn(3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@given(st.integers(0, 10_000), st.floats(-math.pi, math.pi) | st.sampled_from([0.0, 1e-9, math.pi, math.pi - 1e-9]))
def test_quaternions_round_trip(seed: int, angle: float) -> None:
    rotation = turn(axis(seed), angle)[None]
    quaternion = quaternions(rotation)
    assert abs(float(quaternion.norm()) - 1) < 1e-14
    torch.testing.assert_close(rotations(quaternion), rotation, atol=1e-13, rtol=0)
    torch.testing.assert_close(rotations(-3 * quaternion), rotation, atol=1e-13, rtol=0)


@given(st.integers(0, 10_000), st.floats(1e-12, math.pi - 1e-6) | st.just(0.0), st.floats(0, 1), st.booleans())
def test_slerp_is_the_part_of_the_turn(seed: int, angle: float, u: float, flip: bool) -> None:
    start = turn(axis(seed + 1), 1.3)
    ends = quaternions(torch.stack([start, start @ turn(axis(seed), angle)]))
    found = slerp(ends[:1], -ends[1:] if flip else ends[1:], torch.tensor([u], dtype=torch.float64))
    assert abs(float(found.norm()) - 1) < 1e-12
    torch.testing.assert_close(rotations(found)[0], start @ turn(axis(seed), u * angle), atol=1e-9, rtol=0)


@given(st.integers(2, 6), st.integers(0, 1000))
def test_catmull_rom_passes_through_keys_with_one_velocity(count: int, seed: int) -> None:
    keys = torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    gaps = torch.arange(count - 1)
    torch.testing.assert_close(catmull_rom(keys, gaps, torch.zeros(count - 1).double()), keys[:-1])
    ends = torch.full((count - 1,), 1 - 1e-12, dtype=torch.float64)
    torch.testing.assert_close(catmull_rom(keys, gaps, ends), keys[1:], atol=1e-10, rtol=0)
    step = 1e-6
    before = keys[1:-1] - catmull_rom(keys, gaps[:-1], torch.full((count - 2,), 1 - step, dtype=torch.float64))
    after = catmull_rom(keys, gaps[1:], torch.full((count - 2,), step, dtype=torch.float64)) - keys[1:-1]
    torch.testing.assert_close(before / step, after / step, atol=1e-4, rtol=0)


@given(st.lists(st.floats(0, 10) | st.just(0.0), min_size=2, max_size=6))
def test_catmull_rom_never_turns_back_on_a_line(distances: list[float]) -> None:
    along = torch.tensor([0.0, *distances], dtype=torch.float64).cumsum(0)
    keys = along[:, None] * torch.tensor([1.0, -1, 2], dtype=torch.float64)
    u = torch.linspace(0, 1, 40, dtype=torch.float64).repeat(len(distances))
    gaps = torch.arange(len(distances)).repeat_interleave(40)
    assert float(catmull_rom(keys, gaps, u)[:, 0].diff().min()) > -1e-12
