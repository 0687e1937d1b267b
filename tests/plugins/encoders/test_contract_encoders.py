"""What every encoder owes; those that ship, and encoders side by side."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from network_files import vgg_file
from torch import Tensor

from fprf.errors import WeightsError
from fprf.plugins.decoders.decoders import FOLDER as DECODERS
from fprf.plugins.encoders.bundled import CONTENT_KIND, FOLDER, SEMANTIC_KIND
from fprf.plugins.encoders.composed import UNITS, ConcatEncoder, unit_of
from fprf.plugins.encoders.config import (
    SEMANTICS,
    BundledContentConfig,
    BundledSemanticConfig,
    ConcatConfig,
    Dinov2Config,
    EncoderConfig,
    RandomConfig,
    Vgg19Config,
)
from fprf.plugins.encoders.dinov2 import WEIGHTS as DINOV2
from fprf.plugins.encoders.frozen import street
from fprf.plugins.weights import read_weights, write_weights
from fprf.testing import check_encoder

Make = Callable[[Path], EncoderConfig]
ENCODERS: dict[str, Make] = {
    "random": lambda _: RandomConfig(stride=3),
    "bundled-content": lambda _: BundledContentConfig(),
    "bundled-semantic": lambda _: BundledSemanticConfig(),
    "vgg19-normalised": lambda folder: Vgg19Config(weights=vgg_file(folder)),
    "vgg19-plain": lambda folder: Vgg19Config(weights=vgg_file(folder), normalise=False, layer="conv3_1"),
    "dinov2": lambda _: Dinov2Config(layer=3, stride=5),
    "dinov2-keys": lambda _: Dinov2Config(layer=2, features="keys", stride=20),
    "concat": lambda _: ConcatConfig(first=RandomConfig(stride=8), second=RandomConfig(stride=4, channels=3)),
}


@pytest.mark.parametrize("name", ENCODERS)
def test_the_contract_that_strangers_sign(name: str, tmp_path: Path) -> None:
    check_encoder(ENCODERS[name](tmp_path))


def test_identities_differ_with_settings(tmp_path: Path) -> None:
    file = vgg_file(tmp_path)
    other = vgg_file(tmp_path, normalisation=False)
    one = RandomConfig()
    two = RandomConfig(seed=1)
    configs = [
        one, two, ConcatConfig(),
        RandomConfig(stride=2), RandomConfig(channels=3), BundledContentConfig(), BundledSemanticConfig(),
        Vgg19Config(weights=file), Vgg19Config(weights=file, normalise=False),
        Vgg19Config(weights=file, layer="conv2_1"), Vgg19Config(weights=other),
        Dinov2Config(layer=3), Dinov2Config(layer=2), Dinov2Config(layer=3, stride=8), Dinov2Config(layer=3, features="keys"),
        ConcatConfig(first=one, second=two), ConcatConfig(first=two, second=one),
        ConcatConfig(first=one, second=two, cells="first"), ConcatConfig(first=one, second=two, weights=(0.5,)),
        ConcatConfig(first=one, second=two, third=RandomConfig(seed=2)),
    ]  # fmt: skip
    identities = [config.build().identity for config in configs]
    assert len(set(identities)) == len(configs)
    assert identities == [config.build().identity for config in configs]


def test_everything_that_ships_stays_small_and_says_what_it_is() -> None:
    files = [*FOLDER.glob("*.safetensors"), *DECODERS.glob("*.safetensors")]
    assert len(files) >= 4
    assert sum(file.stat().st_size for file in files if file != DINOV2) < 3e6
    assert DINOV2.stat().st_size < 21e6
    for file in files:
        metadata = read_weights(file)[1]
        if file == DINOV2:
            assert "Apache-2.0" in metadata["licence"] and "Meta AI" in metadata["licence"]
            continue
        if file.stem == "vgg19-relu2_1" and file.parent == FOLDER:
            assert "CC BY 4.0" in metadata["licence"] and "Simonyan" in metadata["licence"]
            continue
        assert metadata["made_by"].startswith("fprf pretrain ")
        assert "Apache-2.0" in metadata["licence"]


@pytest.mark.parametrize(
    ("config", "kind"), [(BundledContentConfig, CONTENT_KIND), (BundledSemanticConfig, SEMANTIC_KIND)]
)
def test_other_files_are_refused_with_the_command_that_makes_the_right_one(
    config: type[BundledContentConfig], kind: str, tmp_path: Path
) -> None:
    write_weights(
        tmp_path / "other.safetensors", {"project.weight": torch.zeros(3, 3, 1, 1)}, {"kind": "mlp-decoder"}
    )
    with pytest.raises(WeightsError, match=f"'mlp-decoder'.*tools.distil {kind.removeprefix('bundled-')}"):
        config(weights=tmp_path / "other.safetensors").build()
    write_weights(tmp_path / "shape.safetensors", {"project.weight": torch.zeros(3, 3, 1, 1)}, {"kind": kind})
    for name in ("shape", "absent"):
        with pytest.raises(WeightsError, match=name):
            config(weights=tmp_path / f"{name}.safetensors").build()


def length(features: Tensor) -> Tensor:
    """Root mean square length about the mean."""
    return (features - features.mean((0, 2, 3), keepdim=True)).square().sum(1).mean().sqrt()


@settings(max_examples=10, deadline=None)
@given(st.floats(0.05, 20), st.floats(0.05, 20), st.integers(1, 40), st.integers(1, 40))
def test_each_part_has_the_length_of_its_weight(first: float, second: float, few: int, many: int) -> None:
    parts = (RandomConfig(channels=few, stride=8), RandomConfig(channels=many, seed=1))
    encoder = ConcatConfig(first=parts[0], second=parts[1], weights=(first, second)).build()
    assert encoder.channels == few + many
    found = encoder(street())
    # The unit is kept to three digits, and the coarser part loses a little where it is interpolated.
    torch.testing.assert_close(length(found[:, few:]), torch.tensor(second), rtol=6e-3, atol=0)
    assert 0.6 * first < float(length(found[:, :few])) <= first * 1.01


def test_parts_are_their_encoders_to_a_factor() -> None:
    image = torch.rand(2, 3, 40, 56)
    parts = [RandomConfig(stride=8).build(), RandomConfig(stride=4, seed=1).build()]
    found = ConcatEncoder(parts, (3.0, 0.5), (2.0, 4.0))(image)
    coarse = F.interpolate(parts[0](image), (10, 14), mode="bilinear") * 1.5
    torch.testing.assert_close(found, torch.cat([coarse, parts[1](image) * 0.125], dim=1))


def test_finer_parts_are_averaged_over_the_cells_of_the_first() -> None:
    image = torch.rand(2, 3, 48, 64)
    coarse = RandomConfig(stride=8).build()
    fine = RandomConfig(stride=4, seed=1).build()
    found = ConcatEncoder([coarse, fine], (3.0, 0.5), (2.0, 4.0), cells="first")(image)
    torch.testing.assert_close(
        found, torch.cat([coarse(image) * 1.5, F.avg_pool2d(fine(image), 2) * 0.125], dim=1)
    )
    turned = ConcatEncoder([fine, coarse], (1.0, 1.0), (1.0, 1.0), cells="first")(image)
    torch.testing.assert_close(turned[:, 16:], F.interpolate(coarse(image), (12, 16), mode="bilinear"))


def test_known_units_are_those_measured() -> None:
    parts = [part.build() for part in (SEMANTICS.first, SEMANTICS.second)]
    assert [UNITS[part.identity] for part in parts] == [
        pytest.approx(unit_of(part, street()), rel=0.01) for part in parts
    ]
    assert len(UNITS) == len(parts)


def test_cut_out_pictures_are_seen_on_white_and_black() -> None:
    image = torch.rand(2, 3, 16, 24)
    opacity = torch.rand(2, 16, 24)
    encoder = RandomConfig(stride=4).build()
    drawn = image * opacity[:, None]
    on_white = drawn + 1 - opacity[:, None]
    torch.testing.assert_close(encoder.cutout(drawn, opacity), (encoder(on_white) + encoder(drawn)) / 2)


def test_each_part_cuts_out_as_it_can() -> None:
    image = torch.rand(1, 3, 70, 98)
    opacity = torch.zeros(1, 70, 98)
    opacity[:, 20:50, 30:60] = 1
    parts = [Dinov2Config(layer=1, stride=14).build(), RandomConfig(stride=7).build()]
    found = ConcatEncoder(parts, (3.0, 0.5), (2.0, 4.0), cells="first").cutout(image * opacity, opacity)
    tokens, random = (part.cutout(image * opacity, opacity) for part in parts)
    torch.testing.assert_close(found, torch.cat([tokens * 1.5, F.avg_pool2d(random, 2) * 0.125], dim=1))
