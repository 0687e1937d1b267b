"""Lookup tables: the fit of a table to pairs of colours, and tables of a style as .cube files."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_world import World

from fprf.export.lut import colour_pairs, fit_table, moved, write_cube
from fprf.plugins.stylizers.config import RegionOtConfig
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.restyle import apply_style

seeds = st.integers(0, 2**31)


def drawn(seed: int, *shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def nodes(size: int) -> torch.Tensor:
    """Colours of the nodes [3 n n n], red along the last axis."""
    axis = torch.linspace(0, 1, size, dtype=torch.float64)
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")[::-1])


@given(seed=seeds, size=st.integers(2, 9))
def test_a_table_is_applied_trilinearly(seed: int, size: int) -> None:
    """Exact for what is linear in each colour, and at the nodes for anything."""
    table, colour = drawn(seed, 3, size, size, size), drawn(seed + 1, 50, 3)
    at = nodes(size)
    assert torch.allclose(moved(table, at.flatten(1).T).T.view_as(table), at + table, atol=1e-12)
    assert torch.equal(fit_table(colour, 1 - colour, torch.zeros(50), size), 0 * table), "0 without weights"
    if size == 2:
        product = at.prod(0).expand(3, -1, -1, -1)
        assert torch.allclose(moved(product, colour) - colour, colour.prod(-1, keepdim=True).expand(-1, 3), atol=1e-12)


def test_it_minimises_what_it_says() -> None:
    """No neighbouring table has a smaller energy (float64, brute force over the formula)."""
    colour, move = drawn(0, 40, 3), 0.2 * (drawn(1, 40, 3) - 0.5)
    size, smooth, reach = 4, 1e-3, 0.25
    table = fit_table(colour, colour + move, torch.ones(40), size)

    def energy(d: torch.Tensor) -> float:
        h = 1 / (size - 1)
        bend = sum(d.diff(dim=axis).square().sum() for axis in (1, 2, 3)) * h
        data = (moved(d, colour) - colour - move).square().sum(-1).mean()
        return float(data + smooth * (bend + d.square().sum() * h**3 / reach**2))

    best = energy(table)
    for seed in range(30):
        for length in (1e-2, 1e-4):
            assert energy(table + length * (drawn(seed + 2, 3, size, size, size) - 0.5)) > best


@pytest.mark.parametrize("size", [2, 5])
def test_red_changes_fastest(size: int, tmp_path: Path) -> None:
    shades = torch.tensor([1.0, 0.5, 0.25]).double()
    write_cube(tmp_path / "x.cube", nodes(size) * (shades - 1).view(3, 1, 1, 1), 'dusk "at" sea ü')
    lines = (tmp_path / "x.cube").read_text(encoding="ascii").splitlines()
    assert lines[0] == 'TITLE "dusk at sea "' and lines[1] == f"LUT_3D_SIZE {size}"
    assert lines[2:4] == ["DOMAIN_MIN 0.0 0.0 0.0", "DOMAIN_MAX 1.0 1.0 1.0"]
    rows = np.array([[float(word) for word in line.split()] for line in lines[4:]])
    axis = np.linspace(0, 1, size)
    blue, green, red = np.meshgrid(axis, axis, axis, indexing="ij")
    wanted = np.stack([red, green, blue], -1).reshape(-1, 3) * shades.numpy()
    assert np.abs(rows - wanted).max() <= 5e-7


def test_a_table_does_to_pictures_most_of_what_the_style_does(world: World) -> None:
    """Applied to the plain render of a test view, it is far closer to the restyled one than no table is.

    With one reference: what two of them do to one colour in two places, no table can do.
    """
    trained = world.load()
    known, made = (
        trained.known,
        apply_style(trained, StyleFile(StyleConfig(references=world.references[:1], stylizer=RegionOtConfig()))).restyle,
    )
    (plain, styled), share = colour_pairs(trained, [None, made], known.train)
    assert len(plain) == len(styled) == len(share) and torch.allclose(share.sum(1), torch.ones(len(share)), atol=1e-4)
    table = fit_table(plain, styled, share.sum(1), 17)
    before, after = (
        trained.restyled(look).render(known.cameras, known.test[0]).rgb.view(-1, 3).double() for look in (None, made)
    )
    left, whole = ((colour - after).square().mean().sqrt() for colour in (moved(table, before), before))
    assert float(left) < 0.2 * float(whole)
