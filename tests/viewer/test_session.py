import shutil
import threading
from collections.abc import Callable, Hashable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from photographs import viewed
from tiny_world import World

from fprf.errors import UsageError
from fprf.interfaces import Scene
from fprf.training.loading import load_run
from fprf.viewer.film import FilmPlan
from fprf.viewer.gaussian_renderer import Colours
from fprf.viewer.renderer import RenderedFrame
from fprf.viewer.session import Frontend, Session
from fprf.viewer.state import SHELF, Key, Look, State


class Listener(Frontend):
    """Remembers what it is told."""

    def __init__(self) -> None:
        self.frames: list[tuple[Hashable, RenderedFrame]] = []
        self.states: list[State] = []
        self.colours: list[Colours] = []
        self.scenes: list[Scene] = []
        self.said: list[str] = []
        self.news = threading.Condition()
        self.deaf = False

    def show(self, client: Hashable, frame: RenderedFrame) -> None:
        if self.deaf:
            raise RuntimeError("the client has gone")
        with self.news:
            self.frames.append((client, frame))
            self.news.notify_all()

    def reload(self, scene: Scene) -> None:
        with self.news:
            self.scenes.append(scene)

    def recolour(self, colours: Colours) -> None:
        with self.news:
            self.colours.append(colours)
            self.news.notify_all()

    def changed(self, before: State, now: State) -> None:
        with self.news:
            self.states.append(now)
            self.news.notify_all()

    def notify(self, text: str) -> None:
        with self.news:
            self.said.append(text)
            self.news.notify_all()

    def until(self, true: Callable[[], bool]) -> None:
        with self.news:
            assert self.news.wait_for(true, timeout=120)


@pytest.fixture
def opened(world: World, tmp_path: Path) -> Iterator[tuple[Session, Listener]]:
    shutil.copytree(world.run, tmp_path / "run")
    with Session(viewed(load_run(tmp_path / "run", "cpu")), State(pixels=64)) as session:
        listener = Listener()
        session.attach(listener)
        yield session, listener


def test_a_drop_restyles_what_every_client_sees(opened: tuple[Session, Listener], world: World) -> None:
    session, listener = opened
    cameras = session.viewed.scene.cameras
    for client in (1, 2):
        session.move_camera(client, session.transform.camera_state(cameras, client))
    listener.until(lambda: {c for c, f in listener.frames if f.final} == {1, 2})
    plain = {c: f.picture for c, f in listener.frames if f.final}
    listener.frames.clear()
    card = session.upload(world.references[0].read_bytes(), "../dusk.png")
    assert card.name == "dusk.png" and session.state.look.mix == ((card, 1.0),)
    listener.until(lambda: {c for c, f in listener.frames if f.final} == {1, 2})
    for client, frame in listener.frames:
        if frame.final:
            assert abs(frame.picture.astype(int) - plain[client]).mean() > 2  # type: ignore[index]
    again = session.upload(world.references[0].read_bytes(), "dusk.png")
    assert again.name == "dusk.png (2)" and session.state.shelf == (card, again)


def test_a_state_that_cannot_be_is_told_to_who_wanted_it(opened: tuple[Session, Listener]) -> None:
    session, listener = opened
    assert not session.update(lambda state: replace(state, wipe=7.0))
    assert session.state.wipe is None and any("wipe" in text for text in listener.said)
    assert session.update(lambda state: replace(state, wipe=0.5)) and listener.states[-1].wipe == 0.5


def test_a_click_picks_a_region_and_what_it_takes_follows_the_look(opened: tuple[Session, Listener], world: World) -> None:
    session, listener = opened
    session.pick(9, (0.5, 0.5))  # a client that nobody knows
    session.move_camera(1, session.transform.camera_state(session.viewed.scene.cameras, 2))
    session.pick(1, (0.5, 0.8))
    listener.until(lambda: session.state.picked is not None)
    assert session.state.picked is not None and session.state.picked.taken == ()
    session.upload(world.references[0].read_bytes(), "dusk.png")
    session.select_region(0)
    listener.until(lambda: session.state.picked is not None and session.state.picked.taken != ())
    session.select_region(99)
    listener.until(lambda: any("region 99" in text for text in listener.said))
    session.pick(1, (7.0, 0.5))
    listener.until(lambda: any("outside" in text for text in listener.said))
    session.select_region(None)
    listener.until(lambda: session.state.picked is None)


def test_a_film_is_made_while_others_look(opened: tuple[Session, Listener]) -> None:
    session, listener = opened
    cameras = session.viewed.scene.cameras
    keys = tuple(Key(session.transform.camera_state(cameras, view), Look()) for view in (0, 1))
    session.films.record(FilmPlan(keys, 0.1, 30.0, (32, 24)))
    session.move_camera(1, session.transform.camera_state(cameras, 2))
    listener.until(lambda: session.state.film.path is not None)
    path = session.state.film.path
    assert path is not None and path.stat().st_size > 500 and path.parent.parent == session.viewed.root / "films"
    assert session.state.film.done == session.state.film.total == 4
    assert (path.parent / "path.json").is_file() and any("film.mp4" in text for text in listener.said)


def test_who_drops_while_the_viewer_ends_is_not_left_waiting(opened: tuple[Session, Listener], world: World) -> None:
    session, _ = opened
    session._worker.close()
    with pytest.raises(UsageError, match="the viewer is ending"):
        session.upload(world.references[0].read_bytes(), "dusk.png")


def test_faults_of_ours_are_told_and_nothing_stops(opened: tuple[Session, Listener]) -> None:
    session, listener = opened
    listener.deaf = True
    session.move_camera(1, session.transform.camera_state(session.viewed.scene.cameras, 2))
    listener.until(lambda: any("should not have happened" in text for text in listener.said))
    listener.deaf = False
    session.move_camera(1, session.transform.camera_state(session.viewed.scene.cameras, 3))
    listener.until(lambda: any(f.final for _, f in listener.frames))
    session.disconnect(1)
    session.disconnect(1)


def test_photographs_that_left_the_shelf_leave_nothing(opened: tuple[Session, Listener], world: World) -> None:
    session, _ = opened
    data = world.references[0].read_bytes()
    for _ in range(SHELF + 3):
        session.upload(data, "x.png")
    assert len(list(session.uploads.folder.glob("*.png"))) == SHELF == len(session.state.shelf)
    assert {key[0] for key in session.restyler._dictionaries} <= session.state.photographs


def test_the_rehearsal_leaves_nothing_behind(opened: tuple[Session, Listener]) -> None:
    session, listener = opened
    session.warm_up()
    done = threading.Event()

    def last() -> Iterator[None]:
        yield
        done.set()

    session._worker.run_when_idle(last())
    assert done.wait(120)
    assert session.state == State(pixels=64) and listener.frames == [] and not session.restyler._styles
