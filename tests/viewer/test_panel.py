"""Every control of the panel on a real session, moved as a browser would move it."""

from dataclasses import replace
from operator import attrgetter

import pytest
from fake_gui import Client, Gui
from session_helpers import Listener, camera_of, until
from tiny_world import World

from fprf.style.config import StyleConfig, with_preset
from fprf.viewer.cameras import CameraState
from fprf.viewer.panel import Panel
from fprf.viewer.session import Session
from fprf.viewer.state import FilmProgress, State, style_config


class Controls(Listener):
    """A page of the panel alone, moved and pressed by one client."""

    def __init__(self, session: Session) -> None:
        super().__init__()
        self.session, self.gui, self.client, self.drawn = session, Gui(), Client(1), 0
        self.client.cameras.append(camera_of(session.viewed.scene, 2))
        self.panel = Panel(
            self.gui,  # type: ignore[arg-type]
            session,
            lambda client, camera: client.cameras.append(camera),  # type: ignore[attr-defined]
            lambda client: client.cameras[-1],  # type: ignore[attr-defined, no-any-return]
            self.draw,
        )
        session.attach(self)
        session.move_camera(1, self.camera)

    def changed(self, before: State, now: State) -> None:
        self.panel.follow(before, now)
        super().changed(before, now)

    @property
    def state(self) -> State:
        return self.session.state

    @property
    def camera(self) -> CameraState:
        return self.client.cameras[-1]

    def draw(self) -> None:
        self.drawn += 1

    def move(self, label: str, value: object) -> None:
        self.gui[label].moved(value, self.client)

    def press(self, label: str) -> None:
        self.gui[label].pressed(self.client)


@pytest.fixture
def controls(session: Session) -> Controls:
    return Controls(session)


def test_controls_change_the_state(controls: Controls) -> None:
    for label, value, name, wanted in (
        ("strength", 0.4, "look.strength", 0.4),
        ("temperature", 0.7000000001, "look.temperature", 0.7),
        ("clusters", 5.0, "look.clusters", 5),
        ("local ↔ global", 0.3, "look.blend", 0.3),
        ("keep light", 1.0, "look.luminance", 1.0),
        ("smoothness", 40.0, "look.smoothness", 40.0),
        ("strength", 7.0, "look.strength", 0.4),
        ("map", "depth", "map", "depth"),
        ("map", "nonsense", "map", "depth"),
        ("map covers", 0.5, "map_opacity", 0.5),
        ("before/after", True, "wipe", 0.5),
        ("before/after", False, "wipe", None),
        ("pick a region", True, "picking", True),
        ("sharpness", 128.0, "pixels", 128),
        ("new photo", "in the mix", "drop_mode", "in the mix"),
        ("new photo", "nonsense", "drop_mode", "alone"),
    ):
        controls.move(label, value)
        found = attrgetter(name)(controls.state)
        assert found == wanted and type(found) is type(wanted), label
    assert [text.partition(":")[0] for text in controls.said] == ["strength", "map"]
    drawn = controls.drawn
    controls.move("cameras", True)
    controls.move("blocks", True)
    assert controls.drawn == drawn + 2 and controls.panel.cameras and controls.panel.blocks


def test_a_preset_moves_the_sliders(controls: Controls) -> None:
    controls.move("clusters", 5.0)
    controls.press("gentle")
    wanted = with_preset(StyleConfig(), "gentle")
    assert style_config(controls.state.look) == replace(wanted, clusters=5)
    shown = [controls.gui[name].value for name in ("strength", "keep light", "local ↔ global", "smoothness", "temperature")]
    kind = wanted.stylizer
    assert shown == [wanted.strength, wanted.luminance, wanted.blend, kind.smoothness, kind.temperature]


def test_controls_follow_what_others_change(controls: Controls) -> None:
    controls.session.update(lambda state: replace(state, look=replace(state.look, strength=0.25), map="regions", wipe=0.7))
    gui = controls.gui
    assert gui["strength"].value == 0.25 and gui["map"].value == "regions" and gui["before/after"].value
    controls.session.update(lambda state: replace(state, film=FilmProgress(3, 12)))
    assert gui["progress"].value == 25.0 and gui["Make the film"].disabled and "frame 3 of 12" in gui["about"].content


def test_looks_are_saved_restored_and_faded_to(controls: Controls, world: World) -> None:
    upload, gui = controls.session.upload, controls.gui
    upload(world.references[0].read_bytes(), "dusk.png")
    first = controls.state.look
    controls.move("name", "dusk")
    controls.press("Keep this look")
    assert gui["towards"].options == gui["back to"].options == ("nothing", "dusk")
    upload(world.references[1].read_bytes(), "snow.png")
    controls.move("towards", "dusk")
    controls.move("on the way", 0.5)
    assert controls.state.look.towards == first and controls.state.look.at == 0.5 and gui["towards"].value == "dusk"
    for name in ("dusk", "nothing"):
        controls.move("back to", name)
        assert controls.state.look == first and gui["towards"].value == "nothing"


def test_keys_are_added_replaced_and_gone_to(controls: Controls, world: World) -> None:
    controls.press("Go to the chosen key")
    assert any("no key is chosen" in text for text in controls.said)
    start = controls.camera
    until(lambda: controls.session.thumbnail(1) is not None)
    controls.press("Add a key here")
    controls.session.upload(world.references[0].read_bytes(), "dusk.png")
    controls.move("fly to view", 4)
    controls.press("Add a key here")
    assert [key.camera for key in controls.state.keys] == [start, controls.camera] and controls.state.selected_key == 1
    assert all(key.thumbnail is not None for key in controls.state.keys) and "2 keys" in controls.gui["about"].content
    controls.move("fly to view", 5)
    controls.press("Replace the chosen key")
    assert controls.state.keys[1].camera == controls.camera and controls.drawn >= 3
    controls.move("strength", 0.3)
    controls.press("Go to the chosen key")
    assert controls.state.look == controls.state.keys[1].look and controls.state.look.strength == 1.0
    controls.move("fly along", 0.0)
    assert controls.camera.position == pytest.approx(start.position, abs=1e-6)
    controls.gui["seconds between keys"].value = 60.0
    controls.press("Play the flight")
    until(lambda: controls.state.playing)
    controls.press("Play the flight")
    until(lambda: not controls.state.playing)


def test_pictures_and_films_are_what_the_controls_say(controls: Controls) -> None:
    controls.client.camera = type("Camera", (), {"image_width": 4096, "image_height": 64})
    controls.press("Save a picture")
    until(lambda: len(controls.state.pictures) == 1)
    controls.press("Add a key here")
    controls.gui["size"].value = "small (480)"
    controls.gui["frames a second"].value = 12
    plan = controls.panel.plan
    assert plan.size == (480, 360) and plan.fps == 12.0 and plan.seconds == 2.0 and len(plan.keys) == 1
    controls.press("Make the film")
    until(lambda: controls.state.film.path is not None)
    assert "film.mp4" in controls.gui["about"].content and not controls.gui["Make the film"].disabled
