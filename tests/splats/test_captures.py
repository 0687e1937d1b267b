"""Many captures in one style, captures larger than the sample that is looked at, and captures as
references.
"""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from splat_ball import ball

from benchmarks.town.write import write_town
from fprf.cli import main as cli
from fprf.io.images import srgb_to_linear
from fprf.light.config import LightName
from fprf.ops.harmonics import HARMONIC
from fprf.plugins.encoders.config import BundledSemanticConfig
from fprf.plugins.stylizers.config import RegionToneConfig
from fprf.rendering.local_frame import write_offset
from fprf.splats.capture_light import neighbouring_light
from fprf.splats.captures import open_captures
from fprf.splats.config import GaussianSemanticsConfig, LookConfig
from fprf.splats.files import read_capture, write_gaussians
from fprf.splats.gaussians import Gaussians
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.restyle import apply_style

SMALL = ["--semantic.encoder", "bundled-semantic", "--regions", "4", "--views", "6", "--size", "64", "48"]


def halves(folder: Path, made: Gaussians) -> list[Path]:
    """The two sides of a ball, each in a file of its own."""
    left = made.means[:, 0] < 0
    paths = [folder / "left.ply", folder / "right.spz"]
    for path, side in zip(paths, (left, ~left), strict=True):
        write_gaussians(path, made.select(side))
    return paths


def test_neighbouring_captures_take_one_style(photograph: Path, tmp_path: Path) -> None:
    """As the whole capture takes it: the maps are those of both, and both files keep their format and their
    place.
    """
    made = ball(600)
    paths = halves(tmp_path, made)
    words = [*SMALL, "--cache", str(tmp_path / "cache"), "--references", str(photograph)]
    (tmp_path / "out").mkdir()
    assert cli.main(["restyle", *map(str, paths), *words, "--output", str(tmp_path / "out")]) == 0
    assert len(list((tmp_path / "cache").iterdir())) == 1
    write_gaussians(tmp_path / "whole.ply", made)
    assert (
        cli.main(["restyle", str(tmp_path / "whole.ply"), *words, "--output", str(tmp_path / "all.ply")]) == 0
    )
    whole = read_capture(tmp_path / "all.ply").gaussians
    for path in paths:
        before = read_capture(path).gaussians
        after = read_capture(tmp_path / "out" / path.name).gaussians
        assert torch.equal(before.means, after.means)
        same = torch.cdist(after.means, whole.means).argmin(1)
        assert (after.colours - whole.colours[same]).abs().mean() < 0.03
        assert (after.colours - before.colours).abs().mean() > 0.1
    assert (tmp_path / "out" / "left.style.json").is_file()


def look() -> LookConfig:
    semantic = replace(GaussianSemanticsConfig(), encoder=BundledSemanticConfig())
    return LookConfig(views=6, size=(64, 48), regions=4, semantic=semantic)


@pytest.mark.parametrize(("far", "light"), [(0.0, None), (1e5, None), (1e5, "noon")])
def test_a_sample_tells_the_colours_of_all(
    far: float, light: LightName | None, photograph: Path, tmp_path: Path
) -> None:
    """Strays in the sample, too, are no neighbours of all others."""
    made = ball(4000)
    path = tmp_path / "in.ply"
    made.means[8::800] -= far
    made.means[5] = torch.nan
    write_gaussians(path, made)
    stylizer = RegionToneConfig(centred=False)
    style = StyleFile(StyleConfig(references=(photograph,), stylizer=stylizer, light=light))
    seen = open_captures([path], look(), sample=1000, cache=tmp_path / "cache")
    restyle = apply_style(seen.scene, style).restyle
    found = seen.harmonics(0, seen.first, seen.scene.restyled(restyle))
    shown = seen.scene.restyled(restyle).shown
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


def test_an_offset_that_changed_is_looked_at_again(tmp_path: Path) -> None:
    paths = halves(tmp_path, ball(200))
    for k, east in enumerate((0.0, 5.0), 1):
        write_offset(paths[1], (east, 0.0, 0.0))
        open_captures(paths, look(), cache=tmp_path / "cache").scene.found()
        assert len(list((tmp_path / "cache").iterdir())) == k


def test_a_page_of_several_captures_tells_how_many_gaussians(
    photograph: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        *SMALL,
        "--cache",
        str(tmp_path / "cache"),
        "--references",
        str(photograph),
        "--page",
        str(tmp_path / "x.html"),
    ]
    assert cli.main(["restyle", *map(str, halves(tmp_path, ball(200))), *words]) == 0
    assert "200 Gaussians in 2 files" in capsys.readouterr().out


@pytest.mark.parametrize("flags", [[], ["--match-light", "true"]])
def test_a_capture_gives_its_light_to_another(flags: list[str], tmp_path: Path) -> None:
    """The same ball under a warmer and darker light comes back; views of the reference stand beside the
    output.
    """
    made = ball(800, degree=0)
    gain = torch.tensor([1.15, 0.9, 0.65])
    dark = made.recoloured(((made.colours + 0.055) * gain - 0.055 - 0.5)[:, None] / 0.28209479)
    write_gaussians(tmp_path / "day.spz", made)
    write_gaussians(tmp_path / "dusk.ply", dark)
    words = ["restyle", str(tmp_path / "dusk.ply"), *SMALL, "--cache", str(tmp_path / "cache"), *flags]
    assert (
        cli.main([*words, "--references", str(tmp_path / "day.spz"), "--output", str(tmp_path / "out.ply")])
        == 0
    )
    found = read_capture(tmp_path / "out.ply").gaussians
    error, before = ((each.colours - made.colours).square().mean().sqrt() for each in (found, dark))
    assert error < 0.3 * before or not flags, "semantics of so small a ball tell nothing apart"
    views = sorted((tmp_path / "out.references" / "day").glob("*.png"))
    style = json.loads((tmp_path / "out.style.json").read_text())["style"]
    assert len(views) == 12 and len(style["references"]) == 6 and sum(style["weights"]) == pytest.approx(1)


def test_what_is_said_of_a_capture_holds_for_each_of_its_views(photograph: Path, tmp_path: Path) -> None:
    """Captures of one name keep their views apart; number 1 is the second reference, not a view of the
    first.
    """
    paths = [tmp_path / name for name in ("in.ply", "a/light.ply", "b/light.ply")]
    for path in paths:
        write_gaussians(path, ball(200))
    words = ["restyle", str(paths[0]), *SMALL, "--cache", str(tmp_path / "cache"), "--weights", "1", "2", "1"]
    words += ["--pin", "everywhere=1", "--masks", "none", "none", str(photograph)]
    assert (
        cli.main(
            [
                *words,
                "--references",
                *map(str, paths[1:]),
                str(photograph),
                "--output",
                str(tmp_path / "out.ply"),
            ]
        )
        == 0
    )
    style = json.loads((tmp_path / "out.style.json").read_text())["style"]
    assert len(set(style["references"])) == 13 and style["pin"] == [f"everywhere={k}" for k in range(6, 12)]
    assert [sum(style["weights"][k : k + 6]) for k in (0, 6, 12)] == pytest.approx([1, 2, 1])


def test_each_style_of_several_files_has_its_own_names(
    photograph: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = [tmp_path / f"{name}.png" for name in ("x.1", "x.compressed")]
    paths = [tmp_path / f"in.{k}.ply" for k in (0, 1)]
    for photo, path in zip(photos, paths, strict=True):
        photo.write_bytes(photograph.read_bytes())
        made = ball(200)
        made.means[:3] = torch.nan
        write_gaussians(path, made)
    words = [*SMALL, "--cache", str(tmp_path / "cache"), "--explain", "--output", str(tmp_path / "out")]
    assert cli.main(["restyle", *map(str, paths), *words]) == 0
    assert "no capture is written" in capsys.readouterr().out
    assert cli.main(["restyle", *map(str, paths), *words, "--each", "--references", *map(str, photos)]) == 0
    assert "6 that are not finite left as they are" in capsys.readouterr().out
    names = {
        f"in.{k}-{style}{end}"
        for k in (0, 1)
        for style in ("x_1", "x_compressed")
        for end in (".ply", ".style.json")
    }
    assert names == {path.name for path in (tmp_path / "out").glob("in.*")}


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
    words = [
        "restyle",
        str(tmp_path / "in.ply"),
        *SMALL,
        "--cache",
        str(tmp_path / "cache"),
        "--references",
        str(photograph),
    ]
    words += ["--output", str(tmp_path / "out.ply")]
    assert (
        subprocess.run([sys.executable, "-c", code, *words], check=False, capture_output=True).returncode == 9
    )
    assert not (tmp_path / "out.ply").exists()
    assert cli.main(words) == 0 and len(read_capture(tmp_path / "out.ply").gaussians) == 300


def town(folder: Path, light: str) -> Gaussians:
    """The surface points of the town as Gaussians."""
    write_town(folder / light, seed=3, palette=light, views=24, width=120, height=90)
    points = np.load(folder / light / "points.npz")
    means = torch.from_numpy(points["xyz"])
    sizes = (
        torch.cdist(means, means).topk(4, largest=False).values[:, 1:].mean(1).clamp(0.02, 1.0).log() - 0.3
    )
    turns = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(len(means), 4)
    harmonics = ((torch.from_numpy(points["rgb"]) / 255 - 0.5) / HARMONIC)[:, None]
    return Gaussians(means, turns, sizes[:, None].expand(-1, 3), torch.full((len(means),), 4.0), harmonics)


TOWN = ["--up", "0", "0", "1", "--semantic.encoder", "bundled-semantic", "--regions", "8"]
TOWN += ["--views", "12", "--size", "160", "120"]


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("gain", [(1.3, 0.9, 0.55), (0.6, 0.6, 0.6)])
def test_two_halves_in_different_light_meet_without_a_step(
    axis: int, gain: tuple[float, float, float], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The step across the seam is at most 1.2 times the error inside, and both are far below the difference
    as captured.
    """
    made = town(tmp_path, "day")
    made = made.recoloured(((made.colours.clamp(0, 1) - 0.5) / HARMONIC)[:, None])
    along = made.means[:, axis]
    seam = along.median()
    first = made.select(along < seam)
    second = made.select(along >= seam)
    linear = srgb_to_linear(second.colours.numpy()) * np.array(gain)
    shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    other = second.recoloured(((torch.from_numpy(shown).float() - 0.5) / HARMONIC)[:, None])
    write_gaussians(tmp_path / "first.ply", first)
    write_gaussians(tmp_path / "second.ply", other)
    words = ["restyle", str(tmp_path / "second.ply"), "--references", str(tmp_path / "first.ply"), *TOWN]
    words += [
        "--cache",
        str(tmp_path / "cache"),
        "--match-light",
        "true",
        "--output",
        str(tmp_path / "out.ply"),
    ]
    assert cli.main(words) == 0
    assert "where the captures meet" in capsys.readouterr().err
    error = read_capture(tmp_path / "out.ply").gaussians.colours.clamp(0, 1) - second.colours.clamp(0, 1)
    near = second.means[:, axis] - seam < 0.05 * (along.max() - along.min())
    step, inside = (float(part.square().mean().sqrt()) for part in (error[near], error[~near]))
    before = float((other.colours.clamp(0, 1) - second.colours.clamp(0, 1)).square().mean().sqrt())
    assert step <= 1.2 * inside and inside < 0.3 * before


def test_captures_of_different_places_have_no_light_in_common(tmp_path: Path) -> None:
    made = ball(3000)
    write_gaussians(tmp_path / "a.ply", made)
    seen = open_captures([tmp_path / "a.ply"], look(), cache=tmp_path / "cache")
    gain = torch.tensor([1.1, 0.9, 0.7])
    for name, others, wanted in (
        ("same", made.colours, gain),
        ("other", made.colours[torch.randperm(3000)], None),
    ):
        other = made.recoloured((((others + 0.055) * gain - 0.055 - 0.5) / HARMONIC)[:, None])
        write_gaussians(tmp_path / f"{name}.ply", other)
        found = neighbouring_light(seen, [tmp_path / f"{name}.ply"])
        assert found is wanted is None or torch.allclose(found.float(), wanted, atol=1e-3)
    write_gaussians(tmp_path / "far.ply", replace(made, means=made.means + 50))
    assert neighbouring_light(seen, [tmp_path / "far.ply"]) is None
