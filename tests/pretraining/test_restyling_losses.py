"""Photographs, features of the teachers, and the losses of the paper against their formulas."""

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from network_files import vgg_convolutions
from photo_folder import photo_folder
from safetensors.torch import save_file

from fprf.errors import DataError, WeightsError
from fprf.plugins.encoders.config import RandomConfig
from fprf.plugins.encoders.vgg import VggEncoder
from fprf.pretraining.decoder import (
    CONTENT,
    StyleNetwork,
    load_style_network,
    prepare_crops,
    restyling_losses,
    style_statistics,
)
from fprf.pretraining.photos import filtered_at, filtered_whole, find_photos, load_photo, random_pixels, split

PLACES = dict(zip((0, 2, 5, 7, 10, 12, 14, 16, 19), (4, 4, 6, 6, 8, 8, 8, 8, 10), strict=True))
"""Filters of each convolution."""


def network() -> StyleNetwork:
    tensors = vgg_convolutions(dict(list(PLACES.items())[:8]), seed=1, biased=False)
    mean = torch.full((3,), 0.45)
    std = torch.full((3,), 0.25)
    return StyleNetwork(
        VggEncoder("relu3_4", tensors, mean=mean, std=std, scale=torch.ones(1), source="seeded")
    )


def test_layers_end_where_the_weights_do(tmp_path: Path) -> None:
    for count, last in ((8, "relu3_4"), (9, "relu4_1")):
        tensors = vgg_convolutions(dict(list(PLACES.items())[:count]))
        save_file(tensors, tmp_path / "vgg.safetensors")
        found = load_style_network(tmp_path / "vgg.safetensors")
        assert found.layers == ["relu1_1", "relu2_1", "relu3_1", last]
        assert found.layers[CONTENT] == "relu2_1"
        assert not list(found.parameters())
    del tensors["features.16.weight"]
    save_file(tensors, tmp_path / "short.safetensors")
    with pytest.raises(WeightsError, match="short"):
        load_style_network(tmp_path / "short.safetensors")


def test_activations_are_the_convolutions_in_float64() -> None:
    net = network()
    image = torch.rand(2, 3, 18, 22)
    x = (image.double() - 0.45) / 0.25
    expected = []
    for i, name in enumerate(("1_1", "1_2", "2_1", "2_2", "3_1", "3_2", "3_3", "3_4")):
        if name in ("2_1", "3_1"):
            x = F.max_pool2d(x, 2, ceil_mode=True)
        padded = F.pad(x, (1, 1, 1, 1), mode="reflect")
        x = F.conv2d(padded, net.encoder.get_buffer(f"weight{i}").double()).clamp_min(0)
        if i in (0, 2, 4, 7):
            expected.append(x)
    for found, wanted in zip(net(image), expected, strict=True):
        torch.testing.assert_close(found.double(), wanted, rtol=1e-5, atol=1e-5)


def test_a_perfect_decoder_loses_nothing_on_its_own_crop(photos: Path) -> None:
    """Colours as features: AdaIN with itself is the crop, so decoding it by doing nothing has neither
    loss.
    """
    encoder = RandomConfig(channels=3, stride=1).build()
    net = network()
    made = prepare_crops(encoder, net, find_photos([photos]), side=24, longest=96, seed=0, measure=True)
    rgb = torch.stack([load_photo(path, 96)[:24, :24].reshape(-1, 3) for path in find_photos([photos])])
    seen = net(rgb.view(-1, 24, 24, 3).permute(0, 3, 1, 2))
    statistics = style_statistics(seen)
    mean, std = (half[:, :, None, None] for half in statistics[CONTENT].chunk(2, 1))
    crops = made._replace(
        features=rgb,
        mean=rgb.mean(1),
        std=rgb.std(1, correction=0),
        structure=(seen[CONTENT] - mean) / std,
        style=tuple(statistics),
    )
    same = torch.tensor([1])
    other = torch.tensor([2])
    assert all(float(loss) < 1e-6 for loss in restyling_losses(crops, net, lambda f: f, same, same))
    content, style = restyling_losses(crops, net, lambda f: f, same, other)
    assert float(style) > 1e-4
    upside_down, _ = restyling_losses(crops, net, lambda f: f.flip(0), same, other)
    assert float(upside_down) > float(content), "the content loss sees where things are"


def test_gradients_reach_the_decoder_alone(photos: Path) -> None:
    encoder = RandomConfig(channels=3, stride=2).build()
    net = network()
    crops = prepare_crops(encoder, net, find_photos([photos]), side=16, longest=64, seed=0, measure=True)
    decoder = torch.nn.Linear(3, 3)
    losses = restyling_losses(
        crops, net, lambda f: torch.sigmoid(decoder(f)), torch.tensor([0, 1]), torch.tensor([2, 3])
    )
    for loss in losses:
        (gradient,) = torch.autograd.grad(loss, [decoder.weight], retain_graph=True)
        assert bool(gradient.isfinite().all()) and float(gradient.abs().sum()) > 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return photo_folder(tmp_path_factory.mktemp("photos") / "all", 13)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_photos_are_found_at_every_depth_in_an_order_of_their_own(folder: Path, tmp_path: Path) -> None:
    (folder / "notes.txt").write_text("no photograph")
    found = find_photos([folder])
    assert sorted(path.name for path in found) == sorted(f"{index}.png" for index in range(13))
    assert [path.name for path in find_photos([photo_folder(tmp_path / "b", 13)])] == [
        path.name for path in found
    ]
    learn, held = split(found)
    assert len(held) == 1
    assert not set(learn) & set(held)
    assert len(learn) + len(held) == 13


def test_filtered_pixels_are_those_of_the_whole_image(folder: Path) -> None:
    photo = load_photo(find_photos([folder])[0])
    encoder = RandomConfig(channels=3, stride=2).build()
    pixels = random_pixels(photo, 40, generator())
    features, rgb = filtered_at(encoder, photo, pixels)
    assert torch.equal(rgb, photo[pixels[:, 0], pixels[:, 1]])
    all_of_them = filtered_whole(encoder, photo).view(*photo.shape[:2], 3)
    torch.testing.assert_close(features, all_of_them[pixels[:, 0], pixels[:, 1]], rtol=1e-4, atol=1e-5)


def test_missing_folders_and_photographs_are_named(tmp_path: Path) -> None:
    for folder in (tmp_path / "absent", tmp_path):
        with pytest.raises(DataError, match=folder.name):
            find_photos([folder])
