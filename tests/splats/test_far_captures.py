"""Captures at large coordinates, and in very large and small units: read, restyled and written where they are."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from moved_scene import UTM
from splat_ball import ball, plain_ply

from fprf.rendering.local_frame import offset_file, read_offset
from fprf.splats.files import read_capture, write_capture, write_gaussians
from fprf.splats.gaussians import GaussianRows, Gaussians
from fprf.splats.views import clip_distance, find_views, seen_means

ENDINGS = {"ply": 1e-6, "splat": 1e-6, "spz": 2e-6, "sog": 1e-4, "compressed.ply": 2e-3}
"""Formats, and the errors of positions that their bits leave in a ball of radius 1."""
UP = torch.tensor([0.0, -1.0, 0.0])


def in_world(path: Path) -> np.ndarray:
    """Positions of a file less UTM, in an order of their own: float64."""
    capture = read_capture(path)
    return capture.gaussians.means.double().numpy() + (np.array(capture.origin) - UTM)


def nearest(found: np.ndarray, wanted: np.ndarray) -> float:
    """Largest distance from a position to the nearest wanted one."""
    return float(np.linalg.norm(found[:, None] - wanted[None], axis=2).min(1).max())


@pytest.mark.parametrize("local", [False, True])
@pytest.mark.parametrize("ending", ENDINGS)
def test_positions_come_back_from_every_format(tmp_path: Path, ending: str, local: bool) -> None:
    made, path = ball(300), tmp_path / f"a.{ending}"
    write_gaussians(path, made, origin=UTM, local=local)
    assert nearest(in_world(path), made.means.double().numpy()) < ENDINGS[ending]
    world = ending == "ply" and not local
    assert read_offset(path) == ((0, 0, 0) if world else UTM)
    if ending == "ply":
        assert (b"property double x" in path.read_bytes()) == world
        place = trimesh.load(path).vertices - (UTM if world else (0, 0, 0))  # by another reader
        assert np.abs(place - made.means.numpy()).max() < 2e-9


def test_parts_of_a_large_file_are_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fprf.splats.files.base.ROWS", 16)
    made = ball(50)
    for local in (False, True):
        write_gaussians(tmp_path / "a.ply", made, origin=UTM, local=local)
        write_gaussians(tmp_path / "b.ply", GaussianRows(50, made.select, False), origin=UTM, local=local)
        assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
        assert read_offset(tmp_path / "a.ply") == read_offset(tmp_path / "b.ply") == (UTM if local else (0, 0, 0))
    write_gaussians(tmp_path / "c.ply", made)
    assert (tmp_path / "c.ply").read_bytes() == plain_ply(made), "float32 where there is no origin"


def test_float32_positions_far_from_0_are_looked_at_about_their_middle(tmp_path: Path) -> None:
    """As other programs wrote them: what they rounded stays rounded, and nothing more."""
    made = ball(200)
    far = replace(made, means=made.means * 1000 + 1e7)
    write_gaussians(tmp_path / "far.ply", far)
    capture = read_capture(tmp_path / "far.ply")
    assert capture.gaussians.means.abs().max() < 2000 and capture.offset == (0, 0, 0) != capture.shift
    world = capture.gaussians.means.double() + torch.tensor(capture.origin, dtype=torch.float64)
    assert torch.equal(world, far.means.double())


def test_what_is_written_again_keeps_its_place(tmp_path: Path) -> None:
    made = ball(200)
    write_gaussians(tmp_path / "in.ply", made, origin=UTM)
    write_gaussians(tmp_path / "in.splat", made, origin=UTM)
    for name in ("in.ply", "in.splat"):
        capture = read_capture(tmp_path / name)
        new = capture.gaussians.harmonics + 0.1
        for ending in ENDINGS:
            write_capture(tmp_path / f"out.{ending}", capture, new)
            assert nearest(in_world(tmp_path / f"out.{ending}"), made.means.double().numpy()) < ENDINGS[ending]
        ending = name.partition(".")[2]
        write_capture(tmp_path / f"same.{ending}", capture, capture.gaussians.harmonics)
        assert (tmp_path / f"same.{ending}").read_bytes() == (tmp_path / name).read_bytes()
        assert offset_file(tmp_path / f"same.{ending}").exists() == (name == "in.splat")


def scaled(gaussians: Gaussians, factor: float) -> Gaussians:
    return replace(gaussians, means=gaussians.means * factor, log_scales=gaussians.log_scales + float(np.log(factor)))


@pytest.mark.parametrize("factor", [1e-6, 1e-3, 1e3, 1e6])
def test_in_other_units_the_same_is_seen(factor: float) -> None:
    own, other = ball(300), scaled(ball(300), factor)
    views = [find_views(each, count=4, size=(48, 36), up=UP, inside=False) for each in (own, other)]
    assert torch.allclose(views[0].pose[:, :, 3] * factor, views[1].pose[:, :, 3], rtol=1e-4, atol=1e-4 * factor)
    assert torch.allclose(views[0].pose[:, :, :3], views[1].pose[:, :, :3], atol=1e-5)
    first, second = (seen_means(each, shown, antialiased=True) for each, shown in zip((own, other), views, strict=True))
    assert torch.allclose(first.opacities, second.opacities, atol=1e-3)
    assert clip_distance(own) == 0.01 and 5e-5 < clip_distance(other) / factor < 0.03
