"""Photographs, crops, principal components, and the features of the teachers."""

from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from network_files import mobilenet_tensors
from photo_folder import photo_folder

from fprf.errors import DataError
from fprf.plugins.encoders.config import RandomConfig
from fprf.pretraining.photos import filtered_at, filtered_whole, find_photos, load_photo, random_pixels, split
from tools.distil.content import fit_basis
from tools.distil.examples import crop
from tools.distil.mobilenet import CLASSIFIER, DEEPLAB, MobileNetV2, fold


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return photo_folder(tmp_path_factory.mktemp("photos") / "all", 13)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_photos_are_found_at_every_depth_in_an_order_of_their_own(folder: Path, tmp_path: Path) -> None:
    (folder / "notes.txt").write_text("no photograph")
    found = find_photos([folder])
    assert sorted(path.name for path in found) == sorted(f"{index}.png" for index in range(13))
    assert [path.name for path in find_photos([photo_folder(tmp_path / "b", 13)])] == [path.name for path in found]
    learn, held = split(found)
    assert len(held) == 1
    assert not set(learn) & set(held)
    assert len(learn) + len(held) == 13


@settings(max_examples=25, deadline=None)
@given(height=st.integers(2, 50), width=st.integers(2, 50), size=st.integers(2, 24), seed=st.integers(0, 99))
def test_crops_are_squares_of_the_photo(height: int, width: int, size: int, seed: int) -> None:
    photo = torch.rand(height, width, 3)
    piece = crop(photo, size, (0.5, 2.0), generator(seed))
    assert piece.shape == (3, size, size)
    assert 0 <= piece.min() <= piece.max() <= 1
    assert torch.equal(piece, crop(photo, size, (0.5, 2.0), generator(seed)))
    flat = crop(torch.full((height, width, 3), 0.25), size, (0.5, 2.0), generator(seed))
    torch.testing.assert_close(flat, torch.full_like(flat, 0.25))


@settings(max_examples=10, deadline=None)
@given(features=st.integers(3, 8), seed=st.integers(0, 99))
def test_a_basis_is_orthonormal_and_keeps_what_it_says(features: int, seed: int) -> None:
    samples = torch.randn(400, features, generator=generator(seed)) @ torch.randn(features, features) + 3
    basis = fit_basis(samples, (1, 2, features), 0.8)
    channels = len(basis.axes)
    assert channels in (1, 2, features)
    torch.testing.assert_close(basis.axes @ basis.axes.T, torch.eye(channels), rtol=0, atol=1e-5)
    projected = basis.project(samples.T[None, :, :, None])[0, :, :, 0].double()
    assert abs(float(projected.mean())) < 1e-4
    assert float(projected.square().mean()) == pytest.approx(1, rel=1e-3)
    energy = (samples - samples.mean(0)).double().square().sum()
    assert float(projected.square().sum() * basis.scale**2 / energy) == pytest.approx(basis.kept, rel=1e-3)
    assert basis.kept >= 0.8 or channels == features


def test_filtered_pixels_are_those_of_the_whole_image(folder: Path) -> None:
    photo, encoder = load_photo(find_photos([folder])[0]), RandomConfig(channels=3, stride=2).build()
    pixels = random_pixels(photo, 40, generator())
    features, rgb = filtered_at(encoder, photo, pixels)
    assert torch.equal(rgb, photo[pixels[:, 0], pixels[:, 1]])
    all_of_them = filtered_whole(encoder, photo).view(*photo.shape[:2], 3)
    torch.testing.assert_close(features, all_of_them[pixels[:, 0], pixels[:, 1]], rtol=1e-4, atol=1e-5)


def test_missing_folders_and_photographs_are_named(tmp_path: Path) -> None:
    for folder in (tmp_path / "absent", tmp_path):
        with pytest.raises(DataError, match=folder.name):
            find_photos([folder])


FEATURES = {
    ("features", 0): (0.33216, 0.57769, -0.03302),
    ("features", 6): (0.01341, 0.24443, -0.01075),
    ("backbone", 1): (0.34478, 0.91846, 0.04636),
    ("backbone", 6): (0.13524, 0.34826, 0.05486),
    ("backbone", 17): (-1.64253, 4.34031, 1.5178),
}
"""Mean, deviation, and the mean weighted by a ramp from -1 to 1 over all values."""


@pytest.mark.parametrize(("network", "last"), FEATURES)
def test_features_of_fixed_weights(network: str, last: int) -> None:
    backbone = network == "backbone"
    folded = fold(mobilenet_tensors(folded=backbone), f"{network}.")
    encoder = MobileNetV2(folded, layout=DEEPLAB if backbone else CLASSIFIER, last=last)
    y, x = torch.meshgrid(torch.linspace(0, 1, 48), torch.linspace(0, 1, 80), indexing="ij")
    image = torch.stack([(6 * x).sin(), (9 * y).cos(), (12 * x * y).sin()])[None] / 2 + 0.5
    with torch.no_grad():
        found = encoder(image).double()
    ramp = torch.linspace(-1, 1, found.numel()).double().view(found.shape)
    measured = float(found.mean()), float(found.std()), float((found * ramp).mean())
    assert measured == pytest.approx(FEATURES[network, last], rel=1e-4, abs=1e-4)
