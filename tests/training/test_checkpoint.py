import shutil
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tiny_world import World

from fprf.errors import CheckpointError
from fprf.training import checkpoint
from fprf.training.model import Model, build_model


def fresh(world: World) -> tuple[Model, torch.optim.Optimizer]:
    """A model after one step of Adam on made-up gradients."""
    model = build_model(world.config, world.prepared.facts)
    optimizer = torch.optim.Adam(model.learned(), lr=1e-3, fused=True)
    for parameter in model.learned():
        parameter.grad = torch.randn_like(parameter)
    optimizer.step()
    return model, optimizer


@pytest.fixture
def root(world: World, tmp_path: Path) -> Path:
    """Checkpoints of steps 5 and 9."""
    model, optimizer = fresh(world)
    for step in (5, 9):
        checkpoint.save(tmp_path / "c", model, optimizer, step=step, seconds=step / 2)
    return tmp_path / "c"


def test_everything_comes_back(world: World, tmp_path: Path) -> None:
    model, optimizer = fresh(world)
    folder = checkpoint.save(tmp_path, model, optimizer, step=3, seconds=1.5)
    assert sorted(p.name for p in folder.iterdir()) == ["manifest.json", "model.safetensors", "optimizer.safetensors"]
    saved, damaged = checkpoint.load_latest(tmp_path)
    assert saved is not None and not damaged and (saved.step, saved.seconds) == (3, 1.5)
    other = build_model(world.config, world.prepared.facts)
    again = torch.optim.Adam(other.learned(), lr=1e-3, fused=True)
    checkpoint.restore(saved, other, again)
    for (name, a), b in zip(model.state_dict().items(), other.state_dict().values(), strict=True):
        assert torch.equal(a, b), name
    for index, moments in optimizer.state_dict()["state"].items():
        for key, value in moments.items():
            assert torch.equal(value, again.state_dict()["state"][index][key]), (index, key)


def test_a_past_that_was_gone_back_from_is_dropped(world: World, root: Path) -> None:
    """Else a damaged newest one would keep its place, and only one intact would be left."""
    model, optimizer = fresh(world)
    checkpoint.save(root, model, optimizer, step=7, seconds=0.0)
    assert checkpoint.steps(root) == [5, 7]


def test_tidying_removes_what_was_cut_short_and_nothing_else(root: Path) -> None:
    whole = {p: p.read_bytes() for p in root.rglob("*") if p.is_file()}
    cut = root / "step-0000020"
    shutil.copytree(root / "step-0000009", cut)
    (cut / "manifest.json").unlink()
    for name in (".model.0123abcd.safetensors", ".tmpAb12Cd"):
        (root / "step-0000009" / name).write_bytes(b"cut")
    mine = root / "step-by-step" / "notes.txt"
    mine.parent.mkdir()
    mine.write_text("mine")
    checkpoint.tidy(root)
    assert {p: p.read_bytes() for p in root.rglob("*") if p.is_file()} == whole | {mine: b"mine"} and not cut.exists()
    checkpoint.tidy(root / "absent")


def test_what_was_cut_short_does_not_count(root: Path) -> None:
    """A kill between the tensors and the manifest leaves files without one."""
    cut = root / "step-0000020"
    shutil.copytree(root / "step-0000009", cut)
    (cut / "manifest.json").unlink()
    (root / "step-soon").mkdir()
    (root / "step-soon" / "manifest.json").write_text("{}")
    saved, damaged = checkpoint.load_latest(root)
    assert saved is not None and saved.step == 9 and not damaged
    assert checkpoint.steps(root) == [5, 9]


@pytest.mark.parametrize("name", ["model.safetensors", "optimizer.safetensors", "manifest.json"])
@pytest.mark.parametrize("harm", ["cut", "empty", "gone", "flip"])
def test_a_damaged_one_is_named_and_the_one_before_serves(root: Path, name: str, harm: str) -> None:
    path = root / "step-0000009" / name
    raw = bytearray(path.read_bytes())
    if harm == "gone":
        if name == "manifest.json":
            pytest.skip("then it does not count")
        path.unlink()
    else:
        raw[-40] ^= 1
        path.write_bytes({"cut": raw[: len(raw) // 2], "empty": b"", "flip": raw}[harm])
    saved, damaged = checkpoint.load_latest(root)
    assert saved is not None and saved.step == 5
    assert len(damaged) == 1 and "step-0000009" in damaged[0]


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_no_harm_to_a_manifest_is_more_than_damage(root: Path, data: st.DataObject) -> None:
    path = root / "step-0000009" / "manifest.json"
    whole = path.read_bytes()
    raw = bytearray(whole)
    at = data.draw(st.integers(0, len(raw) - 1))
    raw[at] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(raw)
    saved, damaged = checkpoint.load_latest(root)
    path.write_bytes(whole)
    assert saved is not None and saved.step == (5 if damaged else 9)
    assert damaged or saved.seconds == 4.5


def test_parameters_that_are_not_finite_are_not_resumed_from(world: World, root: Path) -> None:
    model, optimizer = fresh(world)
    with torch.no_grad():
        model.learned()[0].view(-1)[0] = float("nan")
    checkpoint.save(root, model, optimizer, step=12, seconds=0.0)
    saved, damaged = checkpoint.load_latest(root)
    assert saved is not None and saved.step == 9 and "was not finite when saved" in damaged[0]


def test_a_checkpoint_of_another_config_is_refused(world: World, root: Path) -> None:
    saved, _ = checkpoint.load_latest(root)
    assert saved is not None
    model, _ = fresh(world)
    name = next(iter(saved.model))
    for tensors in (
        {k: v for k, v in saved.model.items() if k != name},
        saved.model | {name: torch.zeros(3)},
        saved.model | {"extra": torch.zeros(3)},
    ):
        with pytest.raises(CheckpointError, match="does not fit the config; it was changed since"):
            checkpoint.restore(saved._replace(model=tensors), model, None)
