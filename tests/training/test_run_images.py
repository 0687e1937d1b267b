"""A run goes on with the images that it was begun with."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from tiny_world import World

from fprf.cli.train import train_scene
from fprf.datamanagers.parsers.config import parse_scene
from fprf.errors import CheckpointError, DataError, UsageError
from fprf.training import checkpoint
from fprf.training.run import CHANGED_IMAGES, IMAGES, check_images, image_hashes, save_image_hashes


@pytest.fixture
def town(world: World, tmp_path: Path) -> Path:
    shutil.copytree(world.town, tmp_path / "town")
    return tmp_path / "town"


def test_every_image_has_a_hash_of_its_bytes_and_of_nothing_else(world: World, town: Path) -> None:
    scene = parse_scene(town, 1, None)
    found = image_hashes(scene)
    assert len(found) == len(scene.paths) == len(set(found.values())) and all(len(mark) == 64 for mark in found.values())
    assert found == image_hashes(parse_scene(world.town, 1, None)), "wherever it lies"
    scene.paths[3].touch()
    assert found == image_hashes(scene)
    raw = bytearray(scene.paths[3].read_bytes())
    raw[-1] ^= 1
    scene.paths[3].write_bytes(raw)
    assert [name for name, mark in image_hashes(scene).items() if found[name] != mark] == [scene.paths[3].stem]
    scene.paths[3].unlink()
    with pytest.raises(DataError, match="cannot be read"):
        image_hashes(scene)


def test_what_differs_is_named(town: Path, tmp_path: Path) -> None:
    scene = parse_scene(town, 1, None)
    found = image_hashes(scene)
    check_images(tmp_path, scene, found)  # nothing was kept
    save_image_hashes(tmp_path, found)
    check_images(tmp_path, scene, dict(reversed(found.items())))
    first, second = list(found)[:2]
    with pytest.raises(UsageError, match=rf"{first}.png is another; put them back.*{CHANGED_IMAGES}") as told:
        check_images(tmp_path, scene, found | {first: "0" * 64})
    assert "\n" not in str(told.value)
    save_image_hashes(tmp_path, {name: mark for name, mark in found.items() if name != first} | {"old": "0" * 64})
    with pytest.raises(UsageError, match=rf"{second}.png is another, .*{first}.png is new, old is gone; put"):
        check_images(tmp_path, scene, found | {second: "0" * 64})
    with pytest.raises(UsageError, match="and 8 more; put them back"):
        check_images(tmp_path, scene, dict.fromkeys(found, "0" * 64))


@pytest.mark.parametrize("text", ["", "[]", '{"images": 3}', '{"images": null}', "{" * 5000, "\xff"])
def test_a_list_that_cannot_be_read_says_so(town: Path, tmp_path: Path, text: str) -> None:
    (tmp_path / IMAGES).write_text(text, encoding="latin-1")
    scene = parse_scene(town, 1, None)
    with pytest.raises(CheckpointError, match=f"{IMAGES}: cannot be read.*remove it"):
        check_images(tmp_path, scene, image_hashes(scene))


def test_training_goes_on_with_the_same_images_and_with_others_when_asked(world: World, town: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(world.run, run)
    config = replace(world.config, data=town, output=run, steps=16)
    image = sorted((town / "images").iterdir())[3]
    image.write_bytes(sorted((town / "images").iterdir())[4].read_bytes())
    before = json.loads((run / IMAGES).read_text())
    with pytest.raises(UsageError, match=f"{image.name} is another"):
        train_scene(config, "fprf-lite", quiet=True)
    assert json.loads((run / IMAGES).read_text()) == before and checkpoint.steps(run / "checkpoints")[-1] == 15
    train_scene(config, "fprf-lite", quiet=True, others=True)
    after = json.loads((run / IMAGES).read_text())
    assert [name for name in before["images"] if before["images"][name] != after["images"][name]] == [image.stem]
    assert checkpoint.steps(run / "checkpoints")[-1] == 16
    train_scene(replace(config, steps=17), "fprf-lite", quiet=True)
    assert checkpoint.steps(run / "checkpoints")[-1] == 17
