"""Spaces found from cameras: which kind, where the centre is, and that the world's own origin, unit and axes
don't matter.
"""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from capture_files import cameras_of
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from fprf.datamanagers.bounds import find_kind, find_space, focus
from fprf.datamanagers.scene import ParsedScene
from fprf.errors import DataError
from fprf.rendering.cameras import rays_through
from fprf.rendering.paths import look_at
from fprf.rendering.space import Space

F64 = torch.float64
UP = torch.tensor([0.0, 0.0, 1.0], dtype=F64)


def scene_of(pose: Tensor, points: Tensor | None = None, alpha: bool = False) -> ParsedScene:
    everything = torch.arange(len(pose))
    return ParsedScene(
        name="rig",
        paths=tuple(Path(f"{k}.png") for k in everything),
        cameras=cameras_of(pose, (100, 80), (80.0, 80.0)),
        train=everything,
        test=everything[:0],
        points=points,
        alpha=alpha,
    )


def ring(count: int = 24, radius: float = 4.0) -> ParsedScene:
    """Cameras on an ellipse around (1, 2, 0.5), looking at it, and points on a ball there."""
    angle = torch.arange(count, dtype=F64) * (2 * math.pi / count)
    target = torch.tensor([1.0, 2.0, 0.5], dtype=F64)
    offset = torch.stack([1.2 * angle.cos(), angle.sin(), torch.full_like(angle, 0.3)], -1) * radius
    ball = torch.nn.functional.normalize(
        torch.randn(200, 3, dtype=F64, generator=torch.Generator().manual_seed(0)), dim=-1
    )
    return scene_of(look_at(target + offset, target.expand_as(offset), UP), target + ball)


def forward(points: bool = True) -> ParsedScene:
    """A grid of cameras on a wall, all looking along +y at points 5 to 20 away."""
    x, z = torch.meshgrid(
        torch.linspace(-1, 1, 4, dtype=F64), torch.linspace(-0.5, 0.5, 3, dtype=F64), indexing="ij"
    )
    place = torch.stack([x.flatten(), torch.zeros(12, dtype=F64), z.flatten()], -1)
    ahead = torch.tensor([[0.0, 1.0, 0.0]], dtype=F64).repeat(12, 1)
    draw = torch.rand(100, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
    cloud = torch.stack([draw[:, 0] * 6 - 3, 5 + 15 * draw[:, 1], draw[:, 2] * 4 - 2], -1)
    return scene_of(look_at(place, place + ahead, UP), cloud if points else None)


def street() -> ParsedScene:
    """A drive along (1, 1, 0), looking ahead and to the sides; no points."""
    along = torch.tensor([1.0, 1.0, 0.0], dtype=F64) / math.sqrt(2)
    side = torch.tensor([-1.0, 1.0, 0.0], dtype=F64) / math.sqrt(2)
    place = (torch.arange(30, dtype=F64) - 15)[:, None] * along * 5
    turn = torch.tensor([0.0, 1.2, -1.2], dtype=F64).repeat(10)[:, None]
    return scene_of(look_at(place, place + turn.cos() * along + turn.sin() * side, UP))


def thing() -> ParsedScene:
    return replace(ring(), alpha=True, points=None)


RIGS = {"ring": ring, "forward": forward, "street": street, "thing": thing}


def moved(scene: ParsedScene, scale: float, shift: Tensor, turn: Tensor) -> ParsedScene:
    pose = scene.cameras.pose
    place = (scale * pose[:, :, 3]) @ turn.T + shift
    cameras = replace(scene.cameras, pose=torch.cat([turn @ pose[:, :, :3], place[:, :, None]], -1))
    points = None if scene.points is None else scale * scene.points @ turn.T + shift
    return replace(
        scene, cameras=cameras, points=points, depths=None if scene.depths is None else scene.depths * scale
    )


def located(scene: ParsedScene, space: Space) -> Tensor:
    """Unit-cube coordinates along rays through all cameras' corners and middles."""
    view = torch.arange(len(scene.cameras)).repeat_interleave(3)
    pixel = torch.tensor([[0.5, 0.5], [50.0, 40.0], [99.5, 70.5]], dtype=F64).repeat(len(scene.cameras), 1)
    rays = space.rays(*rays_through(scene.cameras, view, pixel))
    s = torch.linspace(0, 1, 9).expand(len(view), -1)
    t = space.distance(s, rays.near, rays.far)
    return space.locate((rays.origin[:, None] + rays.direction[:, None] * t[..., None]).view(-1, 3))


@pytest.mark.parametrize(
    ("name", "kind"),
    [("ring", "contraction"), ("forward", "ndc"), ("street", "contraction"), ("thing", "box")],
)
def test_the_kind_follows_from_the_capture(name: str, kind: str) -> None:
    scene = RIGS[name]()
    space = find_space(scene)
    assert find_kind(scene) == space.kind == kind
    turn = torch.tensor(space.rotation, dtype=F64)
    assert (turn @ turn.T - torch.eye(3, dtype=F64)).abs().max() < 1e-12 and torch.linalg.det(turn) > 0
    assert space.scale > 0 and space.near >= 0 and (kind == "ndc" or space.near < space.far)
    inside = located(scene, space)
    assert inside.isfinite().all()
    # A ray that misses a box has its empty step where it passes; all others stay in the cube.
    assert kind == "box" or inside.abs().max() <= 1 + 1e-5


@pytest.mark.parametrize("name", list(RIGS))
@pytest.mark.parametrize(("scale", "offset"), [(1.0, 1e6), (1e3, 0.0), (1e-3, 1.0), (1e3, 1e6)])
def test_origin_and_unit_of_the_world_do_not_matter(name: str, scale: float, offset: float) -> None:
    scene = RIGS[name]()
    shift = torch.tensor([offset, -2 * offset, 0.3 * offset], dtype=F64)
    other = moved(scene, scale, shift, torch.eye(3, dtype=F64))
    one = find_space(scene)
    two = find_space(other)
    assert two.kind == one.kind
    assert (located(other, two) - located(scene, one)).abs().max() <= 1e-5


def test_a_ring_looks_at_its_centre() -> None:
    scene = ring()
    point, certain = focus(scene.cameras)
    assert torch.allclose(point, torch.tensor([1.0, 2.0, 0.5], dtype=F64), atol=1e-8) and certain > 0.1
    space = find_space(scene)
    assert space.centre == pytest.approx((1.0, 2.0, 0.5), abs=1e-8)
    local = (scene.cameras.pose[:, :, 3] - point) @ torch.tensor(space.rotation, dtype=F64).T * space.scale
    # Nine in ten cameras, and the scene, lie in the part that is not contracted.
    assert (local.abs().amax(-1) <= 1 + 1e-9).double().mean() >= 0.9
    assert space.rotation[2] == pytest.approx((0.0, 0.0, 1.0), abs=0.2)


def test_points_may_be_more_than_quantile_takes() -> None:
    point = torch.tensor([[4.0, 9.0, 0.5]], dtype=F64)
    few, many = (find_space(replace(ring(), points=point.expand(count, 3))) for count in (8, (1 << 24) + 1))
    assert few == many


def test_ndc_frames_all_rays_and_starts_before_the_nearest_point() -> None:
    scene = forward()
    assert scene.points is not None
    space = find_space(scene)
    nearest = float(scene.points[:, 1].min())
    assert 0.8 * nearest < space.near < nearest
    assert space.focal == pytest.approx((1.6, 2.0))
    inside = located(scene, space)
    assert 0.9 < float(inside[:, :2].abs().max()) <= 1.0
    given = find_space(
        replace(forward(points=False), depths=torch.tensor([[4.0, 30.0]], dtype=F64).repeat(12, 1))
    )
    assert given.kind == "ndc" and given.near == pytest.approx(3.6)
    behind = scene.points * torch.tensor([1.0, -1.0, 1.0], dtype=F64)
    assert find_kind(replace(scene, points=behind)) == "contraction", "points that no camera sees say nothing"


@pytest.mark.parametrize("offset", [0.0, 4.5e6])
@pytest.mark.parametrize("alpha", [False, True])
def test_cameras_in_one_place_are_refused(offset: float, alpha: bool) -> None:
    angle = torch.arange(8, dtype=F64)
    direction = torch.stack([angle.cos(), angle.sin(), 0.1 * angle], -1)
    place = torch.full((8, 3), offset, dtype=F64)
    scene = scene_of(look_at(place, place + direction, UP), alpha=alpha)
    with pytest.raises(DataError, match="rig: all cameras stand in one place"):
        find_space(scene)


@settings(max_examples=25)
@given(st.integers(1, 12), st.integers(0, 9999), st.booleans(), st.floats(-3, 6))
def test_any_rig_has_a_space(count: int, seed: int, alpha: bool, exponent: float) -> None:
    """Or a DataError; whatever is found maps rays into the cube."""
    draw = torch.Generator().manual_seed(seed)
    place, direction = (torch.randn(count, 3, dtype=F64, generator=draw) for _ in range(2))
    cloud = torch.randn(seed % 20, 3, dtype=F64, generator=draw) * 10**exponent if seed % 3 else None
    place = place * 10**exponent
    scene = scene_of(look_at(place, place + direction, UP), cloud, alpha=alpha)
    try:
        space = find_space(scene)
    except DataError:
        return
    inside = located(scene, space)
    assert inside.isfinite().all()
    assert space.kind == "box" or inside.abs().max() <= 1 + 1e-5
