"""Many captures in one style, captures larger than the sample that is looked at, and captures as references."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from splat_ball import ball

from benchmarks.town.write import write_town
from fprf.cli import main as cli
from fprf.ops.harmonics import HARMONIC
from fprf.plugins.encoders.config import BundledSemanticConfig
from fprf.plugins.stylizers.config import RegionToneConfig
from fprf.splats.captures import Neighbours, open_captures, sampled
from fprf.splats.config import GaussianSemanticsConfig, LookConfig
from fprf.splats.files import read_capture, write_gaussians
from fprf.splats.gaussians import Gaussians
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.restyle import apply_style

SMALL = ["--semantic.encoder", "bundled-semantic", "--regions", "4", "--views", "6", "--size", "64", "48"]


@pytest.fixture
def photograph(tmp_path: Path) -> Path:
    noise = np.random.default_rng(0).integers(0, 120, (64, 96, 3), np.uint8)
    noise[:32] += 100
    cv2.imwrite(str(tmp_path / "style.png"), noise)
    return tmp_path / "style.png"


def halves(folder: Path, made: Gaussians) -> list[Path]:
    """The two sides of a ball, each in a file of its own."""
    left = made.means[:, 0] < 0
    paths = [folder / "left.ply", folder / "right.spz"]
    for path, side in zip(paths, (left, ~left), strict=True):
        write_gaussians(path, made.select(side))
    return paths


def test_neighbouring_captures_take_one_style(photograph: Path, tmp_path: Path) -> None:
    """As the whole capture takes it: the maps are those of both, and both files keep their format and their place."""
    made = ball(600)
    paths = halves(tmp_path, made)
    words = [*SMALL, "--cache", str(tmp_path / "cache"), "--references", str(photograph)]
    (tmp_path / "out").mkdir()
    assert cli.main(["restyle", *map(str, paths), *words, "--output", str(tmp_path / "out")]) == 0
    assert len(list((tmp_path / "cache").iterdir())) == 1
    write_gaussians(tmp_path / "whole.ply", made)
    assert cli.main(["restyle", str(tmp_path / "whole.ply"), *words, "--output", str(tmp_path / "all.ply")]) == 0
    whole = read_capture(tmp_path / "all.ply").gaussians
    for path in paths:
        before, after = read_capture(path).gaussians, read_capture(tmp_path / "out" / path.name).gaussians
        assert torch.equal(before.means, after.means)
        same = torch.cdist(after.means, whole.means).argmin(1)
        assert (after.colours - whole.colours[same]).abs().mean() < 0.03
        assert (after.colours - before.colours).abs().mean() > 0.1
    assert (tmp_path / "out" / "left.style.json").is_file()


def look() -> LookConfig:
    semantic = replace(GaussianSemanticsConfig(), encoder=BundledSemanticConfig())
    return LookConfig(views=6, size=(64, 48), regions=4, semantic=semantic)


def test_a_sample_tells_the_colours_of_all(photograph: Path, tmp_path: Path) -> None:
    made, path = ball(4000), tmp_path / "in.ply"
    made.means[5] = torch.nan
    write_gaussians(path, made)
    style = StyleFile(StyleConfig(references=(photograph,), stylizer=RegionToneConfig(centred=False)))
    seen = open_captures([path], look(), sample=1000, cache=tmp_path / "cache")
    restyle = apply_style(seen.scene, style).restyle
    found, shown = seen.harmonics(0, seen.first, restyle), seen.scene.restyled(restyle).shown
    assert len(found) == 3999 and len(shown) == 1000
    before = made.harmonics[seen.first.gaussians.finite]
    at = torch.cdist(shown.means, seen.first.gaussians.drawable().means).argmin(1)
    change = (shown.harmonics - before[at])[:, 0].abs().mean()
    assert (found[at] - shown.harmonics)[:, 0].abs().mean() < 0.1 * change
    assert (found - before)[:, 0].abs().mean() > 0.5 * change


def test_captures_in_one_place_are_seen_beside_each_other(tmp_path: Path) -> None:
    for name in ("a.ply", "b.ply"):
        write_gaussians(tmp_path / name, ball(200, degree=int(name == "b.ply")))
    seen = open_captures([tmp_path / "a.ply", tmp_path / "b.ply"], look(), cache=tmp_path / "cache")
    first, second = (seen.scene.gaussians.means[rows] for rows in seen.rows)
    assert first[:, 0].max() < second[:, 0].min() + 0.5 and seen.scene.gaussians.degree == 1


def test_neighbours_take_the_features_of_the_smallest_cell() -> None:
    draw = torch.Generator().manual_seed(0)
    points = torch.rand(500, 3, generator=draw)
    near = Neighbours(points, points.half())
    assert torch.allclose(near(points).float(), points, atol=2e-2)
    places = torch.rand(300, 3, generator=draw)
    assert (near(places).float() - places).abs().mean() < 0.1
    assert bool(near(torch.tensor([[1e9, -1e9, 0.0]])).isfinite().all())


def test_sampled_gaussians_cover_as_much(tmp_path: Path) -> None:
    made = ball(5000)
    made.log_scales.sub_(2.5)
    some = sampled(made, 500)
    assert len(some) == 500
    areas = [float(part.log_scales.mul(2).exp().sum()) for part in (made, some)]
    assert areas[1] == pytest.approx(areas[0], rel=0.1)


@pytest.mark.parametrize("flags", [[], ["--match-light", "true"]])
def test_a_capture_gives_its_light_to_another(flags: list[str], tmp_path: Path) -> None:
    """The same ball under a warmer and darker light comes back; views of the reference stand beside the output."""
    made = ball(800, degree=0)
    gain = torch.tensor([1.15, 0.9, 0.65])
    dark = made.recoloured(((made.colours + 0.055) * gain - 0.055 - 0.5)[:, None] / 0.28209479)
    write_gaussians(tmp_path / "day.spz", made)
    write_gaussians(tmp_path / "dusk.ply", dark)
    words = ["restyle", str(tmp_path / "dusk.ply"), *SMALL, "--cache", str(tmp_path / "cache"), *flags]
    assert cli.main([*words, "--references", str(tmp_path / "day.spz"), "--output", str(tmp_path / "out.ply")]) == 0
    found = read_capture(tmp_path / "out.ply").gaussians
    error, before = ((each.colours - made.colours).square().mean().sqrt() for each in (found, dark))
    assert error < 0.3 * before or not flags, "semantics of so small a ball tell nothing apart"
    views = sorted((tmp_path / "out.references" / "day").iterdir())
    style = json.loads((tmp_path / "out.style.json").read_text())["style"]
    assert len(views) == 12 and len(style["references"]) == 6 and sum(style["weights"]) == pytest.approx(1)


def test_a_killed_restyle_leaves_no_half_file(photograph: Path, tmp_path: Path) -> None:
    write_gaussians(tmp_path / "in.ply", ball(300))
    code = """
import sys
from fprf.splats.files import ply
whole = ply.Ply.write
def cut(self, path, pieces):
    def some():
        yield next(iter(pieces))
        import os
        os._exit(9)
    whole(self, path, some())
ply.Ply.write = cut
from fprf.cli import main
main.main(sys.argv[1:])
"""
    words = ["restyle", str(tmp_path / "in.ply"), *SMALL, "--cache", str(tmp_path / "cache"), "--references", str(photograph)]
    words += ["--output", str(tmp_path / "out.ply")]
    assert subprocess.run([sys.executable, "-c", code, *words], check=False, capture_output=True).returncode == 9
    assert not (tmp_path / "out.ply").exists()
    assert cli.main(words) == 0 and len(read_capture(tmp_path / "out.ply").gaussians) == 300


@pytest.mark.slow
def test_the_town_in_another_light_comes_3_db_nearer_to_the_truth(tmp_path: Path) -> None:
    """Its surface points as Gaussians, by day and at sunset; the truth is the same points by day."""
    made: dict[str, Gaussians] = {}
    for light in ("day", "sunset"):
        write_town(tmp_path / light, seed=3, palette=light, views=24, width=120, height=90)
        points = np.load(tmp_path / light / "points.npz")
        means = torch.from_numpy(points["xyz"])
        sizes = torch.cdist(means, means).topk(4, largest=False).values[:, 1:].mean(1).clamp(0.02, 1.0).log() - 0.3
        turns = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(len(means), 4)
        harmonics = ((torch.from_numpy(points["rgb"]) / 255 - 0.5) / HARMONIC)[:, None]
        opaque = torch.full((len(means),), 4.0)
        made[light] = Gaussians(means, turns, sizes[:, None].expand(-1, 3), opaque, harmonics)
        write_gaussians(tmp_path / f"{light}.ply", made[light])
    words = ["restyle", str(tmp_path / "sunset.ply"), "--references", str(tmp_path / "day.ply"), "--up", "0", "0", "1"]
    words += ["--semantic.encoder", "bundled-semantic", "--regions", "8", "--views", "12", "--size", "160", "120"]
    words += ["--cache", str(tmp_path / "cache"), "--output", str(tmp_path / "out.ply")]
    truth = made["day"].colours.clamp(0, 1)

    def psnr(gaussians: Gaussians) -> float:
        return float(-10 * (gaussians.colours.clamp(0, 1) - truth).square().mean().log10())

    captured = psnr(made["sunset"])
    for flags, gained in (([], 3.0), (["--match-light", "true"], 2.0)):
        assert cli.main([*words, *flags]) == 0
        assert psnr(read_capture(tmp_path / "out.ply").gaussians) > captured + gained
