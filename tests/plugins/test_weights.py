"""Weights files: what goes in comes out, whole or not at all."""

from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.errors import WeightsError
from fprf.plugins.encoders.config import Vgg19Config
from fprf.plugins.weights import read_weights, tensors_hash, write_weights


@settings(max_examples=15, deadline=None)
@given(shape=st.lists(st.integers(1, 4), max_size=3), half=st.booleans(), seed=st.integers(0, 9))
def test_round_trip(
    tmp_path_factory: pytest.TempPathFactory, shape: list[int], half: bool, seed: int
) -> None:
    path = tmp_path_factory.mktemp("w") / "deep/er.safetensors"
    value = torch.randn(shape, generator=torch.Generator().manual_seed(seed))
    value = value.half() if half else value
    write_weights(path, {"a": value, "n": torch.tensor([3])}, {"kind": "x"})
    tensors, metadata = read_weights(path)
    assert metadata == {"kind": "x"}
    assert tensors["a"].dtype == torch.float32
    assert torch.equal(tensors["a"], value.float())
    assert tensors["n"].dtype == torch.int64
    assert [file.name for file in path.parent.iterdir()] == ["er.safetensors"]


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 99))
def test_the_hash_sees_names_shapes_and_values_alone(seed: int) -> None:
    value = torch.randn(2, 3, generator=torch.Generator().manual_seed(seed))
    base = tensors_hash({"a": value, "b": value})
    assert len(base) == 12
    assert base == tensors_hash({"b": value.clone(), "a": value.double()})
    others = [{"a": value, "c": value}, {"a": value.view(3, 2), "b": value}, {"a": value, "b": value + 1e-6}]
    assert base not in [tensors_hash(other) for other in others]


def test_missing_weights_name_file_folder_and_flag(home: Path) -> None:
    with pytest.raises(WeightsError) as raised:
        Vgg19Config(layer="relu3_1").build()
    for part in ("vgg19-dcbb9e9d.pth", str(home / ".cache/fprf/weights"), ".encoder.weights FILE"):
        assert part in str(raised.value)
    assert "\n" not in str(raised.value)
    assert not list(home.rglob("*.p*th*")), "nothing is left of a download that failed"


@pytest.mark.parametrize("folder", [".cache/fprf/weights", ".cache/torch/hub/checkpoints"])
def test_both_caches_are_searched_and_the_hash_in_a_name_is_a_promise(folder: str, home: Path) -> None:
    cache = home / folder
    cache.mkdir(parents=True)
    torch.save({"features.0.weight": torch.zeros(2)}, cache / "vgg19-dcbb9e9d.pth")
    with pytest.raises(WeightsError, match=f"{folder}.*promises dcbb9e9d; delete it and fetch https"):
        Vgg19Config(layer="relu3_1").build()
