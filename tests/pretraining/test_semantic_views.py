"""Views of a crop and the teachers' word for them belong together; so do the bases and the teachers."""

from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from photo_folder import photo_folder, teacher_files

from fprf.errors import UsageError
from fprf.plugins.encoders.config import BundledSemanticConfig
from tools.distil.config import SemanticDistilConfig
from tools.distil.semantic import STRIDE, pretrain_semantic, relations, view


@settings(max_examples=30, deadline=None)
@given(cells=st.integers(2, 12), seed=st.integers(0, 999))
def test_a_view_and_its_target_show_the_same_place(cells: int, seed: int) -> None:
    """Targets are the mean position of their cell, images the position itself: the light changes, the order does not."""
    position = torch.arange(cells * STRIDE).float()
    image = (40 + 150 * position / len(position)).byte().expand(3, len(position), -1)
    target = torch.arange(cells).float().expand(2, cells, -1).contiguous()
    generator = torch.Generator().manual_seed(seed)
    seen, wanted = view(image, target, generator)
    side = wanted.shape[-1]
    assert seen.shape == (3, side * STRIDE, side * STRIDE)
    assert wanted.shape == (2, side, side)
    ramp = torch.nn.functional.avg_pool2d(seen[None], STRIDE)[0].mean((0, 1))
    if side > 1 and ramp.std() > 0.02:
        assert torch.corrcoef(torch.stack([ramp, wanted[0, 0]]))[0, 1] > 0.5


def test_views_are_functions_of_the_generator_and_vary() -> None:
    image = torch.randint(0, 256, (3, 64, 64), dtype=torch.uint8)
    target = torch.rand(4, 8, 8)
    views = [view(image, target, torch.Generator().manual_seed(seed)) for seed in (0, 0, 1)]
    assert torch.equal(views[0][0], views[1][0])
    assert torch.equal(views[0][1], views[1][1])
    assert not torch.equal(views[0][0], views[2][0])


def test_relations_compare_cosines_about_the_mean() -> None:
    """Turning, scaling and shifting all of a side changes nothing; another arrangement does. Against a plain loop."""
    generator = torch.Generator().manual_seed(0)
    wanted = torch.randn(2, 5, 4, 4, generator=generator).double()
    turn = torch.linalg.qr(torch.randn(5, 5, generator=generator).double()).Q
    moved = 3 * torch.einsum("ij,bjhw->bihw", turn, wanted)
    assert relations(moved, wanted, 4096, torch.Generator().manual_seed(1)) < 1e-20
    other = torch.randn(2, 5, 4, 4, generator=generator).double()
    found = relations(other, wanted, 6, torch.Generator().manual_seed(1))
    index = torch.randint(0, 32, (6,), generator=torch.Generator().manual_seed(1)).tolist()
    sides = []
    for side in (other, wanted):
        cells = [side[i // 16, :, i % 16 // 4, i % 4] for i in index]
        mean = sum(cells) / 6
        sides.append([(cell - mean) / (cell - mean).norm() for cell in cells])
    total = sum(float(sides[0][i] @ sides[0][j] - sides[1][i] @ sides[1][j]) ** 2 for i in range(6) for j in range(6)) / 36
    assert float(found) == pytest.approx(total, rel=1e-12)


def test_a_short_run_from_photographs_and_streets(tmp_path: Path) -> None:
    """Written, of the ensemble's width, measured."""
    photos = photo_folder(tmp_path / "photos", 5)
    config = SemanticDistilConfig(images=(photos,), teachers=teacher_files(tmp_path), size=32, towns=1, steps=2, batch=2)
    said: list[str] = []
    report = pretrain_semantic(config, tmp_path / "s.safetensors", said.append)
    assert "29 crops prepared" in said  # four photographs and five views in five palettes
    assert BundledSemanticConfig(weights=tmp_path / "s.safetensors").build().channels == 26 + 25
    assert report["steps"] == 2
    assert 0 < float(report["relative_l2"]) < 20


def test_a_size_that_splits_a_cell_is_refused(tmp_path: Path) -> None:
    config = SemanticDistilConfig(teachers=teacher_files(tmp_path), size=60)
    with pytest.raises(UsageError, match="multiples of 8"):
        pretrain_semantic(config, tmp_path / "s.safetensors", lambda _: None)
