import json
import shutil
from dataclasses import replace
from pathlib import Path
from queue import Queue

import cv2
import numpy as np
import pytest
from shelves import cards_of
from tiny_world import World

from fprf.cli import main as cli
from fprf.errors import ConfigError, UsageError
from fprf.io.images import Picture
from fprf.viewer.cameras import stage_of
from fprf.viewer.film import FilmPlan, Key, frames_of_film, lay_film, new_folder, path_of, taken
from fprf.viewer.looks import Look, ordered
from fprf.viewer.restyler import Studio


def plan_of(studio: Studio, looks: list[Look], seconds: float = 0.1, fps: float = 30.0) -> FilmPlan:
    stage, cameras = stage_of(studio.trained.known.cameras), studio.trained.known.cameras
    keys = tuple(Key(stage.eye(cameras, view), look) for view, look in enumerate(looks))
    return FilmPlan(keys, seconds, fps, (32, 24))


def test_the_film_is_what_fprf_render_makes_of_its_folder(world: World, tmp_path: Path) -> None:
    shutil.copytree(world.run, tmp_path / "run")
    studio = Studio(world.load())
    a, b = cards_of(studio, world)
    one = ordered(Look(mix=((a, 1.0),), clusters=3), 0, "keep")
    between = Look(mix=((b, 1.0),), clusters=3, towards=Look(mix=((a, 1.0),), clusters=3), at=0.5)
    plan = plan_of(studio, [Look(), one, between])
    folder = new_folder(tmp_path / "run")
    lay_film(folder, stage_of(studio.trained.known.cameras), plan, studio.trained.known.facts.semantic_encoder)
    out: Queue[Picture | None] = Queue()
    told: list[tuple[int, int]] = []
    for _ in frames_of_film(folder, studio.trained, out, lambda done, total: told.append((done, total))):
        pass
    frames = list(taken(out))
    assert len(frames) == 7 and told == [(i + 1, 7) for i in range(7)]
    args = ["render", str(tmp_path / "run"), "--path", str(folder / "path.json"), "--keyframes", str(folder / "keys.json")]
    assert cli.main([*args, "--output", str(tmp_path / "frames")]) == 0
    pictures = [cv2.imread(str(p))[..., ::-1] for p in sorted((tmp_path / "frames").glob("*.png"))]
    assert len(pictures) == 7
    for mine, its in zip(frames, pictures, strict=True):
        assert np.array_equal(mine, its)
    assert not np.array_equal(frames[0], frames[3])


def test_files_name_no_path_of_this_machine(world: World, tmp_path: Path) -> None:
    studio = Studio(world.load())
    a, _ = cards_of(studio, world)
    lay_film(tmp_path, stage_of(studio.trained.known.cameras), plan_of(studio, [Look(mix=((a, 1.0),))] * 2), "")
    keys = json.loads((tmp_path / "keys.json").read_text())
    assert keys["keyframes"] == [{"frame": 0, "style": "style-1/style.json"}, {"frame": 3, "style": "style-1/style.json"}]
    style = json.loads((tmp_path / "style-1" / "style.json").read_text())
    assert style["style"]["references"] == ["1-dusk.png"] and (tmp_path / "style-1" / "1-dusk.png").is_file()


def test_a_fade_to_the_scene_as_it_is_is_written_as_less_strength(world: World, tmp_path: Path) -> None:
    studio = Studio(world.load())
    a, _ = cards_of(studio, world)
    look = Look(mix=((a, 1.0),), towards=Look(), at=0.25)
    lay_film(tmp_path, stage_of(studio.trained.known.cameras), plan_of(studio, [look]), "")
    style = json.loads((tmp_path / "style-1" / "style.json").read_text())["style"]
    assert style["strength"] == 0.75 and style["between"] is None


def test_paths_pass_through_their_keys(world: World) -> None:
    studio = Studio(world.load())
    stage = stage_of(studio.trained.known.cameras)
    plan = plan_of(studio, [Look()] * 4, seconds=0.2, fps=25)
    path = path_of(stage, plan)
    assert len(path) == 3 * 5 + 1 and path.size[0].tolist() == [32, 24]
    for i, key in enumerate(plan.keys):
        assert np.allclose(stage.eye(path, 5 * i).position, key.eye.position, atol=1e-9)
    assert len(path_of(stage, plan._replace(keys=plan.keys[:1]))) == 1


@pytest.mark.parametrize("change", [{"keys": ()}, {"fps": 0.0}, {"seconds": 1e9}, {"seconds": 400.0}])
def test_films_that_cannot_be_are_refused(world: World, change: dict[str, object]) -> None:
    studio = Studio(world.load())
    plan = plan_of(studio, [Look()] * 4)._replace(**change)  # type: ignore[arg-type]
    with pytest.raises((UsageError, ConfigError)):
        path_of(stage_of(studio.trained.known.cameras), plan)


def test_folders_are_numbered(tmp_path: Path) -> None:
    assert [new_folder(tmp_path).name for _ in range(3)] == ["0001", "0002", "0003"]


def test_a_film_that_fails_ends_its_frames(world: World, tmp_path: Path) -> None:
    out: Queue[Picture | None] = Queue()
    with pytest.raises(Exception, match="no such camera path"):
        list(frames_of_film(tmp_path, world.load(), out, lambda done, total: None))
    assert out.get_nowait() is None


def test_looks_that_differ_get_folders_of_their_own(world: World, tmp_path: Path) -> None:
    studio = Studio(world.load())
    a, _ = cards_of(studio, world)
    look = Look(mix=((a, 1.0),))
    lay_film(tmp_path, stage_of(studio.trained.known.cameras), plan_of(studio, [look, replace(look, blend=0.9)]), "")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["keys.json", "path.json", "style-1", "style-2"]
