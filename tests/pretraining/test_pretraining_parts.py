"""Photographs, crops, principal components, and the features of the teachers."""

from pathlib import Path

import pytest
import torch
from network_files import mobilenet_tensors
from photo_folder import photo_folder

from fprf.errors import DataError
from fprf.plugins.encoders.config import RandomConfig
from fprf.pretraining.photos import filtered_at, filtered_whole, find_photos, load_photo, random_pixels, split
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
