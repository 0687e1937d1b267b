import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from queue import Queue

import cv2
import numpy as np
import pytest
from photographs import encoded, until, viewed
from test_session import Listener
from tiny_world import World

from fprf.cli import main as cli
from fprf.errors import ConfigError, UsageError
from fprf.training.loading import load_run
from fprf.viewer import film
from fprf.viewer.cameras import CameraState, page_transform
from fprf.viewer.film import FilmPlan, Frames, film_cameras, film_frames, new_folder, queued_frames, write_film_files
from fprf.viewer.renderer import ProgressiveRenderer
from fprf.viewer.restyler import Restyler
from fprf.viewer.session import Session
from fprf.viewer.state import Key, Look, State, set_rule


def drawn_by(restyler: Restyler) -> ProgressiveRenderer:
    """A renderer that shows nothing to anybody."""
    return ProgressiveRenderer(restyler.scene, restyler, page_transform(restyler.scene.known.cameras), lambda *shown: None)


def plan_of(restyler: Restyler, looks: list[Look], seconds: float = 0.1, fps: float = 30.0) -> FilmPlan:
    transform, cameras = page_transform(restyler.scene.known.cameras), restyler.scene.known.cameras
    keys = tuple(Key(transform.camera_state(cameras, view), look) for view, look in enumerate(looks))
    return FilmPlan(keys, seconds, fps, (32, 24))


def test_the_film_is_what_fprf_render_makes_of_its_folder(world: World, tmp_path: Path) -> None:
    shutil.copytree(world.run, tmp_path / "run")
    restyler = Restyler(world.load())
    a, b = encoded(restyler, world)
    one = set_rule(Look(mix=((a, 1.0),), clusters=3), 0, "keep")
    between = Look(mix=((b, 1.0),), clusters=3, towards=Look(mix=((a, 1.0),), clusters=3), at=0.5)
    plan = plan_of(restyler, [Look(), one, between])
    folder = new_folder(tmp_path / "run")
    write_film_files(folder, page_transform(restyler.scene.known.cameras), plan, restyler.scene.known.facts.semantic_encoder)
    out: Frames = Queue()
    told: list[tuple[int, int]] = []
    for _ in film_frames(folder, restyler.scene, drawn_by(restyler), out, lambda done, total: told.append((done, total))):
        pass
    frames = list(queued_frames(out))
    assert len(frames) == 7 and told == [(i + 1, 7) for i in range(7)]
    args = ["render", str(tmp_path / "run"), "--path", str(folder / "path.json"), "--keyframes", str(folder / "keys.json")]
    assert cli.main([*args, "--output", str(tmp_path / "frames")]) == 0
    pictures = [cv2.imread(str(p))[..., ::-1] for p in sorted((tmp_path / "frames").glob("*.png"))]
    assert len(pictures) == 7
    for mine, its in zip(frames, pictures, strict=True):
        assert np.array_equal(mine, its)
    assert not np.array_equal(frames[0], frames[3])


def test_files_name_no_path_of_this_machine(world: World, tmp_path: Path) -> None:
    restyler = Restyler(world.load())
    a, _ = encoded(restyler, world)
    write_film_files(tmp_path, page_transform(restyler.scene.known.cameras), plan_of(restyler, [Look(mix=((a, 1.0),))] * 2), "")
    keys = json.loads((tmp_path / "keys.json").read_text())
    assert keys["keyframes"] == [{"frame": 0, "style": "style-1/style.json"}, {"frame": 3, "style": "style-1/style.json"}]
    style = json.loads((tmp_path / "style-1" / "style.json").read_text())
    assert style["style"]["references"] == ["1-dusk.png"] and (tmp_path / "style-1" / "1-dusk.png").is_file()


def test_a_fade_to_the_scene_as_it_is_is_written_as_less_strength(world: World, tmp_path: Path) -> None:
    restyler = Restyler(world.load())
    a, _ = encoded(restyler, world)
    look = Look(mix=((a, 1.0),), towards=Look(), at=0.25)
    write_film_files(tmp_path, page_transform(restyler.scene.known.cameras), plan_of(restyler, [look]), "")
    style = json.loads((tmp_path / "style-1" / "style.json").read_text())["style"]
    assert style["strength"] == 0.75 and style["between"] is None


def test_paths_pass_through_their_keys(world: World) -> None:
    restyler = Restyler(world.load())
    transform = page_transform(restyler.scene.known.cameras)
    plan = plan_of(restyler, [Look()] * 4, seconds=0.2, fps=25)
    path = film_cameras(transform, plan)
    assert len(path) == 3 * 5 + 1 and path.size[0].tolist() == [32, 24]
    for i, key in enumerate(plan.keys):
        assert np.allclose(transform.camera_state(path, 5 * i).position, key.camera.position, atol=1e-9)
    assert len(film_cameras(transform, plan._replace(keys=plan.keys[:1]))) == 1


@pytest.mark.parametrize("change", [{"keys": ()}, {"fps": 0.0}, {"seconds": 1e9}, {"seconds": 400.0}])
def test_films_that_cannot_be_are_refused(world: World, change: dict[str, object]) -> None:
    restyler = Restyler(world.load())
    plan = plan_of(restyler, [Look()] * 4)._replace(**change)  # type: ignore[arg-type]
    with pytest.raises((UsageError, ConfigError)):
        film_cameras(page_transform(restyler.scene.known.cameras), plan)


def test_a_film_that_fails_ends_its_frames(world: World, tmp_path: Path) -> None:
    out: Frames = Queue()
    with pytest.raises(Exception, match="no such camera path"):
        restyler = Restyler(world.load())
        list(film_frames(tmp_path, restyler.scene, drawn_by(restyler), out, lambda done, total: None))
    assert out.get_nowait() is None


@pytest.fixture
def opened(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Session, Listener]]:
    monkeypatch.setattr(film, "PREVIEW_FPS", 50.0)
    shutil.copytree(world.run, tmp_path / "run")
    with Session(viewed(load_run(tmp_path / "run", "cpu")), State(pixels=64)) as session:
        listener = Listener()
        session.attach(listener)
        yield session, listener


def flight(session: Session, looks: list[Look], seconds: float = 0.2) -> FilmPlan:
    cameras = session.viewed.scene.cameras
    return FilmPlan(
        tuple(Key(session.transform.camera_state(cameras, view), look) for view, look in enumerate(looks)),
        seconds,
        24.0,
        (32, 24),
    )


def test_a_flight_goes_from_the_first_key_to_the_last_for_one_client_alone(
    opened: tuple[Session, Listener], world: World
) -> None:
    session, listener = opened
    card = session.upload(world.references[0].read_bytes(), "dusk.png")
    styled = session.state.look
    cameras = session.viewed.scene.cameras
    for client in (1, 2):
        session.move_camera(client, session.transform.camera_state(cameras, 5))
    listener.until(lambda: {c for c, f in listener.frames if f.final} == {1, 2})
    listener.frames.clear()
    flown: list[CameraState] = []
    plan = flight(session, [Look(), styled])
    session.films.play(1, plan, flown.append)
    until(lambda: not session.state.playing and len(flown) > 1 and session.idle)
    for key, eye in ((plan.keys[0], flown[0]), (plan.keys[1], flown[-1])):
        assert eye.position == pytest.approx(key.camera.position, abs=1e-6)
    assert {client for client, _ in listener.frames} == {1}
    assert session.state.look == styled and session.state.shelf == (card,)
    last = [frame for _, frame in listener.frames if frame.final][-1]
    assert last.camera.position == pytest.approx(plan.keys[1].camera.position, abs=1e-6)
    assert any(state.playing for state in listener.states)


def test_who_leaves_or_plays_again_ends_the_flight(opened: tuple[Session, Listener]) -> None:
    session, _ = opened
    session.move_camera(1, session.transform.camera_state(session.viewed.scene.cameras, 5))
    long, flown = flight(session, [Look(), Look()], seconds=300.0), list[CameraState]()
    session.films.play(1, long, flown.append)
    until(lambda: bool(flown))
    session.films.play(1, flight(session, [Look(), Look()]), flown.append)
    until(lambda: not session.state.playing)
    session.films.play(1, long, flown.append)
    until(lambda: session.state.playing)
    session.disconnect(1)
    until(lambda: not session.state.playing)
    assert not session.films._flights


def test_a_flight_of_nothing_is_told(opened: tuple[Session, Listener]) -> None:
    session, listener = opened
    session.move_camera(1, session.transform.camera_state(session.viewed.scene.cameras, 5))
    session.films.play(1, FilmPlan((), 1.0, 24.0, (32, 24)), lambda eye: None)
    listener.until(lambda: any("no keys" in text for text in listener.said))
    until(lambda: not session.films._flights)
