from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from fprf.datamanagers.basis import Basis
from fprf.datamanagers.config import GuidedConfig
from fprf.errors import ConfigError, DataError
from fprf.ops.guided import upsample
from fprf.plugins.encoders.config import RandomConfig
from fprf.style.dictionary import build_dictionary
from fprf.style.references import read_reference

CONTENT = RandomConfig(channels=6, stride=2).build()
SEMANTIC = RandomConfig(channels=9, stride=8, seed=1).build()
BASIS = Basis(torch.randn(9, generator=torch.Generator().manual_seed(0)), torch.linalg.qr(torch.randn(9, 4))[0])


def photo(folder: Path, height: int, width: int, *, flat: bool = False) -> Path:
    rng = np.random.default_rng(0)
    pixels = np.full((height, width, 3), (40, 90, 200)) if flat else rng.integers(0, 256, (height // 4 + 1, width // 4 + 1, 3))
    smooth = cv2.resize(pixels.astype(np.uint8), (width, height), interpolation=cv2.INTER_LINEAR)
    path = folder / f"{height}x{width}.png"
    cv2.imwrite(str(path), smooth)
    return path


def test_samples_have_the_statistics_of_the_whole_filtered_image(tmp_path: Path) -> None:
    path = photo(tmp_path, 300, 420)
    r = read_reference(path, content=CONTENT, semantic=SEMANTIC, basis=BASIS, weight=2.0)
    assert r.name == "300x420.png" and r.weight == 2.0
    image = torch.from_numpy(np.ascontiguousarray(cv2.imread(str(path))[..., ::-1])).float() / 255
    for encoder, samples in ((CONTENT, r.content), (SEMANTIC, r.semantic)):
        maps = encoder(image.permute(2, 0, 1)[None])[0]
        full = upsample(maps, image, radius=round(0.08 * 300), eps=1e-3, stride=4).flatten(0, 1)
        # Projected after the filter here, before it there: both are linear.
        full = BASIS.project(full) if encoder is SEMANTIC else full
        sigma = full.std(0)
        assert 10_000 < len(samples) < 40_000
        assert float(((samples.mean(0) - full.mean(0)).abs() / sigma).max()) < 0.03
        assert float((samples.std(0) / sigma - 1).abs().max()) < 0.05


def test_without_semantics_there_are_none(tmp_path: Path) -> None:
    path = photo(tmp_path, 80, 90)
    for semantic, basis in ((None, None), (None, BASIS), (SEMANTIC, None)):
        r = read_reference(path, content=CONTENT, semantic=semantic, basis=basis)
        assert r.semantic.shape == (len(r.content), 0)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 700), (700, 3), (64, 64), (65, 1000)])
def test_any_shape_gives_a_dictionary(tmp_path: Path, height: int, width: int) -> None:
    r = read_reference(photo(tmp_path, height, width), content=CONTENT, semantic=SEMANTIC, basis=BASIS)
    assert len(r.content) == len(r.semantic) > 0
    assert all(bool(t.isfinite().all()) for t in build_dictionary([r])[:6])


def test_a_photograph_of_one_colour_gives_a_dictionary(tmp_path: Path) -> None:
    d = build_dictionary([read_reference(photo(tmp_path, 90, 90, flat=True), content=CONTENT, semantic=SEMANTIC, basis=BASIS)])
    assert all(bool(t.isfinite().all()) for t in d[:6])
    assert float(d.covariance.abs().max()) < 1e-6


def test_the_encoder_sees_what_longest_says_and_nothing_is_enlarged(tmp_path: Path) -> None:
    path = photo(tmp_path, 300, 400)
    assert len(read_reference(path, content=CONTENT, semantic=None, basis=None, longest=100).content) == 75 * 100
    whole = read_reference(path, content=CONTENT, semantic=None, basis=None, longest=4000)
    usual = read_reference(path, content=CONTENT, semantic=None, basis=None)
    assert torch.equal(whole.content, usual.content)


def test_the_scenes_filter_is_used(tmp_path: Path) -> None:
    path = photo(tmp_path, 100, 100)
    a, b = (
        read_reference(path, content=CONTENT, semantic=None, basis=None, guided=g)
        for g in (None, GuidedConfig(radius=0.3, eps=0.1))
    )
    assert not torch.allclose(a.content, b.content)


def test_unreadable_files_and_sizes_are_named(tmp_path: Path) -> None:
    (tmp_path / "x.jpg").write_bytes(b"no image")
    with pytest.raises(DataError, match=r"x\.jpg"):
        read_reference(tmp_path / "x.jpg", content=CONTENT, semantic=None, basis=None)
    with pytest.raises(ConfigError, match="longest"):
        read_reference(photo(tmp_path, 9, 9), content=CONTENT, semantic=None, basis=None, longest=8)
