from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file

from fprf.errors import CheckpointError
from fprf.training import tensorfiles

KINDS = (torch.float32, torch.float16, torch.bfloat16, torch.float64, torch.int64, torch.uint8, torch.bool)


def tensors() -> dict[str, torch.Tensor]:
    return {"a.weight": torch.randn(3, 4), "b": torch.arange(5), "scalar": torch.tensor(2.5)}


@given(kind=st.sampled_from(KINDS), shape=st.lists(st.integers(0, 4), max_size=3), seed=st.integers(0, 99))
def test_any_tensor_comes_back_bit_for_bit(tmp_path: Path, kind: torch.dtype, shape: list[int], seed: int) -> None:
    path, made = tmp_path / "x.safetensors", (torch.randn(shape, generator=torch.Generator().manual_seed(seed)) * 9).to(kind)
    entry = tensorfiles.save(path, {"t": made})
    found = [tensorfiles.load(path, entry)["t"]]
    tensorfiles.save(path, {"t": made}, sealed=True)
    found.append(tensorfiles.load_sealed(path)["t"])
    for each in found:
        assert each.dtype == kind and each.shape == made.shape and torch.equal(each, made)


def test_what_differs_from_its_manifest_is_refused(tmp_path: Path) -> None:
    entry = tensorfiles.save(tmp_path / "x", tensors())
    for name, manifest in (("y", entry), ("x", {"b": entry["b"]}), ("x", entry | {"new": entry["b"]})):
        with pytest.raises(CheckpointError):
            tensorfiles.load(tmp_path / name, manifest)
    entry = tensorfiles.save(tmp_path / "x", {"t": torch.tensor([1.0, float("inf")])})
    with pytest.raises(CheckpointError, match="tensor t was not finite"):
        tensorfiles.load(tmp_path / "x", entry)


@pytest.mark.parametrize("seal", ["", "3", "{", '{"a.weight": 3}', '{"a.weight": {}}', "[" * 9999, "{}", None])
def test_a_seal_of_nonsense_is_damage(tmp_path: Path, seal: str | None) -> None:
    save_file(tensors(), tmp_path / "x", {"format": "pt"} if seal is None else {"manifest": seal})
    with pytest.raises(CheckpointError, match="x: "):
        tensorfiles.load_sealed(tmp_path / "x")


@settings(max_examples=200)
@given(st.data())
def test_a_flipped_bit_of_a_sealed_file_is_found_or_harmless(tmp_path: Path, data: st.DataObject) -> None:
    torch.manual_seed(1)
    path, made = tmp_path / "x.safetensors", tensors()
    tensorfiles.save(path, made, sealed=True)
    raw = bytearray(path.read_bytes())
    at = data.draw(st.integers(0, len(raw) - 1))
    raw[at] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(raw)
    try:
        found = tensorfiles.load_sealed(path)
    except CheckpointError as error:
        assert str(path) in str(error) and "\n" not in str(error)
    else:
        assert all(torch.equal(found[name], made[name]) and found[name].dtype == made[name].dtype for name in made)
