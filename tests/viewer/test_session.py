import threading

import pytest
from session_helpers import Listener, camera_of, plan_of
from tiny_world import World

from fprf.errors import UsageError
from fprf.viewer.render_worker import Steps
from fprf.viewer.session import Session
from fprf.viewer.state import SHELF, Look, State


def test_a_photograph_restyles_what_every_client_sees(session: Session, listener: Listener, world: World) -> None:
    for client in (1, 2):
        session.move_camera(client, camera_of(session.viewed.scene, client))
    listener.until(lambda: listener.final().keys() == {1, 2})
    plain = listener.final()
    listener.frames.clear()
    card = session.upload(world.references[0].read_bytes(), "../dusk.png")
    assert card.name == "dusk.png" and session.state.look.mix == ((card, 1.0),)
    listener.until(lambda: listener.final().keys() == {1, 2})
    for client, frame in listener.final().items():
        assert abs(frame.picture.astype(int) - plain[client].picture).mean() > 2
    again = session.upload(world.references[0].read_bytes(), "dusk.png")
    assert again.name == "dusk.png (2)" and session.state.shelf == (card, again)


def test_a_click_picks_a_region_and_its_references_follow_the_look(session: Session, listener: Listener, world: World) -> None:
    session.pick(9, (0.5, 0.5))  # a client that nobody knows
    session.move_camera(1, camera_of(session.viewed.scene, 2))
    session.pick(1, (0.5, 0.8))
    listener.until(lambda: session.state.picked is not None)
    assert session.state.picked is not None and session.state.picked.taken == ()
    session.upload(world.references[0].read_bytes(), "dusk.png")
    session.select_region(0)
    listener.until(lambda: session.state.picked is not None and session.state.picked.taken != ())
    session.select_region(99)
    listener.until_said("region 99")
    session.pick(1, (7.0, 0.5))
    listener.until_said("outside")
    session.select_region(None)
    listener.until(lambda: session.state.picked is None)


def test_a_film_is_made_while_others_look(session: Session, listener: Listener) -> None:
    session.films.record(plan_of(session.viewed.scene, [Look()] * 2))
    session.films.record(plan_of(session.viewed.scene, [Look()] * 2))
    session.move_camera(1, camera_of(session.viewed.scene, 2))
    listener.until(lambda: session.state.film.path is not None)
    path = session.state.film.path
    assert path is not None and path.stat().st_size > 500 and path.parent.parent == session.viewed.root / "films"
    assert session.state.film.done == session.state.film.total == 4
    assert (path.parent / "path.json").is_file() and any("film.mp4" in text for text in listener.said)
    assert any("one is being made" in text for text in listener.said)


def test_an_upload_ends_with_the_viewer(session: Session, world: World) -> None:
    session._worker.close()
    with pytest.raises(UsageError, match="the viewer is ending"):
        session.upload(world.references[0].read_bytes(), "dusk.png")


def test_an_unexpected_error_is_told_and_nothing_stops(session: Session, listener: Listener) -> None:
    listener.fails = True
    session.move_camera(1, camera_of(session.viewed.scene, 2))
    listener.until_said("should not have happened")
    listener.fails = False
    session.move_camera(1, camera_of(session.viewed.scene, 3))
    listener.until(lambda: bool(listener.final()))
    session.disconnect(1)
    session.disconnect(1)


def test_photographs_that_left_the_shelf_are_deleted(session: Session, world: World) -> None:
    for _ in range(SHELF + 3):
        session.upload(world.references[0].read_bytes(), "x.png")
    assert len(list(session.uploads.folder.glob("*.png"))) == SHELF == len(session.state.shelf)
    assert {key[0] for key in session.restyler._dictionaries} <= session.state.photographs


def test_the_warm_up_leaves_nothing_behind(session: Session, listener: Listener) -> None:
    session.warm_up()
    done = threading.Event()

    def last() -> Steps:
        yield
        done.set()

    session._worker.run_when_idle(last())
    assert done.wait(120)
    assert session.state == State(pixels=64) and listener.frames == [] and not session.restyler._styles
