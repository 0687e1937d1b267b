"""What every encoder owes: any size, no randomness, no gradient, a telling identity, batches like single images."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from vgg_files import vgg_file

from fprf.interfaces import Encoder
from fprf.plugins.encoders.config import BundledContentConfig, BundledSemanticConfig, RandomConfig, Vgg19Config

Build = Callable[[Path], Encoder]
ENCODERS: dict[str, tuple[Build, int]] = {
    "random": (lambda _: RandomConfig(stride=3).build(), 3),
    "bundled-content": (lambda _: BundledContentConfig().build(), 2),
    "bundled-semantic": (lambda _: BundledSemanticConfig().build(), 8),
    "vgg19-normalised": (lambda folder: Vgg19Config(weights=vgg_file(folder)).build(), 2),
    "vgg19-plain": (lambda folder: Vgg19Config(weights=vgg_file(folder), normalise=False, layer="conv3_1").build(), 4),
}


@pytest.fixture(scope="module", params=ENCODERS)
def built(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Encoder, int]:
    build, stride = ENCODERS[request.param]
    return build(tmp_path_factory.mktemp("weights")), stride


@settings(max_examples=12, deadline=None)
@given(height=st.integers(1, 45), width=st.integers(1, 45))
def test_any_size(built: tuple[Encoder, int], height: int, width: int) -> None:
    encoder, stride = built
    features = encoder(torch.rand(1, 3, height, width, generator=torch.Generator().manual_seed(0)))
    assert features.shape[:2] == (1, encoder.channels)
    for cells, pixels in zip(features.shape[2:], (height, width), strict=True):
        assert cells in {max(1, round(pixels / stride)), -(-pixels // stride)}
    assert torch.isfinite(features).all()
    assert features.dtype == torch.float32


def test_a_batch_is_its_images(built: tuple[Encoder, int]) -> None:
    images = torch.rand(3, 3, 33, 50)
    together = built[0](images)
    alone = torch.cat([built[0](image[None]) for image in images])
    torch.testing.assert_close(together, alone, rtol=1e-4, atol=1e-4)


def test_deterministic_and_frozen(built: tuple[Encoder, int]) -> None:
    encoder, _ = built
    image = torch.rand(1, 3, 24, 40, requires_grad=True)
    features = encoder(image)
    assert not features.requires_grad
    assert torch.equal(features, encoder(image))
    assert not any(parameter.requires_grad for parameter in encoder.parameters())
    assert not encoder.training


def test_the_image_is_not_changed(built: tuple[Encoder, int]) -> None:
    image = torch.rand(1, 3, 16, 16)
    before = image.clone()
    built[0](image)
    assert torch.equal(image, before)


def test_mirrored_images_have_mirrored_cells_in_the_right_place(built: tuple[Encoder, int]) -> None:
    """A bright spot answers in the cell that covers it."""
    encoder, stride = built
    side = 8 * stride
    image = torch.full((1, 3, side, side), 0.5)
    spot = image.clone()
    spot[:, :, 2 * stride : 3 * stride, 5 * stride : 6 * stride] = 1
    change = (encoder(spot) - encoder(image)).square().sum(1)[0]
    centred = change - change.mean()  # a network may also look at the whole image
    row, column = divmod(int(centred.argmax()), change.shape[1])
    assert abs(row - 2) <= 1
    assert abs(column - 5) <= 1


def test_identities_differ_with_settings(tmp_path: Path) -> None:
    file, other = vgg_file(tmp_path), vgg_file(tmp_path, normalisation=False)
    configs = [
        RandomConfig(),
        RandomConfig(seed=1),
        RandomConfig(stride=2),
        RandomConfig(channels=3),
        BundledContentConfig(),
        BundledSemanticConfig(),
        Vgg19Config(weights=file),
        Vgg19Config(weights=file, normalise=False),
        Vgg19Config(weights=file, layer="conv2_1"),
        Vgg19Config(weights=other),
    ]
    identities = [config.build().identity for config in configs]
    assert len(set(identities)) == len(configs)
    assert identities == [config.build().identity for config in configs]


def test_an_identity_names_no_folder(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    one, two = (Vgg19Config(weights=vgg_file(tmp_path / name)).build().identity for name in "ab")
    assert one == two
    assert str(tmp_path) not in one
