"""Checkpoints and their tensor files: everything comes back, and what was cut short or damaged does not
count.
"""

import errno
import os
import shutil
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file
from tiny_world import World, after_one_step, save_checkpoint

from fprf.errors import CheckpointError
from fprf.io import tensorfiles
from fprf.training import checkpoint
from fprf.training.model import build_model


@pytest.fixture
def root(world: World, tmp_path: Path) -> Path:
    """Checkpoints of steps 5 and 9."""
    model, optimizer = after_one_step(world)
    for step in (5, 9):
        save_checkpoint(tmp_path / "c", model, optimizer, step=step, seconds=step / 2)
    return tmp_path / "c"


def test_everything_comes_back(world: World, tmp_path: Path) -> None:
    model, optimizer = after_one_step(world)
    assert checkpoint.load_latest(tmp_path) == (None, []) and not checkpoint.digest(tmp_path)
    save_checkpoint(tmp_path, model, optimizer, step=3, seconds=1.5)
    saved, damaged = checkpoint.load_latest(tmp_path)
    assert saved is not None and not damaged
    assert (saved.step, saved.seconds) == (3, 1.5) and checkpoint.digest(tmp_path)
    other = build_model(world.config, world.prepared.facts)
    again = torch.optim.Adam(other.learned(), lr=1e-3, fused=True)
    checkpoint.restore(saved.state, other, again)
    torch.testing.assert_close(other.state_dict(), model.state_dict(), atol=0, rtol=0)
    torch.testing.assert_close(again.state_dict(), optimizer.state_dict(), atol=0, rtol=0)


def test_a_past_that_was_gone_back_from_is_dropped(world: World, root: Path) -> None:
    """Else a damaged newest one would keep its place, and only one intact would be left."""
    model, optimizer = after_one_step(world)
    save_checkpoint(root, model, optimizer, step=7, seconds=0.0)
    assert checkpoint.steps(root) == [5, 7]


def test_an_old_checkpoint_that_cannot_be_removed_ends_nothing(
    world: World, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(os, "rmdir", Mock(side_effect=OSError(errno.ENOTEMPTY, "a file in it is open")))
        save_checkpoint(root, *after_one_step(world), step=11, seconds=0.0)
    assert checkpoint.steps(root) == [9, 11] and (root / "step-0000005").exists()
    checkpoint.tidy(root)
    assert not (root / "step-0000005").exists()


def test_what_was_cut_short_does_not_count_and_tidying_removes_nothing_else(root: Path) -> None:
    """A kill between the tensors and the manifest leaves files without one."""
    whole = {p: p.read_bytes() for p in root.rglob("*") if p.is_file()}
    cut = root / "step-0000020"
    mine = root / "step-by-step" / "manifest.json"
    shutil.copytree(root / "step-0000009", cut)
    (cut / "manifest.json").unlink()
    for name in (".model.0123abcd.safetensors", ".tmpAb12Cd"):
        (root / "step-0000009" / name).write_bytes(b"cut")
    mine.parent.mkdir()
    mine.write_text("mine")
    saved, damaged = checkpoint.load_latest(root)
    assert saved is not None and saved.step == 9 and not damaged
    assert checkpoint.steps(root) == [5, 9]
    checkpoint.tidy(root)
    assert {p: p.read_bytes() for p in root.rglob("*") if p.is_file()} == whole | {
        mine: b"mine"
    } and not cut.exists()
    checkpoint.tidy(root / "absent")


def test_a_checkpoint_of_another_config_is_refused(world: World, root: Path) -> None:
    saved, _ = checkpoint.load_latest(root)
    assert saved is not None
    model, _ = after_one_step(world)
    name, *others = saved.model
    for tensors in (
        {other: saved.model[other] for other in others},
        saved.model | {name: torch.zeros(3)},
        saved.model | {"extra": torch.zeros(3)},
    ):
        with pytest.raises(CheckpointError):
            checkpoint.restore(saved._replace(model=tensors).state, model, None)


KINDS = (torch.float32, torch.float16, torch.bfloat16, torch.float64, torch.int64, torch.uint8, torch.bool)


def tensors() -> dict[str, torch.Tensor]:
    return {"a.weight": torch.randn(3, 4), "b": torch.arange(5), "scalar": torch.tensor(2.5)}


@given(kind=st.sampled_from(KINDS), shape=st.lists(st.integers(0, 4), max_size=3), seed=st.integers(0, 99))
def test_any_tensor_comes_back_bit_for_bit(
    tmp_path: Path, kind: torch.dtype, shape: list[int], seed: int
) -> None:
    path = tmp_path / "x.safetensors"
    made = (torch.randn(shape, generator=torch.Generator().manual_seed(seed)) * 9).to(kind)
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


@pytest.mark.parametrize(
    "seal", ["", "3", "{", '{"a.weight": 3}', '{"a.weight": {}}', "[" * 9999, "{}", None]
)
def test_a_seal_of_nonsense_is_damage(tmp_path: Path, seal: str | None) -> None:
    save_file(tensors(), tmp_path / "x", {"format": "pt"} if seal is None else {"manifest": seal})
    with pytest.raises(CheckpointError, match="x: "):
        tensorfiles.load_sealed(tmp_path / "x")


@settings(max_examples=200)
@given(st.data())
def test_a_flipped_bit_of_a_sealed_file_is_found_or_harmless(tmp_path: Path, data: st.DataObject) -> None:
    torch.manual_seed(1)
    path = tmp_path / "x.safetensors"
    made = tensors()
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
        assert all(
            torch.equal(found[name], made[name]) and found[name].dtype == made[name].dtype for name in made
        )
