import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_world import World

from fprf.errors import CheckpointError
from fprf.training.run import Run, view_names


@pytest.fixture
def run(world: World, tmp_path: Path) -> Run:
    """A copy without checkpoints, to be spoilt."""
    shutil.copytree(world.run, tmp_path / "run", ignore=shutil.ignore_patterns("checkpoints"))
    return Run(tmp_path / "run")


def test_no_file_names_the_place_that_it_lies_in(world: World) -> None:
    for name in ("config.json", "scene.json", "events.jsonl"):
        assert str(world.run) not in (world.run / name).read_text()


def test_scene_json_gives_the_scene_back(world: World) -> None:
    known, scene = Run(world.run).load_known(), world.prepared.scene
    for name in ("pose", "focal", "centre", "size", "distortion", "lens"):
        there, here = getattr(known.cameras, name), getattr(scene.cameras, name)
        assert there.dtype == here.dtype and torch.equal(there, here), name
    assert known.names == tuple(p.stem for p in scene.paths)
    assert known.facts == Run(world.run).saved_facts() == world.prepared.facts
    assert Run(world.folder / "none").saved_facts() is None
    assert (known.split("train"), known.split("test")) == (tuple(scene.train.tolist()), tuple(scene.test.tolist()))
    assert known.split("all") == tuple(range(10))
    assert sorted(known.train + known.test) == list(range(10))


def test_the_config_comes_back_without_its_folder(world: World) -> None:
    config, method = Run(world.run).load_config()
    assert method == "fprf-lite" and config.output is None
    assert config == type(config)(**{**vars(world.config), "output": None})


def test_a_folder_that_is_no_run_says_so(tmp_path: Path) -> None:
    assert not Run(tmp_path).exists
    with pytest.raises(CheckpointError, match=r"no config\.json here, so it is no run folder"):
        Run(tmp_path).load_config()


def _without(key: str) -> Any:
    return lambda d: {k: v for k, v in d.items() if k != key}


@pytest.mark.parametrize(
    "change",
    [
        *(_without(key) for key in ("format", "name", "data", "names", "cameras", "train", "test", "facts")),
        lambda d: d | {"format": 99},
        lambda d: d | {"facts": 3},
        lambda d: d | {"facts": d["facts"] | {"space": "box"}},
        lambda d: d | {"facts": d["facts"] | {"more": 1}},
        lambda d: d | {"facts": _without("channels")(d["facts"])},
        lambda d: d | {"cameras": d["cameras"] | {"pose": [[1.0], [1.0, 2.0]]}},
        lambda d: d | {"cameras": d["cameras"] | {"size": [[10**30, 1]]}},
        lambda d: d | {"cameras": []},
        lambda d: [d],
        lambda d: None,
    ],
)
def test_a_spoilt_scene_json_is_named(run: Run, change: Any) -> None:
    path = run.root / "scene.json"
    path.write_text(json.dumps(change(json.loads(path.read_text()))))
    with pytest.raises(CheckpointError, match=r"scene\.json: "):
        run.load_known()


@pytest.mark.parametrize("text", ["", "{", '{"format": 1', "\udcff"])
def test_a_cut_scene_json_is_named(run: Run, text: str) -> None:
    (run.root / "scene.json").write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(CheckpointError, match=r"scene\.json: cannot be read"):
        run.load_known()


def test_tensors_that_are_absent_or_cut(run: Run) -> None:
    path = run.root / "style.safetensors"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(CheckpointError, match=r"style\.safetensors: cannot be read"):
        run.load_tensors("style")
    path.unlink()
    with pytest.raises(CheckpointError, match=r"not written yet; finish training with `fprf train"):
        run.load_tensors("style")


def test_events_are_strict_json_lines(world: World, run: Run) -> None:
    run.log({"step": 1})
    lines = (run.root / "events.jsonl").read_text().splitlines()
    assert json.loads(lines[-1]) == {"step": 1}
    trained = [event for line in lines if "psnr" in (event := json.loads(line))][-1]
    keys = {"step", "seconds", "psnr", "rays_per_second", "kept", "skipped_steps", "losses"}
    assert trained.keys() == keys and trained["step"] == 15 and trained["skipped_steps"] == 0
    with pytest.raises(ValueError, match="Out of range float"):
        run.log({"loss": float("nan")})


def test_an_event_after_a_torn_line_has_a_line_of_its_own(tmp_path: Path) -> None:
    run = Run(tmp_path)
    run.log({"step": 1})
    with (tmp_path / "events.jsonl").open("a") as file:
        file.write('{"step": 2, "los')
    run.log({"step": 3})
    run.log({"step": 4})
    lines = (tmp_path / "events.jsonl").read_text().splitlines()
    assert [json.loads(lines[i])["step"] for i in (0, 2, 3)] == [1, 3, 4] and len(lines) == 4


@given(st.lists(st.lists(st.sampled_from(["a", "b", "ab"]), min_size=1, max_size=3), min_size=1, max_size=6))
def test_names_are_never_alike(paths: list[list[str]]) -> None:
    names = view_names([Path("/scene", *parts).with_suffix(".png") for parts in paths])
    assert len(set(names)) == len(paths) and not any("/" in name for name in names)
