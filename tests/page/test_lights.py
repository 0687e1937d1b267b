"""The light of looks in a session: what browsers get, what is kept, undone, saved and filmed."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pages import seen, street
from session_helpers import Listener, camera_of
from splat_ball import ball
from test_session import unpacked
from tiny_world import World

from fprf.errors import DataError, UsageError
from fprf.light.config import SunConfig
from fprf.page import lighting, messages
from fprf.page.films import film_frames, write_film_files
from fprf.page.lighting import Lighting
from fprf.page.messages import read_message
from fprf.page.pack import pack
from fprf.page.saved import made_of, read_page, write_page
from fprf.page.session import Session
from fprf.page.suns import packed_light
from fprf.splats.files import read_capture
from fprf.splats.relighting import relit_harmonics, thinned
from fprf.style.config import StyleConfig
from fprf.style.files import read_style

EVENING = messages.Sun(sun=(120.0, 20.0), strength=0.8)
CONFIG = SunConfig(sun=(120.0, 20.0), sun_strength=0.8)


def heard(listener: Listener, kind: str, since: int = 0) -> list[dict[str, Any]]:
    return [message for _, what, message in listener.sent[since:] if what == kind]


def test_a_sun_is_a_part_of_the_look(splats: Session, listener: Listener) -> None:
    scene = splats.viewed.scene
    splats.handle(1, EVENING)
    listener.until(lambda: bool(heard(listener, "light Now")))
    listener.until(lambda: bool(heard(listener, "colours Now")))
    assert splats.state.described()["sun"] == {
        "light": None,
        "sun": (120.0, 20.0),
        "from": "north",
        "strength": 0.8,
    }
    head, parts = unpacked(splats.lights.light("Now"))
    light = packed_light(scene.light_found, CONFIG)  # type: ignore[attr-defined]
    order = splats.packed.order.numpy()
    assert light.met is not None and parts["met"] == light.met[order].tobytes()
    assert head["strength"] == 0.8 and head["sun"] == light.head["sun"]
    assert head["at"] == pytest.approx((120, 20), abs=1e-3)
    # Colours without the light go beside it, here those of the scene as captured.
    assert unpacked(splats.colours("Now"))[1]["rows"] == unpacked(splats.geometry)[1]["style-0"]
    about, planes = unpacked(splats.lights.surfaces())
    assert len(planes["planes"]) == 2 * 400 and len(about["day"]) > 8  # type: ignore[arg-type]
    assert "light Now" in dict(splats.hello())
    # What is shown is what is saved; the scene as captured stays as it was.
    saved = read_capture(splats.gaussians("Now", "Captured", 1.0, ".ply")).gaussians.harmonics
    gain = scene.light_found.gain(CONFIG)  # type: ignore[attr-defined]
    assert torch.allclose(saved, relit_harmonics(scene.gaussians.harmonics, gain), atol=1e-5)  # type: ignore[attr-defined]
    plain = read_capture(splats.gaussians("Captured", "Captured", 1.0, ".ply")).gaussians.harmonics
    assert torch.equal(plain, scene.gaussians.harmonics)  # type: ignore[attr-defined]
    # Moves of the sun are one step.
    splats.handle(1, messages.Sun(sun=(90.0, 30.0), strength=0.8))
    splats.handle(1, messages.Undo())
    assert splats.state.look.plain
    listener.until(lambda: heard(listener, "light Now")[-1]["version"] is None)
    with pytest.raises(UsageError, match="no such light"):
        splats.lights.light("Now")
    splats.handle(1, messages.Undo(again=True))
    assert splats.state.look.style.sun == (90.0, 30.0)


def test_looks_that_are_kept_and_keyframes_hold_their_light(
    splats: Session, listener: Listener, tmp_path: Path
) -> None:
    scene = splats.viewed.scene
    camera = camera_of(scene, 0)
    splats.handle(1, messages.Key(action="add", camera=camera, shown="Captured"))
    splats.handle(1, EVENING)
    splats.handle(1, messages.Keep(name="evening", action="keep"))
    listener.until(lambda: bool(heard(listener, "light evening")))
    splats.handle(1, messages.Key(action="add", camera=camera, shown="evening"))
    splats.handle(1, messages.Sun(light="overcast"))
    listener.until(lambda: bool(heard(listener, "light Now")))
    assert [key.look.style.lit for key in splats.state.keys] == [False, True]
    # In the scene's folder.
    write_page(tmp_path / "page", splats.state.made, "", None, {})
    page = read_page(tmp_path / "page")
    assert page is not None
    again = made_of(page, {})
    assert again.look.style.light == "overcast" and dict(again.kept)["evening"].style.sun == (120.0, 20.0)
    # In a film: one light fades into the other.
    film = messages.Film(seconds=0.1, side=32, fps=20.0)
    write_film_files(tmp_path / "film", splats.state.keys, film, scene)
    file = read_style(tmp_path / "film" / "style-1" / "style.json")
    assert file.style.sun == (120.0, 20.0) and not file.style.references
    pictures = []
    for steps in film_frames(tmp_path / "film", scene):
        try:
            while True:
                next(steps)
        except StopIteration as end:
            pictures.append(end.value.astype(float))
    assert np.abs(pictures[0] - pictures[-1]).mean() > 1
    half = np.abs(pictures[1] - (pictures[0] + pictures[-1]) / 2).mean()
    assert half < np.abs(pictures[0] - pictures[-1]).mean() / 4
    # A style that is sent holds it, and is taken up again.
    archive = splats.style_archive("evening").read_bytes()
    splats.take_style(archive)
    assert splats.state.look.style.sun == (120.0, 20.0)
    count = len(listener.sent)
    splats.handle(1, messages.Keep(name="evening", action="remove"))
    listener.until(lambda: bool(heard(listener, "light evening", count)))
    assert heard(listener, "light evening", count)[-1]["version"] is None


def test_a_light_falls_on_a_painted_scene_without_painting_it_anew(
    splats: Session, listener: Listener, world: World
) -> None:
    splats.upload(world.references[0].read_bytes(), "dusk.png")
    listener.until(lambda: bool(heard(listener, "colours Now")))
    painted = splats.colours("Now")
    splats.handle(1, EVENING)
    listener.until(lambda: bool(heard(listener, "light Now")))
    assert splats.colours("Now") is painted
    # A map is not lit.
    splats.handle(1, messages.Map(map="regions"))
    listener.until(lambda: heard(listener, "light Now")[-1]["version"] is None)


def test_fields_have_no_sun(session: Session) -> None:
    with pytest.raises(UsageError, match="light falls on Gaussians"):
        session.handle(1, EVENING)
    assert session.state.look.plain


@pytest.mark.parametrize(
    "text",
    [
        '{"type": "sun", "sun": [0, 0]}',
        '{"type": "sun", "sun": [0, 91]}',
        '{"type": "sun", "light": "disco"}',
        '{"type": "sun", "strength": 1.1}',
        '{"type": "sun", "sun": [1]}',
    ],
)
def test_no_page_sends_such_a_sun(text: str) -> None:
    with pytest.raises(DataError):
        read_message(text)


def test_a_moving_sun_is_found_on_some_and_a_resting_one_on_all(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = seen(ball(3000))
    order = pack(scene.gaussians).order
    exact = Lighting(scene, order).light(CONFIG)
    monkeypatch.setattr(lighting, "_MAX_MOVING_GAUSSIANS", 1100)
    coarse = Lighting(scene, order)
    assert coarse.light(CONFIG) == exact
    moved = np.frombuffer(unpacked(coarse.light(CONFIG, moving=True))[1]["met"], np.uint8).astype(float)
    resting = np.frombuffer(unpacked(exact)[1]["met"], np.uint8).astype(float)
    assert moved.shape == resting.shape and (moved != resting).any()
    # The side that faces away is dark in both.
    assert np.corrcoef(moved, resting)[0, 1] > 0.8


def test_all_rows_thinned_by_one_receive_the_same() -> None:
    known = seen(street(1500)).light_found
    rows = torch.randperm(1500, generator=torch.Generator().manual_seed(1))
    sun = known.sun_direction(50.0, 35.0)
    same = thinned(known, rows, 1).reach(sun)
    assert torch.allclose(same, known.reach(sun)[rows], atol=1e-5)


def test_a_look_in_the_captured_light_keeps_all_else() -> None:
    from fprf.page.looks import Look

    style = StyleConfig(light="noon", sun=(3.0, 4.0), sun_colour="3000K", bold=0.3)
    assert Look(style=style).unlit == Look(style=StyleConfig(bold=0.3))
