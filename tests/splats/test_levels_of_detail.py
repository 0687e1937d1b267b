"""Levels of detail: nothing that is seen is left out, moments are kept, and what is merged does not show."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from splat_ball import ball, equal

from fprf.ops.rasterise.rendering import Pinhole
from fprf.splats.drawing import draw
from fprf.splats.gaussians import Gaussians
from fprf.splats.levels import StyledLevels, make_levels_of_detail, open_levels, write_levels


def _scattered(count: int) -> Gaussians:
    """Small Gaussians in a ball of radius 10."""
    found = ball(count)
    return replace(found, means=10 * found.means, log_scales=found.log_scales - 1)


def _camera(distance: float, focal: float) -> Pinhole:
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = distance
    intrinsics = torch.tensor([[focal, 0, 48], [0, focal, 32], [0, 0, 1]], dtype=torch.float64)
    return Pinhole(intrinsics, pose, 96, 64, 0.01)


@pytest.mark.parametrize(
    ("distance", "focal", "pixels", "error", "left"),
    [
        (0.0, 100.0, 0.0, 1e-5, 1.0),
        (5.0, 300.0, 0.0, 1e-5, 1.0),
        (-5.0, 100.0, 0.0, 1e-5, 1.0),
        (300.0, 300.0, 1.0, 2 / 255, 0.75),
    ],
)
def test_culling_and_merging_within_a_pixel_do_not_show_and_save(
    distance: float, focal: float, pixels: float, error: float, left: float
) -> None:
    gaussians = _scattered(20_000)
    camera = _camera(distance, focal)
    shown = make_levels_of_detail(gaussians).select(camera, pixels)
    apart = draw(gaussians, camera, antialiased=True).image - draw(shown, camera, antialiased=True).image
    assert float(apart.square().mean()) ** 0.5 < error and len(shown) < left * len(gaussians)


def test_equal_gaussians_merge_into_one_of_them() -> None:
    one = ball(1)
    many = one.select(torch.zeros(64, dtype=torch.int64))
    found = make_levels_of_detail(many).select(_camera(10.0, 100.0), 0.5)
    assert len(found) == 1
    assert torch.allclose(found.means, one.means, atol=1e-5) and torch.allclose(
        found.harmonics, one.harmonics, atol=1e-5
    )
    assert torch.allclose(found.log_scales.sort().values, one.log_scales.sort().values, atol=1e-4)


def test_levels_in_files_show_the_same(tmp_path: Path) -> None:
    gaussians = _scattered(20_000)
    write_levels(tmp_path, gaussians, "key")
    stored = open_levels(tmp_path, "key")
    assert stored is not None and open_levels(tmp_path, "other") is None
    for pixels in (0.0, 1.0, 0.0):  # pages that were given back are read again
        camera = _camera(100.0, 300.0)
        assert equal(make_levels_of_detail(gaussians).select(camera, pixels), stored.select(camera, pixels))
    file = tmp_path / "rows.bin"
    whole = file.read_bytes()
    for damaged in (b"", whole[:-1], whole[: len(whole) // 2], bytes(len(whole))):
        file.write_bytes(damaged)
        assert open_levels(tmp_path, "key") is None


def _inverted(gaussians: Gaussians, index: torch.Tensor) -> torch.Tensor:
    """Harmonics that depend on colours and on which Gaussian it is."""
    return -gaussians.harmonics * (index % 7)[:, None, None]


@pytest.mark.parametrize("room", [1 << 28, 100_000])
def test_a_look_shows_the_levels_of_recoloured_gaussians(
    room: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fprf.splats.levels._MAX_COLOUR_BYTES", room)
    gaussians = _scattered(20_000)
    index = torch.arange(len(gaussians))
    wanted = make_levels_of_detail(gaussians.recoloured(_inverted(gaussians, index)))
    write_levels(tmp_path, gaussians, "key")
    stored = open_levels(tmp_path, "key")
    assert stored is not None
    asked = []

    def recolour(part: Gaussians, which: torch.Tensor) -> torch.Tensor:
        assert torch.equal(part.means, gaussians.means[which])
        asked.append(len(which))
        return _inverted(part, which)

    styled = StyledLevels(stored, recolour)
    for distance, pixels in ((100.0, 0.0), (100.0, 1.0), (300.0, 1.0), (5.0, 1.0), (100.0, 1.0)):
        camera = _camera(distance, 300.0)
        assert equal(wanted.select(camera, pixels), styled.select(camera, pixels))
    before = len(asked)
    styled.select(_camera(100.0, 300.0), 1.0)
    assert len(styled.select(_camera(-1e4, 300.0), 1.0)) == 0
    assert (len(asked) == before) == (room > 1 << 20)  # what is kept is not computed again


def test_levels_stay_those_of_before_where_writing_ends_early(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_levels(tmp_path, _scattered(2000), "before")

    def interrupted(*args: object, **named: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("fprf.splats.levels.np.savez", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_levels(tmp_path, _scattered(2000).select(torch.arange(1999, -1, -1)), "after")
    assert open_levels(tmp_path, "before") is not None and open_levels(tmp_path, "after") is None
    assert [path.name for path in tmp_path.iterdir()] == ["rows.bin"]
