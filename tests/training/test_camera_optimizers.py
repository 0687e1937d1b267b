"""Learnt poses and tones of views: free of what no image can tell, found again, the same for all blocks."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from parts_world import BlockWorld, small, tensors_of
from tiny_world import World, parameters, trained_for
from torch import Tensor

from fprf.rendering.cameras import rays_through
from fprf.training.camera_optimizers import Poses, Tones, poses_of, rotated, with_trend
from fprf.training.driver import train
from fprf.training.field_scene import load_run
from fprf.types import Batch

SEEDS = st.integers(0, 2**31 - 1)


def draw(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def poses_with(
    offset: Tensor, centres: Tensor, held: tuple[int, ...] = (), reach: float = 2.0, pace: float = 0.1
) -> Poses:
    poses = Poses(centres, held, reach=reach, pace=pace)
    with torch.no_grad():
        poses.offset.copy_(offset)
    return poses


@given(SEEDS, st.floats(0, 3))
def test_a_turn_is_the_exponential_of_its_vector(seed: int, size: float) -> None:
    turn = size * torch.nn.functional.normalize(draw(4, 3, seed=seed))
    x = draw(4, 3, seed=seed + 1)
    skew = torch.stack(
        [torch.linalg.cross(turn, axis.expand_as(turn)) for axis in torch.eye(3, dtype=torch.float64)], -1
    )
    wanted = (torch.linalg.matrix_exp(skew) @ x[..., None])[..., 0]
    torch.testing.assert_close(rotated(x, turn), wanted, atol=1e-12, rtol=0)


def test_no_turn_has_a_slope_too() -> None:
    turn = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    x = draw(2, 3, seed=1)
    torch.testing.assert_close(rotated(x, turn), x, atol=1e-15, rtol=0)
    assert torch.autograd.gradcheck(lambda t: rotated(x, t), (turn,))


@given(st.integers(2, 7), st.integers(0, 3), SEEDS)
def test_what_no_image_can_tell_is_taken_out(count: int, held: int, seed: int) -> None:
    """Moves have no mean shift, and none along a common turn or a change of scale; held-out views have none
    at all.
    """
    views = count + held
    centres = 5 * draw(views, 3, seed=seed)
    poses = poses_with(draw(views, 6, seed=seed + 1), centres, tuple(range(count, views)))
    moves = poses.moves().detach().double()
    assert not moves[count:].any()
    turn, shift = moves[:count].split(3, -1)
    place = (centres[:count] - centres[:count].mean(0)) / 2.0
    room = 1e-5 * (1 + float(place.abs().max())) * count
    assert float(shift.sum(0).abs().max()) < room
    assert float((turn + torch.linalg.cross(place, shift)).sum(0).abs().max()) < room
    assert abs(float((place * shift).sum())) < room


def test_rays_are_those_of_the_refined_cameras(world: World) -> None:
    cameras = world.prepared.scene.cameras
    poses = poses_with(draw(len(cameras), 6, seed=3), cameras.pose[:, :, 3], held=(1,))
    view = torch.tensor([0, 1, 5, 5])
    pixel = torch.tensor([[3.5, 4.5], [1.5, 2.5], [9.5, 0.5], [7.5, 7.5]])
    moved = poses.refined(cameras)
    found = poses(view, *rays_through(cameras, view, pixel))
    for ours, theirs in zip(found, rays_through(moved, view, pixel), strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-12, rtol=0)
    assert torch.equal(moved.pose[1], cameras.pose[1]) and not torch.allclose(moved.pose[5], cameras.pose[5])
    eye = moved.pose[:, :, :3].transpose(1, 2) @ moved.pose[:, :, :3]
    torch.testing.assert_close(eye, torch.eye(3, dtype=torch.float64).expand_as(eye), atol=1e-12, rtol=0)


def test_views_that_were_held_out_follow_what_all_others_have_in_common(world: World) -> None:
    cameras = world.prepared.scene.cameras
    learned = list(range(1, len(cameras)))
    place = cameras.pose[:, :, 3] - cameras.pose[1:, :, 3].mean(0)
    moves = 1e-3 * torch.cat([place @ draw(3, 3, seed=1).double(), place @ draw(3, 3, seed=2).double()], 1)
    given = moves.clone()
    given[0] = 0
    found = with_trend(given, cameras, learned, 1.0)
    assert torch.equal(found[1:], moves[1:])
    assert float((found[0] - moves[0]).norm()) < 0.3 * float(moves[0].norm())
    # What single views did for themselves says nothing about others.
    alone = given.clone()
    alone[2:] = 0
    assert not with_trend(alone, cameras, learned, 1.0)[0].any()
    assert torch.equal(with_trend(torch.zeros_like(given), cameras, learned, 1.0), torch.zeros_like(given))


def test_what_was_found_is_gone_on_with() -> None:
    centres = draw(6, 3, seed=5)
    first = poses_with(draw(6, 6, seed=6), centres)
    second = first.going_on(centres, held=(0, 1))
    torch.testing.assert_close(second.moves(), first.moves())
    with torch.no_grad():
        second.offset.copy_(draw(6, 6, seed=7))
    change = second.moves() - first.moves()
    assert not change[:2].any() and bool((change[2:].abs().sum(1) > 0).all())
    torch.testing.assert_close(change[2:, 3:].sum(0), torch.zeros(3), atol=1e-5, rtol=0)


def test_cameras_that_were_turned_come_back(world: World, tmp_path: Path) -> None:
    """Two views are given turned; training leads them towards where they were."""
    scene = world.prepared.scene
    wrong = scene.cameras.pose.clone()
    bad = scene.train[[1, 4]]
    away = torch.tensor([[0.0, 0.0, 0.04], [0.0, 0.0, -0.04]], dtype=torch.float64)
    for axis in range(3):
        wrong[bad, :, axis] = rotated(wrong[bad, :, axis], away)
    cameras = replace(scene.cameras, pose=wrong)
    held = tuple(sorted(set(range(len(wrong))) - set(scene.train.tolist())))
    facts = replace(
        world.prepared.facts, centres=tuple(map(tuple, wrong[:, :, 3].tolist())), held=held, reach=20.0
    )
    config = replace(world.config, poses=0.1, steps=80)
    changed = replace(
        world, prepared=world.prepared._replace(facts=facts, scene=replace(scene, cameras=cameras))
    )
    found = parameters(trained_for(changed, tmp_path / "run", config), 80)
    built = poses_of(facts, config.poses)
    assert built is not None
    with torch.no_grad():
        built.offset.copy_(found["model.poses.offset"])
    turn = built.moves().detach()[bad, :3].double()
    assert bool(((turn * away).sum(-1) < 0).all())


def test_blocks_start_from_what_their_surroundings_found(block_world: BlockWorld, tmp_path: Path) -> None:
    """Their poses move on from those; their tones are the same."""
    config = replace(small(block_world.config.data, tmp_path / "run"), poses=0.05, tones=True)
    train(config, "fprf-lite", quiet=True)
    root = tmp_path / "run"
    trained = load_run(root, "cpu")
    poses = trained.model.poses
    assert poses is not None
    moves = poses.moves().detach()
    assert float(moves.abs().max()) > 0 and not moves[list(trained.known.test)].any()
    gain = tensors_of(root, "surroundings")["tones.gain"]
    assert (
        float(gain.abs().max()) > 0
        and trained.model.tones is not None
        and torch.equal(trained.model.tones.gain, gain)
    )
    for name in ("00", "01", "02"):
        assert torch.equal(tensors_of(root, name)["tones.gain"], gain)
        torch.testing.assert_close(tensors_of(root, name)["poses.known"], moves)
        assert float(tensors_of(root, name)["poses.offset"].abs().max()) > 0
    plain = load_run(block_world.root, "cpu").known.cameras
    torch.testing.assert_close(trained.known.cameras.pose, poses.refined(plain).pose)
    assert torch.equal(
        trained.known.cameras.pose[list(trained.known.test)], plain.pose[list(trained.known.test)]
    )


@given(st.integers(1, 6), st.integers(0, 5), st.integers(0, 2**31 - 1))
def test_what_the_training_views_share_belongs_to_the_scene(count: int, held: int, seed: int) -> None:
    tones = Tones(torch.zeros(count + held), tuple(range(count, count + held)))
    draw = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        tones.gain.copy_(torch.randn(count + held, 3, generator=draw))
    factor = tones(torch.arange(count + held))
    torch.testing.assert_close(factor[:count].log().mean(0), torch.zeros(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(factor[count:], torch.ones(held, 3))
    with torch.no_grad():
        tones.gain.add_(torch.tensor([0.3, -0.2, 1.0]))
    torch.testing.assert_close(tones(torch.arange(count + held)), factor, atol=1e-5, rtol=1e-4)


def test_tones_that_go_on_with_other_views_start_as_they_were_and_keep_the_mean_of_these() -> None:
    """Else every cell would choose how bright the scene is, and views that nobody learns from would move."""
    draw = torch.Generator().manual_seed(0)
    views = torch.arange(8)
    before = Tones(torch.linspace(-0.5, 0.5, 8), (5, 6, 7))
    with torch.no_grad():
        before.gain.copy_(torch.randn(8, 3, generator=draw))
        before.exponent.fill_(0.6)
    after = before.going_on((0, 1, 2, 7))
    learned = torch.tensor([3, 4, 5, 6])
    torch.testing.assert_close(after(views), before(views))
    start = before(views).log().detach()
    optimizer = torch.optim.Adam(after.parameters(), lr=0.1)
    for view in (3, 5, 3, 6, 4):
        optimizer.zero_grad()
        after(torch.tensor([view])).sum().backward()
        optimizer.step()
    moved = after(views).log().detach() - start
    assert moved[learned].abs().amin() > 1e-3
    torch.testing.assert_close(moved[learned].mean(0), torch.zeros(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(moved[[0, 1, 2, 7]], torch.zeros(4, 3))


def test_known_exposures_speak_for_views_that_are_held_out() -> None:
    tones = Tones(torch.tensor([1.0, 2.0, 4.0, 2.0]).log() - torch.tensor(2.0).log(), (3,))
    assert tones(torch.tensor([3]))[0].tolist() == pytest.approx([1.0] * 3)
    assert (tones(torch.tensor([2])) / tones(torch.tensor([0])))[0].tolist() == pytest.approx(
        [4 ** (1 / 2.2)] * 3
    )


def test_views_that_were_taken_darker_are_found(world: World, tmp_path: Path) -> None:
    """Half of the views at 70 %: their factors fall, the others' rise."""
    dark = torch.tensor([view % 2 == 0 for view in range(10)])

    def dim(step: int, batch: Batch) -> Batch:
        return batch._replace(rgb=torch.where(dark[batch.view][:, None], 0.7 * batch.rgb, batch.rgb))

    steps = 40
    config = replace(world.config, tones=True, steps=steps)
    facts = replace(
        world.prepared.facts,
        exposure=(0.0,) * 10,
        held=tuple(set(range(10)) - set(world.prepared.scene.train.tolist())),
    )
    changed = replace(world, prepared=world.prepared._replace(facts=facts))
    gain = parameters(trained_for(changed, tmp_path / "run", config, change=dim), steps)[
        "model.tones.gain"
    ].mean(1)
    train = torch.zeros(10, dtype=torch.bool)
    train[world.prepared.scene.train] = True
    assert float(gain[train & dark].mean()) < float(gain[train & ~dark].mean()) - 0.1
