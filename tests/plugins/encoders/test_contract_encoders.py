"""What every encoder owes: any size, no randomness, no gradient, a telling identity, batches like single images."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from network_files import vgg_file

from fprf.interfaces import Encoder
from fprf.plugins.encoders.config import (
    BundledContentConfig,
    BundledSemanticConfig,
    ConcatConfig,
    Dinov2Config,
    EncoderConfig,
    RandomConfig,
    Vgg16Config,
    Vgg19Config,
)
from fprf.testing import check_encoder

Make = Callable[[Path], EncoderConfig]
ENCODERS: dict[str, tuple[Make, int]] = {
    "random": (lambda _: RandomConfig(stride=3), 3),
    "bundled-content": (lambda _: BundledContentConfig(), 2),
    "bundled-semantic": (lambda _: BundledSemanticConfig(), 8),
    "vgg16": (lambda folder: Vgg16Config(weights=vgg_file(folder), layer="relu2_2"), 2),
    "vgg19-normalised": (lambda folder: Vgg19Config(weights=vgg_file(folder)), 2),
    "vgg19-plain": (lambda folder: Vgg19Config(weights=vgg_file(folder), normalise=False, layer="conv3_1"), 4),
    "dinov2": (lambda _: Dinov2Config(layer=3, stride=5), 5),
    "dinov2-keys": (lambda _: Dinov2Config(layer=2, features="keys", stride=20), 20),
    "concat": (lambda _: ConcatConfig(first=RandomConfig(stride=8), second=RandomConfig(stride=4, channels=3)), 4),
}


@pytest.fixture(scope="module", params=ENCODERS)
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[EncoderConfig, int]:
    make, stride = ENCODERS[request.param]
    return make(tmp_path_factory.mktemp("weights")), stride


@pytest.fixture(scope="module")
def built(made: tuple[EncoderConfig, int]) -> tuple[Encoder, int]:
    return made[0].build(), made[1]


def test_the_contract_that_strangers_sign(made: tuple[EncoderConfig, int]) -> None:
    check_encoder(made[0])


def test_a_bright_spot_answers_where_it_is(built: tuple[Encoder, int]) -> None:
    """The centre of the squared changes lies in its cell or beside it; deep networks with random weights look far around."""
    encoder, stride = built
    image = torch.full((1, 3, 12 * stride, 12 * stride), 0.5)
    spot = image.clone()
    spot[:, :, 4 * stride : 5 * stride, 7 * stride : 8 * stride] = 1
    energy = (encoder(spot) - encoder(image)).square().sum(1)[0].square()
    share = energy / energy.sum()
    cells = torch.arange(12.0)
    assert abs(float(share.sum(1) @ cells) - 4) < 1.5
    assert abs(float(share.sum(0) @ cells) - 7) < 1.5


def test_identities_differ_with_settings(tmp_path: Path) -> None:
    file, other = vgg_file(tmp_path), vgg_file(tmp_path, normalisation=False)
    one, two = RandomConfig(), RandomConfig(seed=1)
    configs = [
        one, two, ConcatConfig(),
        RandomConfig(stride=2), RandomConfig(channels=3), BundledContentConfig(), BundledSemanticConfig(),
        Vgg16Config(weights=file), Vgg19Config(weights=file), Vgg19Config(weights=file, normalise=False),
        Vgg19Config(weights=file, layer="conv2_1"), Vgg19Config(weights=other),
        Dinov2Config(layer=3), Dinov2Config(layer=2), Dinov2Config(layer=3, stride=8), Dinov2Config(layer=3, features="keys"),
        ConcatConfig(first=one, second=two), ConcatConfig(first=two, second=one),
        ConcatConfig(first=one, second=two, cells="first"), ConcatConfig(first=one, second=two, weights=(0.5,)),
        ConcatConfig(first=one, second=two, third=RandomConfig(seed=2)),
    ]  # fmt: skip
    identities = [config.build().identity for config in configs]
    assert len(set(identities)) == len(configs)
    assert identities == [config.build().identity for config in configs]
