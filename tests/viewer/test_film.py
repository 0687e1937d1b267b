import json
from collections.abc import Iterator
from pathlib import Path
from queue import Queue

import cv2
import numpy as np
import pytest
from session_helpers import Listener, camera_of, plan_of, until
from tiny_world import World

from fprf.cli import main as cli
from fprf.errors import ConfigError, FprfError, UsageError
from fprf.viewer import film
from fprf.viewer.cameras import CameraState, page_transform
from fprf.viewer.film import FilmPlan, Frames, film_cameras, film_frames, new_folder, queued_frames, write_film_files
from fprf.viewer.renderer import ProgressiveRenderer
from fprf.viewer.restyler import Restyler
from fprf.viewer.session import Session
from fprf.viewer.state import Look, Photograph, set_rule


@pytest.fixture(autouse=True)
def _fast_preview(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(film, "PREVIEW_FPS", 50.0)


def renderer_of(restyler: Restyler) -> ProgressiveRenderer:
    return ProgressiveRenderer(restyler.scene, restyler, page_transform(restyler.scene.cameras), lambda *shown: None)


def test_the_film_is_what_fprf_render_makes_of_its_folder(
    restyler: Restyler, encoded: tuple[Photograph, Photograph], run: Path, tmp_path: Path
) -> None:
    a, b = encoded
    scene = restyler.scene
    one = set_rule(Look(mix=((a, 1.0),), clusters=3), 0, "keep")
    between = Look(mix=((b, 1.0),), clusters=3, towards=Look(mix=((a, 1.0),), clusters=3), at=0.5)
    fading = Look(mix=((a, 1.0),), clusters=3, towards=Look(), at=0.25)
    plan = plan_of(scene, [Look(), one, between, fading, one])
    folder = new_folder(run)
    write_film_files(folder, page_transform(scene.cameras), plan, scene.known.facts.semantic_encoder)
    rows = json.loads((folder / "keys.json").read_text())["keyframes"]
    numbers = (None, 1, 2, 3, 1)  # one file a look
    assert rows == [{"frame": 3 * i, "style": n and f"style-{n}/style.json"} for i, n in enumerate(numbers)]
    style = json.loads((folder / "style-3" / "style.json").read_text())["style"]
    assert style["strength"] == 0.75 and style["between"] is None  # a fade to the scene as it is
    assert style["references"] == ["1-dusk.png"] and (folder / "style-3" / "1-dusk.png").is_file()
    out: Frames = Queue()
    told: list[tuple[int, int]] = []
    for _ in film_frames(folder, scene, renderer_of(restyler), out, lambda done, total: told.append((done, total))):
        pass
    frames = list(queued_frames(out))
    assert len(frames) == 13 and told == [(i + 1, 13) for i in range(13)]
    args = ["render", str(run), "--path", str(folder / "path.json"), "--keyframes", str(folder / "keys.json")]
    assert cli.main([*args, "--output", str(tmp_path / "frames")]) == 0
    pictures = [cv2.imread(str(p))[..., ::-1] for p in sorted((tmp_path / "frames").glob("*.png"))]
    for mine, its in zip(frames, pictures, strict=True):
        assert np.array_equal(mine, its)
    assert not np.array_equal(frames[0], frames[3])


def test_paths_pass_through_their_keys(world: World) -> None:
    scene = world.load()
    transform, plan = page_transform(scene.cameras), plan_of(scene, [Look()] * 4, seconds=0.2, fps=25)
    path = film_cameras(transform, plan)
    assert len(path) == 3 * 5 + 1 and path.size[0].tolist() == [32, 24]
    for i, key in enumerate(plan.keys):
        assert np.allclose(transform.camera_state(path, 5 * i).position, key.camera.position, atol=1e-9)
    assert len(film_cameras(transform, plan._replace(keys=plan.keys[:1]))) == 1
    for change in ({"keys": ()}, {"fps": 0.0}, {"seconds": 1e9}, {"seconds": 400.0}):
        with pytest.raises((UsageError, ConfigError)):
            film_cameras(transform, plan._replace(**change))  # type: ignore[arg-type]


def test_a_film_that_fails_ends_with_its_error(restyler: Restyler, tmp_path: Path) -> None:
    out: Frames = Queue()
    with pytest.raises(FprfError, match="no such camera path"):
        list(film_frames(tmp_path, restyler.scene, renderer_of(restyler), out, lambda done, total: None))
    with pytest.raises(FprfError, match="no such camera path"):
        list(queued_frames(out))


def test_a_flight_goes_from_the_first_key_to_the_last_for_one_client_alone(
    session: Session, listener: Listener, world: World
) -> None:
    card = session.upload(world.references[0].read_bytes(), "dusk.png")
    styled = session.state.look
    for client in (1, 2):
        session.move_camera(client, camera_of(session.viewed.scene, 5))
    listener.until(lambda: listener.final().keys() == {1, 2})
    listener.frames.clear()
    flown: list[CameraState] = []
    plan = plan_of(session.viewed.scene, [Look(), styled], 0.2)
    session.films.play(1, plan, flown.append)
    until(lambda: not session.state.playing and len(flown) > 1 and session.idle)
    for key, camera in ((plan.keys[0], flown[0]), (plan.keys[1], flown[-1])):
        assert camera.position == pytest.approx(key.camera.position, abs=1e-6)
    assert {client for client, _ in listener.frames} == {1}
    assert session.state.look == styled and session.state.shelf == (card,)
    assert listener.final()[1].camera.position == pytest.approx(plan.keys[1].camera.position, abs=1e-6)
    assert any(state.playing for state in listener.states)


def test_another_flight_or_leaving_ends_a_flight(session: Session, listener: Listener) -> None:
    session.move_camera(1, camera_of(session.viewed.scene, 5))
    long, flown = plan_of(session.viewed.scene, [Look()] * 2, seconds=300.0), list[CameraState]()
    session.films.play(1, long, flown.append)
    until(lambda: bool(flown))
    session.films.play(1, plan_of(session.viewed.scene, [Look()] * 2, 0.2), flown.append)
    until(lambda: not session.state.playing)
    session.films.play(1, long, flown.append)
    until(lambda: session.state.playing)
    session.disconnect(1)
    until(lambda: not session.state.playing)
    session.films.play(1, FilmPlan((), 1.0, 24.0, (32, 24)), flown.append)
    listener.until_said("no keys")
    until(lambda: not session.films.playing(1))


def test_a_film_that_cannot_be_written_leaves_room_for_the_next(
    session: Session, listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More frames than wait in the queue are rendered while nobody takes them."""

    def full(path: Path, frames: Iterator[object], fps: float) -> None:
        next(frames)
        raise OSError("disk full")

    long = plan_of(session.viewed.scene, [Look()] * 2, seconds=1.0)
    with monkeypatch.context() as patch:
        patch.setattr(film, "write_video", full)
        session.films.record(long)
        listener.until_said("disk full")
    session.films.record(plan_of(session.viewed.scene, [Look()] * 2, seconds=0.2))
    until(lambda: session.state.film.path is not None)
