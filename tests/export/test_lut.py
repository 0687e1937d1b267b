"""Lookup tables: the fit of a lattice to pairs of colours, and tables of a style as .cube files."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_world import World

from fprf.export.lut import apply_lattice, colour_pairs, fit_lattice, fit_quality, identity, write_cube
from fprf.plugins.stylizers.config import RegionOtConfig
from fprf.style.restyle import restyle
from fprf.training.loading import load_style
from fprf.training.views import render_view

seeds = st.integers(0, 2**31)


def drawn(seed: int, *shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@given(seed=seeds, size=st.integers(2, 9))
def test_a_table_is_applied_trilinearly(seed: int, size: int) -> None:
    """Exact for what is linear in each colour, and at the nodes for anything."""
    table, colour = drawn(seed, size, size, size, 3), drawn(seed + 1, 50, 3)
    nodes = identity(size)
    assert torch.allclose(apply_lattice(table, nodes.view(-1, 3)).view_as(table), table, atol=1e-12)
    assert torch.allclose(apply_lattice(nodes, colour), colour, atol=1e-12)
    assert torch.equal(fit_lattice(colour, 1 - colour, torch.zeros(50), size), nodes), "without weights it is the identity"
    product = nodes.prod(-1, keepdim=True).expand(-1, -1, -1, 3)
    if size == 2:
        assert torch.allclose(apply_lattice(product, colour), colour.prod(-1, keepdim=True).expand(-1, 3), atol=1e-12)
    assert torch.allclose(apply_lattice(nodes, 3 * colour - 1), (3 * colour - 1).clamp(0, 1), atol=1e-12)


def test_it_minimises_what_it_says() -> None:
    """No neighbouring table has a smaller energy (float64, brute force over the formula)."""
    colour, move = drawn(0, 40, 3), 0.2 * (drawn(1, 40, 3) - 0.5)
    size, smooth, reach = 4, 1e-3, 0.25
    table = fit_lattice(colour, colour + move, torch.ones(40), size)

    def energy(table: torch.Tensor) -> float:
        d, h = table - identity(size), 1 / (size - 1)
        bend = sum(d.diff(dim=axis).square().sum() for axis in range(3)) * h
        data = (apply_lattice(table, colour) - colour - move).square().sum(-1).mean()
        return float(data + smooth * (bend + d.square().sum() * h**3 / reach**2))

    best = energy(table)
    inner = (table > 1e-3) & (table < 1 - 1e-3)  # elsewhere the range binds
    for seed in range(30):
        change = 1e-2 * (drawn(seed + 2, size, size, size, 3) - 0.5) * inner
        assert energy(table + change) > best - 2e-5, "pairs of one small cell count at their mean"


@pytest.mark.parametrize("size", [2, 5])
def test_red_changes_fastest(size: int, tmp_path: Path) -> None:
    table = identity(size) * torch.tensor([1.0, 0.5, 0.25]).double()
    write_cube(tmp_path / "x.cube", table, 'dusk "at" sea ü')
    lines = (tmp_path / "x.cube").read_text(encoding="ascii").splitlines()
    assert lines[0] == 'TITLE "dusk at sea "' and lines[1] == f"LUT_3D_SIZE {size}"
    assert lines[2:4] == ["DOMAIN_MIN 0.0 0.0 0.0", "DOMAIN_MAX 1.0 1.0 1.0"]
    rows = np.array([[float(word) for word in line.split()] for line in lines[4:]])
    assert np.abs(rows.reshape(size, size, size, 3).transpose(2, 1, 0, 3) - table.numpy()).max() <= 5e-7


def test_a_table_does_to_pictures_most_of_what_the_style_does(world: World) -> None:
    """Applied to the plain render of a test view, it is far closer to the restyled one than no table is.

    With one reference: what two of them do to one colour in two places, no table can do.
    """
    trained = world.load()
    known, made = trained.known, restyle(trained, world.references[:1], RegionOtConfig()).restyle
    scene, config = load_style(trained.run)[0], trained.config.render
    found = colour_pairs(trained.model, scene, known.cameras, known.train, config, [made], rays=2000)
    table, quality = fit_quality(found, 0, found.share.sum(1), 17)
    assert quality["rms"] < 0.2 * quality["rms_without"]
    view = known.test[0]
    plain, styled = (
        render_view(trained.model, known.facts, known.cameras, view, config, look).rgb.view(-1, 3) for look in (None, made)
    )
    graded = apply_lattice(table, plain)
    before, after = ((colour - styled).double().square().mean().sqrt() for colour in (plain, graded))
    assert float(after) < 0.2 * float(before)
