"""Captures whose files say different directions of up and north, in one world."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from splat_ball import ball
from torch import Tensor

from fprf.cli import main as cli
from fprf.ops.harmonics import spherical_harmonics
from fprf.plugins.encoders.config import BundledSemanticConfig
from fprf.rendering.north import Bearings
from fprf.rendering.splines import rotations
from fprf.splats.capture_alignment import Placement
from fprf.splats.captures import Captures, open_captures
from fprf.splats.config import GaussianSemanticsConfig, LookConfig
from fprf.splats.files import read_capture, write_gaussians
from fprf.splats.gaussians import GaussianRows, Gaussians
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.restyle import apply_style

UP = (0.0, -1.0, 0.0)
NORTH = (0.6, 0.0, -0.8)
TURN = rotations(torch.tensor([[0.4, -0.3, 0.8, 0.33]], dtype=torch.float64))[0]
SMALL = ["--semantic.encoder", "bundled-semantic", "--regions", "4", "--views", "6", "--size", "64", "48"]


def look(**asked: tuple[float, float, float]) -> LookConfig:
    semantic = replace(GaussianSemanticsConfig(), encoder=BundledSemanticConfig())
    return LookConfig(views=6, size=(64, 48), regions=4, semantic=semantic, **asked)


def turned(direction: Sequence[float], by: Tensor = TURN) -> tuple[float, float, float]:
    x, y, z = (by @ torch.tensor(direction, dtype=torch.float64)).tolist()
    return x, y, z


def write(path: Path, made: Gaussians, bearings: Bearings | None) -> Path:
    """A file that says where north and up are."""
    write_gaussians(path, GaussianRows(len(made), made.select, False, bearings))
    return path


def lit(seen: Captures, number: int, path: Path) -> Tensor:
    """Mean colours of one of the captures under a low sun in the east."""
    style = StyleFile(StyleConfig(sun=(90.0, 20.0)))
    styled = seen.scene.restyled(apply_style(seen.scene, style).restyle)
    harmonics = seen.harmonics(number, read_capture(path), styled)
    return 0.5 + 0.28209479177387814 * harmonics[:, 0]


def test_gaussians_of_a_turned_world_look_the_same_from_turned_directions() -> None:
    made = ball(50, degree=3)
    move = torch.tensor([1.0, -2.0, 0.5])
    there = Placement(TURN, move).placed(made)
    assert torch.allclose(Placement(TURN, move).back(there.means), made.means, atol=1e-6)
    directions = torch.nn.functional.normalize(
        torch.randn(50, 3, generator=torch.Generator().manual_seed(1)), dim=1
    )
    before = torch.einsum("nb,nbc->nc", spherical_harmonics(directions, 4), made.harmonics)
    after = torch.einsum("nb,nbc->nc", spherical_harmonics(directions @ TURN.T.float(), 4), there.harmonics)
    assert torch.allclose(before, after, atol=1e-5)
    axes = rotations(made.quaternions)
    assert torch.allclose(rotations(there.quaternions).abs(), (TURN.float() @ axes).abs(), atol=1e-5)


def test_a_light_falls_on_each_capture_from_its_own_east(tmp_path: Path) -> None:
    """A capture whose whole world is turned, with the directions that its file says, takes the same light."""
    first = write(tmp_path / "first.ply", ball(800), Bearings(NORTH, UP))
    other = ball(800, seed=1)
    plain = write(tmp_path / "plain.ply", other, Bearings(NORTH, UP))
    moved = Placement(TURN, torch.tensor([3.0, 1.0, 0.0])).placed(other)
    file = write(tmp_path / "turned.ply", moved, Bearings(turned(NORTH), turned(UP)))
    silent = write(tmp_path / "silent.ply", moved, None)
    cache = tmp_path / "cache"
    lines: list[str] = []
    found = open_captures([first, file], look(), cache=cache, say=lines.append)
    assert len(lines) == 2 and "first.ply: up is -y" in lines[1] and "turned.ply: up is" in lines[0]
    assert found.scene.north is not None and found.scene.north.direction == pytest.approx(NORTH, abs=1e-6)
    wanted = lit(open_captures([first, plain], look(), cache=cache), 1, plain)
    before = other.colours
    change = float((wanted - before).abs().mean())
    assert change > 0.05
    assert float((lit(found, 1, file) - wanted).abs().mean()) < 0.1 * change
    # Of a file that says nothing it falls from where that of most captures is.
    wrong = lit(open_captures([first, silent], look(), cache=cache), 1, silent)
    assert float((wrong - wanted).abs().mean()) > 0.5 * change


@pytest.mark.parametrize("up", [(0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)])
def test_captures_stand_upright_beside_each_other(up: tuple[float, float, float], tmp_path: Path) -> None:
    """Whichever of the two axes is that of the first."""
    usual = write(tmp_path / "usual.ply", ball(300), Bearings(NORTH, UP))
    other = write(tmp_path / "other.ply", ball(300), Bearings((up[2], up[0], up[1]), up))
    for paths in ([usual, other], [other, usual]):
        seen = open_captures(paths, look(), cache=tmp_path / "cache")
        first, second = (seen.placements[k] for k in range(2))
        assert not first.turned and second.turned
        ups = [torch.tensor(read_capture(path).up, dtype=torch.float64) for path in paths]
        assert torch.allclose(second.turn @ ups[1], ups[0], atol=1e-6)
        assert torch.allclose(torch.linalg.det(second.turn), torch.ones(()).double())
        # They stand on one level, not on each other.
        middles = [seen.scene.gaussians.means[rows].mean(0) for rows in seen.rows]
        apart = (middles[1] - middles[0]).double()
        assert abs(float(apart @ ups[0])) < 0.2 < float(apart.norm())


def test_views_are_those_of_the_capture_in_its_own_axes(tmp_path: Path) -> None:
    made = ball(300)
    first = write(tmp_path / "first.ply", made, Bearings(NORTH, UP))
    other = write(tmp_path / "other.ply", made, Bearings(turned(NORTH), turned(UP)))
    seen = open_captures([first, other], look(), cache=tmp_path / "cache")
    views = seen.views_of(1, read_capture(other))
    # What a camera sees of a Gaussian, in its own axes, does not depend on the world.
    here = torch.einsum("vji,vnj->vni", views.pose[:, :, :3], made.means.double() - views.pose[:, None, :, 3])
    joined = seen.scene.gaussians.means[seen.rows[1]].double()
    poses = seen.scene.views.pose
    there = torch.einsum("vji,vnj->vni", poses[:, :, :3], joined - poses[:, None, :, 3])
    assert torch.allclose(here, there, atol=1e-5)


def test_neighbours_that_differ_by_their_errors_stay_where_they_are(tmp_path: Path) -> None:
    made = ball(400)
    left = made.means[:, 0] < 0
    tilt = math.radians(3)
    paths = [
        write(tmp_path / "left.ply", made.select(left), None),
        write(
            tmp_path / "right.ply",
            made.select(~left),
            Bearings(NORTH, (0.0, -math.cos(tilt), math.sin(tilt))),
        ),
    ]
    seen = open_captures(paths, look(), cache=tmp_path / "cache")
    assert not any(each.turned or bool(each.move.any()) for each in seen.placements)
    # What one of them says holds for both.
    assert seen.scene.north is not None and seen.scene.north.direction == pytest.approx(NORTH, abs=1e-6)
    # In other worlds they are no neighbours.
    write(paths[0], made.select(left), Bearings((0.0, 1.0, 0.0), (1.0, 0.0, 0.0)))
    assert open_captures(paths, look(), cache=tmp_path / "cache").placements[1].turned
    # Flags hold for all.
    asked = open_captures(paths, look(up=UP, north=(0.0, 0.0, 1.0)), cache=tmp_path / "cache")
    assert not any(each.turned for each in asked.placements)


def test_restyle_says_what_each_capture_was_taken_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = [
        write(tmp_path / "first.ply", ball(300), Bearings(NORTH, UP)),
        write(tmp_path / "other.ply", ball(300), Bearings((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))),
        write(tmp_path / "silent.ply", ball(300), None),
    ]
    (tmp_path / "out").mkdir()
    words = [
        *SMALL,
        "--cache",
        str(tmp_path / "cache"),
        "--sun",
        "90",
        "20",
        "--output",
        str(tmp_path / "out"),
    ]
    assert cli.main(["restyle", *map(str, paths), *words]) == 0
    said = capsys.readouterr().err
    assert "other.ply: up is +z" in said and "first.ply: up is -y" in said
    assert "silent.ply: nothing tells its north" in said
    written = read_capture(tmp_path / "out" / "other.ply")
    before = read_capture(paths[1])
    assert torch.equal(written.gaussians.means, before.gaussians.means) and written.up == before.up
    assert (written.gaussians.colours - before.gaussians.colours).abs().mean() > 0.02
