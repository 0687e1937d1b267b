from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from photo_files import turned_jpeg

from fprf.datamanagers.basis import Basis
from fprf.errors import DataError
from fprf.ops.guided import upsample
from fprf.plugins.encoders.config import RandomConfig
from fprf.style.dictionary import Encoders, build_dictionary, encode_photograph
from fprf.testing.cases import scene

CONTENT = RandomConfig(channels=6, stride=2).build()
SEMANTIC = RandomConfig(channels=9, stride=8, seed=1).build()
BASIS = Basis(torch.randn(9, generator=torch.Generator().manual_seed(0)), torch.linalg.qr(torch.randn(9, 4))[0])
ENCODERS = Encoders(CONTENT, SEMANTIC, BASIS, scene(1, 6, 4))


def photo(folder: Path, height: int, width: int, *, flat: bool = False) -> Path:
    rng = np.random.default_rng(0)
    pixels = np.full((height, width, 3), (40, 90, 200)) if flat else rng.integers(0, 256, (height // 4 + 1, width // 4 + 1, 3))
    smooth = cv2.resize(pixels.astype(np.uint8), (width, height), interpolation=cv2.INTER_LINEAR)
    path = folder / f"{height}x{width}.png"
    cv2.imwrite(str(path), smooth)
    return path


def test_samples_have_the_statistics_of_the_whole_filtered_image(tmp_path: Path) -> None:
    path = photo(tmp_path, 300, 420)
    r = encode_photograph(path, ENCODERS, name="it", weight=2.0)
    assert r.name == "it" and r.weight == 2.0
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


def test_a_photograph_on_its_side_is_the_upright_one_bit_for_bit(tmp_path: Path) -> None:
    stored, mask = cv2.imread(str(photo(tmp_path, 96, 128))), np.zeros((96, 128, 3), np.uint8)
    mask[:40, :90] = 255
    for name, pixels in (("photo", stored), ("mask", mask)):
        upright = turned_jpeg(tmp_path / f"{name}.jpg", pixels, 6)
        cv2.imwrite(str(tmp_path / f"{name}.png"), upright[:, :, ::-1])
    for masked in (False, True):
        turned, plain = (
            encode_photograph(
                tmp_path / f"photo.{kind}", ENCODERS, name="it", mask=tmp_path / f"mask.{kind}" if masked else None
            )
            for kind in ("jpg", "png")
        )
        for a, b in zip(turned[1:3], plain[1:3], strict=True):
            assert isinstance(a, torch.Tensor) and torch.equal(a, b)
        assert turned.colour is not None and plain.colour is not None and torch.equal(turned.colour, plain.colour)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 700), (700, 3), (64, 64), (65, 1000)])
def test_any_shape_gives_a_dictionary(tmp_path: Path, height: int, width: int) -> None:
    r = encode_photograph(photo(tmp_path, height, width), ENCODERS, name="it")
    assert len(r.content) == len(r.semantic) > 0
    assert all(bool(t.isfinite().all()) for t in build_dictionary([r])[:6])


def two_halves(folder: Path, *, mask_size: tuple[int, int] = (80, 120), white: int = 255) -> tuple[Path, Path]:
    """A photograph that is dark on the left and light on the right, and a mask of its right half."""
    image = np.zeros((80, 120, 3), np.uint8)
    image[:, :60], image[:, 60:] = (30, 40, 50), (210, 200, 190)
    mask = np.zeros(mask_size, np.uint8)
    mask[:, mask_size[1] // 2 :] = white
    for name, pixels in (("photo.png", image), ("mask.png", mask)):
        cv2.imwrite(str(folder / name), pixels)
    return folder / "photo.png", folder / "mask.png"


def test_a_mask_leaves_only_what_is_white(tmp_path: Path) -> None:
    path, mask = two_halves(tmp_path)
    whole, some = (encode_photograph(path, ENCODERS._replace(longest=120), name="it", mask=m) for m in (None, mask))
    assert len(some.content) == len(some.semantic) == len(whole.content) // 2
    grid = whole.content.view(80, 120, -1)
    assert torch.equal(some.content, grid[:, 60:].reshape(-1, grid.shape[-1])), "the same features, of fewer pixels"


def test_unreadable_files_and_masks_that_cannot_be_are_named(tmp_path: Path) -> None:
    (tmp_path / "x.jpg").write_bytes(b"no image")
    (tmp_path / "turned").mkdir()
    cases = [
        (tmp_path / "x.jpg", None),
        two_halves(tmp_path / "turned", mask_size=(120, 80)),
        two_halves(tmp_path, white=0),
        (tmp_path / "photo.png", tmp_path / "absent.png"),
    ]
    for path, mask in cases:
        with pytest.raises(DataError, match=(mask or path).name):
            encode_photograph(path, ENCODERS, name="it", mask=mask)
