"""Every control of the panel on a real session, moved as a browser would move it."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from fake_gui import Client, Gui
from photographs import until, viewed
from test_session import Listener
from tiny_world import World

from fprf.plugins.stylizers.config import RegionToneConfig
from fprf.style.config import StyleConfig, with_preset
from fprf.training.loading import load_run
from fprf.viewer import film
from fprf.viewer.cameras import CameraState
from fprf.viewer.panel import Panel
from fprf.viewer.session import Session
from fprf.viewer.state import FilmProgress, State, style_config


class Face(Listener):
    """A face with the panel on it."""

    panel: Panel

    def changed(self, before: State, now: State) -> None:
        self.panel.follow(before, now)
        super().changed(before, now)


class Room:
    def __init__(self, session: Session) -> None:
        self.session, self.gui, self.face, self.client = session, Gui(), Face(), Client(1)
        self.drawn = 0
        here = session.transform.camera_state(session.viewed.scene.cameras, 2)
        self.client.cameras.append(here)
        self.face.panel = self.panel = Panel(
            self.gui,  # type: ignore[arg-type]
            session,
            lambda client, eye: client.cameras.append(eye),  # type: ignore[attr-defined]
            lambda client: client.cameras[-1],  # type: ignore[attr-defined, no-any-return]
            self.draw,
        )
        session.attach(self.face)
        session.move_camera(1, here)

    @property
    def state(self) -> State:
        return self.session.state

    @property
    def camera(self) -> CameraState:
        found: CameraState = self.client.cameras[-1]
        return found

    def draw(self) -> None:
        self.drawn += 1

    def move(self, label: str, value: object) -> None:
        self.gui[label].moved(value, self.client)

    def press(self, label: str) -> None:
        self.gui[label].pressed(self.client)


@pytest.fixture
def room(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Room]:
    monkeypatch.setattr(film, "PREVIEW_FPS", 50.0)
    shutil.copytree(world.run, tmp_path / "run")
    with Session(viewed(load_run(tmp_path / "run", "cpu")), State(pixels=64)) as session:
        yield Room(session)


def test_sliders_of_the_look(room: Room) -> None:
    for label, value, name, wanted in (
        ("strength", 0.4, "strength", 0.4),
        ("temperature", 0.7000000001, "temperature", 0.7),
        ("clusters", 5.0, "clusters", 5),
        ("local ↔ global", 0.3, "blend", 0.3),
        ("keep light", 1.0, "luminance", 1.0),
        ("smoothness", 40.0, "smoothness", 40.0),
    ):
        room.move(label, value)
        found = getattr(room.state.look, name)
        assert found == wanted and type(found) is type(wanted)
    before = room.state
    room.move("strength", 7.0)
    assert room.state == before and any("strength" in text for text in room.face.said)


def test_a_preset_moves_the_sliders(room: Room) -> None:
    room.move("clusters", 5.0)
    room.press("gentle")
    wanted = with_preset(StyleConfig(), "gentle")
    assert style_config(room.state.look) == replace(wanted, clusters=5)
    shown = [room.gui[name].value for name in ("strength", "keep light", "local ↔ global", "smoothness", "temperature")]
    kind = wanted.stylizer
    assert isinstance(kind, RegionToneConfig)
    assert shown == [wanted.strength, wanted.luminance, wanted.blend, kind.smoothness, kind.temperature]


def test_what_is_shown(room: Room) -> None:
    for label, value, name, wanted in (
        ("map", "depth", "map", "depth"),
        ("map covers", 0.5, "map_opacity", 0.5),
        ("before/after", True, "wipe", 0.5),
        ("before/after", False, "wipe", None),
        ("pick a region", True, "picking", True),
        ("sharpness", 128.0, "pixels", 128),
        ("new photo", "in the mix", "drop_mode", "in the mix"),
        ("new photo", "nonsense", "drop_mode", "alone"),
    ):
        room.move(label, value)
        assert getattr(room.state, name) == wanted, label
    room.move("map", "nonsense")
    assert room.state.map == "depth"
    drawn = room.drawn
    room.move("cameras", True)
    room.move("blocks", True)
    assert room.drawn == drawn + 2 and room.panel.cameras and room.panel.blocks


def test_what_others_change_comes_back_to_the_controls(room: Room, world: World) -> None:
    from dataclasses import replace

    room.session.update(lambda state: replace(state, look=replace(state.look, strength=0.25), map="regions", wipe=0.7))
    assert room.gui["strength"].value == 0.25 and room.gui["map"].value == "regions" and room.gui["before/after"].value
    room.session.update(lambda state: replace(state, film=FilmProgress(3, 12)))
    assert room.gui["progress"].value == 25.0 and room.gui["Make the film"].disabled
    assert "frame 3 of 12" in room.gui["about"].content


def test_looks_are_kept_gone_back_to_and_lie_at_the_end_of_a_slider(room: Room, world: World) -> None:
    room.session.upload(world.references[0].read_bytes(), "dusk.png")
    first = room.state.look
    room.move("name", "dusk")
    room.press("Keep this look")
    assert room.gui["towards"].options == room.gui["back to"].options == ("nothing", "dusk")
    room.session.upload(world.references[1].read_bytes(), "snow.png")
    room.move("towards", "dusk")
    room.move("on the way", 0.5)
    assert room.state.look.towards == first and room.state.look.at == 0.5 and room.gui["towards"].value == "dusk"
    room.move("back to", "dusk")
    assert room.state.look == first and room.gui["towards"].value == "nothing"
    room.move("back to", "nothing")
    assert room.state.look == first


def test_keys_are_set_replaced_and_gone_to(room: Room, world: World) -> None:
    room.press("Go to the chosen key")
    assert any("no key is chosen" in text for text in room.face.said)
    start = room.camera
    until(lambda: room.session.thumbnail(1) is not None)
    room.press("Add a key here")
    room.session.upload(world.references[0].read_bytes(), "dusk.png")
    room.move("fly to view", 4)
    room.press("Add a key here")
    assert [key.camera for key in room.state.keys] == [start, room.camera] and room.state.selected_key == 1
    assert all(key.thumbnail is not None for key in room.state.keys) and "2 keys" in room.gui["about"].content
    room.move("fly to view", 5)
    room.press("Replace the chosen key")
    assert room.state.keys[1].camera == room.camera and room.drawn >= 3
    room.move("strength", 0.3)
    room.press("Go to the chosen key")
    assert room.state.look == room.state.keys[1].look and room.state.look.strength == 1.0


def test_a_flight_is_played_and_ended_by_the_same_button(room: Room) -> None:
    room.press("Add a key here")
    room.move("fly to view", 4)
    room.press("Add a key here")
    room.move("fly along", 0.0)
    assert room.camera.position == pytest.approx(room.state.keys[0].camera.position, abs=1e-6)
    room.gui["seconds between keys"].value = 60.0
    room.press("Play the flight")
    until(lambda: room.state.playing)
    room.press("Play the flight")
    until(lambda: not room.state.playing)


def test_the_film_is_what_the_controls_say(room: Room) -> None:
    room.press("Add a key here")
    room.gui["size"].value = "small (480)"
    room.gui["frames a second"].value = 12
    plan = room.panel.plan
    assert plan.size == (480, 360) and plan.fps == 12.0 and plan.seconds == 2.0 and len(plan.keys) == 1
    room.press("Make the film")
    until(lambda: room.state.film.path is not None)
    assert "film.mp4" in room.gui["about"].content and not room.gui["Make the film"].disabled
