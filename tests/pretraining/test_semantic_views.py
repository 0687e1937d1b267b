"""Views of a crop and the teachers' word for them belong together; so do the bases and the teachers."""

from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from photo_folder import photo_folder, teacher_files

from fprf.errors import UsageError
from fprf.plugins.encoders.config import BundledSemanticConfig
from fprf.pretraining.config import DistilConfig
from fprf.pretraining.photos import find_photos
from fprf.pretraining.semantic import STRIDE, pretrain_semantic, semantic_bases, semantic_report, view
from fprf.pretraining.teachers import load_teacher


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


def test_teachers_weigh_the_same(tmp_path: Path) -> None:
    config = DistilConfig(size=64, crops=1)
    photos = find_photos([photo_folder(tmp_path / "photos", 5)])
    teachers = semantic_bases([load_teacher(path) for path in teacher_files(tmp_path)], photos, config)
    assert [len(basis.axes) for _, basis in teachers] == [24, 24]
    report = semantic_report(BundledSemanticConfig().build(), teachers, photos[:2], config)
    assert report["crops"] == 2
    assert 0 < float(report["relative_l2"]) < 20


def test_a_size_that_splits_a_cell_is_refused(tmp_path: Path) -> None:
    config = DistilConfig(teachers=teacher_files(tmp_path), size=60)
    with pytest.raises(UsageError, match="multiples of 8"):
        pretrain_semantic(config, tmp_path / "s.safetensors", lambda _: None)
