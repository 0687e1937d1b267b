from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tiny_world import World

from fprf.export.lut import ColourPairs, apply_lattice, colour_pairs, fit_quality, identity, write_cube
from fprf.plugins.stylizers.config import RegionOtConfig
from fprf.rendering.renderer import Restyle
from fprf.training.loading import load_style
from fprf.training.restyle import restyle
from fprf.training.views import render_view


def read_cube(path: Path) -> np.ndarray:
    """Indexed [red, green, blue], by the format's own rules."""
    size, rows = 0, []
    for line in path.read_text(encoding="ascii").splitlines():
        word = line.split()
        if word[0] == "LUT_3D_SIZE":
            size = int(word[1])
        elif word[0][0] in "0123456789-.":
            rows.append([float(w) for w in word])
        else:
            assert word[0] in ("TITLE", "DOMAIN_MIN", "DOMAIN_MAX")
    return np.array(rows).reshape(size, size, size, 3).transpose(2, 1, 0, 3)


@pytest.mark.parametrize("size", [2, 5])
def test_red_changes_fastest(size: int, tmp_path: Path) -> None:
    table = identity(size) * torch.tensor([1.0, 0.5, 0.25]).double()
    write_cube(tmp_path / "x.cube", table, 'dusk "at" sea ü')
    assert np.abs(read_cube(tmp_path / "x.cube") - table.numpy()).max() <= 5e-7
    lines = (tmp_path / "x.cube").read_text().splitlines()
    assert lines[0] == 'TITLE "dusk at sea "' and lines[1] == f"LUT_3D_SIZE {size}"
    assert lines[2:4] == ["DOMAIN_MIN 0.0 0.0 0.0", "DOMAIN_MAX 1.0 1.0 1.0"]
    assert lines[4:6] == ["0.000000 0.000000 0.000000", f"{1 / (size - 1):.6f} 0.000000 0.000000"]
    assert len(lines) == 4 + size**3


def style(world: World, count: int = 1) -> Restyle:
    return restyle(world.load(), world.references[:count], RegionOtConfig()).restyle


def pairs_of(world: World, *styles: Restyle) -> ColourPairs:
    trained = world.load()
    known, scene = trained.known, load_style(trained.run)[0]
    return colour_pairs(trained.model, scene, known.cameras, known.train, trained.config.render, styles, rays=2000)


def test_pairs_are_colours_of_pixels_and_shares_of_regions(world: World) -> None:
    found = pairs_of(world, style(world), Restyle(style(world).stylizer, 0.0))
    assert found.plain.shape == (2000, 3) and found.styled.shape == (2, 2000, 3)
    assert torch.equal(found.styled[1], found.plain), "strength 0 is the scene itself"
    assert float((found.styled[0] - found.plain).abs().mean()) > 0.01
    assert found.share.shape == (2000, len(load_style(world.load().run)[0].share))
    total = found.share.sum(1)
    assert float(total.amax()) < 1 + 1e-5 and float(found.share.amin()) >= 0


def test_a_table_does_to_pictures_most_of_what_the_style_does(world: World) -> None:
    """Applied to the plain render of a test view, it is far closer to the restyled one than no table is.

    With one reference: what two of them do to one colour in two places, no table can do.
    """
    trained, made = world.load(), style(world)
    known = trained.known
    found = pairs_of(world, made)
    table, quality = fit_quality(found, 0, found.share.sum(1), 17)
    assert quality["rms"] < 0.2 * quality["rms_without"]
    view = known.test[0]
    plain = render_view(trained.model, known.facts, known.cameras, view, trained.config.render).rgb.view(-1, 3)
    styled = render_view(trained.model, known.facts, known.cameras, view, trained.config.render, made).rgb.view(-1, 3)
    graded = apply_lattice(table, plain)
    before, after = ((colour - styled).double().square().mean().sqrt() for colour in (plain, graded))
    assert float(after) < 0.2 * float(before)


def test_a_regions_table_fits_its_own_pixels_better_than_that_of_all(world: World) -> None:
    found = pairs_of(world, style(world, 2))
    whole, _ = fit_quality(found, 0, found.share.sum(1), 9)
    gains = []
    for k in range(found.share.shape[1]):
        weight = found.share[:, k].double()
        _, own = fit_quality(found, 0, found.share[:, k], 9)
        error = (apply_lattice(whole, found.plain) - found.styled[0]).double().square().mean(1)
        gains.append(own["rms"] - float((error * weight).sum() / weight.sum()) ** 0.5)
    assert max(gains) < 5e-3 and min(gains) < -0.01


def test_opencv_applies_it_alike(tmp_path: Path) -> None:
    """A table read back by hand and applied to a gradient agrees with the function, to 8 bits."""
    table = identity(9).square()
    write_cube(tmp_path / "x.cube", table, "x")
    read = torch.from_numpy(read_cube(tmp_path / "x.cube"))
    ramp = cv2.resize(np.random.default_rng(0).random((4, 4, 3)), (16, 16)).reshape(-1, 3)
    there, here = (apply_lattice(t, torch.from_numpy(ramp)) for t in (read, table))
    assert float((there - here).abs().amax()) < 1e-6
