"""Spaces and local frames: contraction, spacing, NDC against NeRF's formulas, boxes against slabs; origins
far from 0.
"""

import math
from fractions import Fraction
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from fprf.errors import DataError
from fprf.rendering.local_frame import (
    added_and_beside,
    extent_of,
    local_origin,
    offset_file,
    read_offset,
    write_offset,
)
from fprf.rendering.space import Kind, Space, contract

U = 2.0**-24
"""Unit round-off of float32."""
EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
coordinate = st.floats(-(2.0**100), 2.0**100, width=32)


def space_of(kind: Kind, near: float = 0.05, far: float = 1e3, **more: object) -> Space:
    return Space(kind, (0.0, 0.0, 0.0), EYE, 1.0, near, far, **more)  # type: ignore[arg-type]


def rotation(seed: int) -> Tensor:
    draw = torch.Generator().manual_seed(seed)
    turn, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=draw))
    return turn * torch.linalg.det(turn)


def rows(matrix: Tensor) -> tuple[tuple[float, float, float], ...]:
    return tuple((float(a), float(b), float(c)) for a, b, c in matrix)


def contract_oracle(x: list[float]) -> list[float]:
    m = max(abs(v) for v in x)
    return [v / 2 if m <= 1 else (2 - 1 / m) * (v / m) / 2 for v in x]


@given(st.tuples(coordinate, coordinate, coordinate))
def test_contraction_is_the_formula(x: tuple[float, ...]) -> None:
    found = contract(torch.tensor([x]))[0]
    exact = torch.tensor(contract_oracle(list(x)), dtype=torch.float64)
    assert ((found - exact).abs() <= 4 * U * exact.abs() + 1e-38).all()
    assert found.abs().max() <= 1


def spacing_oracle(s: float, near: float, far: float) -> float:
    """g(t) = t/2 up to 1, 1 - 1/(2t) beyond, is linear in s. In fractions of integers there is nothing to
    cancel.
    """

    def g(t: Fraction) -> Fraction:
        return t / 2 if t < 1 else 1 - 1 / (2 * t)

    n = Fraction(near)
    f = Fraction(far)
    at = Fraction(s)
    y = g(n) + (g(f) - g(n)) * at
    return float(2 * y if 2 * y < 1 else 1 / (2 * (1 - y)))


RANGES = [(0.05, 1e3), (1e-3, 1e6), (0.9, 1e6), (2.0, 1e6), (1e-3, 0.5), (0.5, 1.0), (1.0, 2.0), (3.0, 3.0)]


@pytest.mark.parametrize(("near", "far"), RANGES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_spacing_keeps_its_relative_accuracy_and_its_order(
    near: float, far: float, dtype: torch.dtype
) -> None:
    draw = torch.Generator().manual_seed(0)
    s = torch.cat(
        [
            torch.linspace(0, 1, 400),
            torch.rand(300, generator=draw),
            1 - torch.rand(300, generator=draw) * 1e-4,
        ]
    )
    s = s.clamp(0, 1).sort().values.to(dtype)
    n = torch.tensor([near], dtype=dtype)
    f = torch.tensor([far], dtype=dtype)
    t = space_of("contraction").distance(s[None], n, f)[0]
    assert (t.diff() >= 0).all()
    assert abs(float(t[0]) - float(n)) <= 4 * U * near and abs(float(t[-1]) - float(f)) <= 4 * U * far
    for a, b in zip(s.tolist(), t.tolist(), strict=True):
        exact = spacing_oracle(a, float(n), float(f))
        # Relative 1e-6 from the middle outwards; near the eye g's own rounding, u of 1, is what is left.
        assert abs(b - exact) <= 16 * U * exact + 4 * U * min(far, 1.0) * a


def forward_rays(count: int, seed: int, origin: float = 0.3, spread: float = 0.4) -> tuple[Tensor, Tensor]:
    draw = torch.Generator().manual_seed(seed)
    o = torch.randn(count, 3, dtype=torch.float64, generator=draw) * origin
    d = torch.randn(count, 3, dtype=torch.float64, generator=draw) * spread
    d[:, 2] = -1
    return o, d / d.norm(dim=-1, keepdim=True)


def ndc_point(x: Tensor, near: float, focal: tuple[float, float]) -> Tensor:
    """NeRF, appendix C, for a far plane at infinity: a projected point, fp64."""
    return torch.stack(
        [-focal[0] * x[:, 0] / x[:, 2], -focal[1] * x[:, 1] / x[:, 2], 1 + 2 * near / x[:, 2]], -1
    )


@pytest.mark.parametrize("offset", [0.0, 4.5e6])
@pytest.mark.parametrize("seed", [0, 1])
def test_ndc_is_nerfs_projection(offset: float, seed: int) -> None:
    """Points of a ray project to points of its NDC ray; t = 0 is the near plane, and `metric` gives the
    distance back.
    """
    near = 1.3
    focal = (1.7, 2.1)
    turn = rotation(seed)
    centre = torch.tensor([offset, -offset, 0.5 * offset], dtype=torch.float64)
    space = Space(
        "ndc", (float(centre[0]), float(centre[1]), float(centre[2])), rows(turn), 1.0, near, 1.0, focal=focal
    )
    local_o, local_d = forward_rays(50, seed)
    origin = local_o @ turn + centre
    direction = local_d @ turn
    rays = space.rays(origin, direction)
    assert rays.origin.dtype == torch.float32 and torch.equal(rays.view, direction.float())
    assert (rays.near == 0).all() and (rays.far == 1).all()
    assert torch.allclose(rays.origin[:, 2], torch.tensor(-1.0), atol=1e-6)
    assert torch.allclose(rays.origin[:, 2] + rays.direction[:, 2], torch.tensor(1.0), atol=1e-6)
    slack = 1e-6 + offset * 1e-15 * 100
    for z in (1.3, 1.5, 3.0, 40.0, 1e4):
        along = -(local_o[:, 2] + z) / local_d[:, 2]
        wanted = ndc_point(local_o + along[:, None] * local_d, near, focal)
        t = 1 - near / z  # the share of the way to the far plane
        found = rays.origin.double() + t * rays.direction.double()
        assert (found - wanted).abs().max() <= slack * 5
        back = space.metric(origin, direction, torch.full((50,), t, dtype=torch.float64))
        assert ((back - along) / along.abs()).abs().max() <= 1e-9 + offset * 1e-14
        assert (space.parameter(origin, direction, along) - t).abs().max() <= 1e-9 + offset * 1e-14


@pytest.mark.parametrize("kind", ["box", "contraction"])
@pytest.mark.parametrize("offset", [0.0, 4.5e6])
def test_world_rays_are_recentred_turned_and_scaled_in_float64(kind: Kind, offset: float) -> None:
    turn = rotation(3)
    scale = 0.25
    centre = torch.tensor([offset, offset, 1.0], dtype=torch.float64)
    space = Space(kind, (offset, offset, 1.0), rows(turn), scale, 0.05, 1e3)
    origin, direction = forward_rays(40, 0)
    rays = space.rays(origin + centre, direction)
    assert (rays.origin - (origin @ turn.T) * scale).abs().max() <= 4 * U + offset * 2.0**-52
    assert (rays.direction - direction @ turn.T).abs().max() <= 4 * U
    assert torch.equal(rays.view, direction.float())
    if kind == "contraction":
        assert (rays.near == torch.tensor(0.05)).all() and (rays.far == 1e3).all()
        point = rays.origin + rays.direction * 7
        assert torch.equal(space.locate(point), contract(point))
    t = torch.tensor([0.3, 2.0])
    world = space.metric(origin[:2], direction[:2], t)
    assert torch.allclose(world, t / scale)
    assert torch.allclose(space.parameter(origin[:2], direction[:2], world), t)


def slab_oracle(o: list[float], d: list[float], least: float) -> tuple[float, float] | None:
    near = least
    far = math.inf
    for a, b in zip(o, d, strict=True):
        if b == 0:
            if abs(a) > 1:
                return None
            continue
        one = (-1 - a) / b
        two = (1 - a) / b
        near = max(near, min(one, two))
        far = min(far, max(one, two))
    return (near, far) if near < far else None


@given(st.integers(0, 9999), st.booleans())
def test_box_rays_enter_and_leave_where_slabs_say(seed: int, axis_aligned: bool) -> None:
    draw = torch.Generator().manual_seed(seed)
    origin = torch.randn(20, 3, dtype=torch.float64, generator=draw) * 2
    direction = torch.randn(20, 3, dtype=torch.float64, generator=draw)
    if axis_aligned:
        direction = torch.nn.functional.one_hot(torch.randint(3, (20,), generator=draw), 3).double()
    direction = direction / direction.norm(dim=-1, keepdim=True)
    rays = space_of("box", near=0.1).rays(origin, direction)
    for k in range(20):
        expected = slab_oracle(origin[k].tolist(), direction[k].tolist(), 0.1)
        near = float(rays.near[k])
        far = float(rays.far[k])
        if expected is None:
            assert near == far
        else:
            assert near == pytest.approx(expected[0], rel=1e-6) and far == pytest.approx(
                expected[1], rel=1e-6
            )
            ends = origin[k] + torch.tensor([[near], [far]], dtype=torch.float64) * direction[k]
            assert ends.abs().max() <= 1 + 1e-5


shifts = st.tuples(*(st.floats(-1e7, 1e7) for _ in range(3)))


def cloud(seed: int, size: float) -> torch.Tensor:
    return size * torch.randn(40, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@given(seed=st.integers(0, 2**31), shift=shifts, size=st.sampled_from([1e-3, 1.0, 50.0, 1e4]))
def test_float32_resolves_a_millionth_of_the_extent_about_the_origin(
    seed: int, shift: tuple[float, float, float], size: float
) -> None:
    place = cloud(seed, size) + torch.tensor(shift, dtype=torch.float64)
    origin = torch.tensor(local_origin(place), dtype=torch.float64)
    local = place - origin
    middle, extent = extent_of(place)
    assert float((local.float().double() - local).norm(dim=1).quantile(0.9)) < 1.5e-6 * extent
    assert float((local + origin - place).abs().max()) <= 1e-15 * float(place.abs().max())
    if size >= 1:
        assert torch.equal(origin, origin.round()), "whole numbers, which a user can read"
    if not bool(origin.any()):
        assert float(middle.norm()) <= 16 * extent


def test_what_lies_near_0_stays_where_it_is() -> None:
    near = cloud(0, 1.0) + torch.tensor([10.0, 0, 0], dtype=torch.float64)
    assert local_origin(near) == (0, 0, 0)
    assert local_origin(torch.zeros(0, 3)) == local_origin(torch.full((5, 3), 7e6)) == (0, 0, 0)
    # Cameras in one corner of what they see: the extent is that of the points.
    far = 0.01 * cloud(0, 1.0) + torch.tensor([10.0, 0, 0], dtype=torch.float64)
    assert local_origin(far) != (0, 0, 0) and local_origin(far, cloud(1, 10.0)) == (0, 0, 0)


def test_outliers_and_numbers_that_are_not_finite_decide_nothing() -> None:
    place = cloud(0, 1.0)
    place[0], place[1], place[2] = 1e9, math.inf, math.nan
    assert local_origin(place) == (0, 0, 0)
    x, y, z = local_origin(place + torch.tensor([5e5, 0, 0], dtype=torch.float64))
    assert abs(x - 5e5) < 2 and abs(y) < 2 and abs(z) < 2


def test_offset_files_are_read_again_and_do_not_outlive_their_file(tmp_path: Path) -> None:
    path = tmp_path / "a.splat"
    offset = (500000.0, -0.0009765625, 5.6e6)
    assert read_offset(path) == (0, 0, 0)
    write_offset(path, offset)
    assert offset_file(path).name == "a.splat.offset.json" and read_offset(path) == offset
    write_offset(path, (0.0, 0.0, 0.0))
    assert not offset_file(path).exists()
    assert added_and_beside(offset, False) == (offset, (0, 0, 0)) and added_and_beside(offset, True) == (
        (0, 0, 0),
        offset,
    )


@pytest.mark.parametrize(
    "text", ["[]", "{}", '{"offset": [1, 2]}', '{"offset": "far"}', '{"offset": [1, 2, null]}', "{"]
)
def test_damaged_offset_files_are_refused(tmp_path: Path, text: str) -> None:
    offset_file(tmp_path / "a.ply").write_text(text)
    with pytest.raises(DataError, match=r"a\.ply\.offset\.json"):
        read_offset(tmp_path / "a.ply")
