"""A flight that is played to one client, with a session of the tiny world."""

import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from test_session import Listener
from tiny_world import World

from fprf.training.loading import load_run
from fprf.viewer import crew
from fprf.viewer.cameras import Eye
from fprf.viewer.film import FilmPlan, Key
from fprf.viewer.looks import Look
from fprf.viewer.session import Session
from fprf.viewer.state import State


@pytest.fixture
def opened(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Session, Listener]]:
    monkeypatch.setattr(crew, "STEPS", 50.0)
    shutil.copytree(world.run, tmp_path / "run")
    with Session(load_run(tmp_path / "run", "cpu"), State(pixels=64)) as session:
        listener = Listener()
        session.meet(listener)
        yield session, listener


def plan_of(session: Session, looks: list[Look], seconds: float = 0.2) -> FilmPlan:
    cameras = session.trained.known.cameras
    return FilmPlan(
        tuple(Key(session.stage.eye(cameras, view), look) for view, look in enumerate(looks)), seconds, 24.0, (32, 24)
    )


def until(true: Callable[[], bool]) -> None:
    end = time.monotonic() + 120
    while not true():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_flight_goes_from_the_first_key_to_the_last_for_one_client_alone(
    opened: tuple[Session, Listener], world: World
) -> None:
    session, listener = opened
    card = session.drop(world.references[0].read_bytes(), "dusk.png")
    styled = session.state.look
    cameras = session.trained.known.cameras
    for client in (1, 2):
        session.see(client, session.stage.eye(cameras, 5))
    listener.until(lambda: {c for c, f in listener.frames if f.final} == {1, 2})
    listener.frames.clear()
    flown: list[Eye] = []
    plan = plan_of(session, [Look(), styled])
    session.play(1, plan, flown.append)
    until(lambda: not session.state.playing and len(flown) > 1 and session.idle)
    for key, eye in ((plan.keys[0], flown[0]), (plan.keys[1], flown[-1])):
        assert eye.position == pytest.approx(key.eye.position, abs=1e-6)
    assert {client for client, _ in listener.frames} == {1}
    assert session.state.look == styled and session.state.shelf == (card,)
    last = [frame for _, frame in listener.frames if frame.final][-1]
    assert last.eye.position == pytest.approx(plan.keys[1].eye.position, abs=1e-6)
    assert any(state.playing for state in listener.states)


def test_moves_of_the_client_s_own_do_not_count_while_it_flies(opened: tuple[Session, Listener]) -> None:
    session, _ = opened
    here = session.stage.eye(session.trained.known.cameras, 5)
    session.see(1, here)
    gate, flown = threading.Event(), list[Eye]()

    def fly(eye: Eye) -> None:
        flown.append(eye)
        assert gate.wait(60)

    session.play(1, plan_of(session, [Look(), Look()]), fly)
    until(lambda: len(flown) == 1)
    session.see(1, here)
    assert session._eyes[1].position != here.position
    gate.set()
    session.land(1)
    until(lambda: not session.state.playing)
    session.see(1, here)
    assert session._eyes[1] == here


def test_who_leaves_or_plays_again_ends_the_flight(opened: tuple[Session, Listener]) -> None:
    session, _ = opened
    session.see(1, session.stage.eye(session.trained.known.cameras, 5))
    long, flown = plan_of(session, [Look(), Look()], seconds=300.0), list[Eye]()
    session.play(1, long, flown.append)
    until(lambda: bool(flown))
    session.play(1, plan_of(session, [Look(), Look()]), flown.append)
    until(lambda: not session.state.playing)
    session.play(1, long, flown.append)
    until(lambda: session.state.playing)
    session.leave(1)
    until(lambda: not session.state.playing)
    assert not session._crew._flights


def test_a_flight_of_nothing_is_told(opened: tuple[Session, Listener]) -> None:
    session, listener = opened
    session.see(1, session.stage.eye(session.trained.known.cameras, 5))
    session.play(1, FilmPlan((), 1.0, 24.0, (32, 24)), lambda eye: None)
    listener.until(lambda: any("no keys" in text for text in listener.said))
    until(lambda: not session._crew._flights)


def test_a_thumbnail_is_what_was_seen_last(opened: tuple[Session, Listener]) -> None:
    session, listener = opened
    assert session.thumbnail(1) is None
    session.see(1, session.stage.eye(session.trained.known.cameras, 5))
    listener.until(lambda: any(frame.final for _, frame in listener.frames))
    first, second = session.thumbnail(1), session.thumbnail(1)
    assert first is not None and second is not None and first != second and first.number < second.number
    assert (first.picture == listener.frames[-1][1].picture).all()
    session.leave(1)
    assert session.thumbnail(1) is None
