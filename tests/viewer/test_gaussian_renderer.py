"""Gaussians in the viewer: browsers get the colours of the scene in its look, and nothing while cameras move."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from session_helpers import Listener, camera_of, plan_of
from splat_ball import ball
from tiny_world import World

from fprf.io.images import to_uint8
from fprf.plugins.encoders.config import BundledSemanticConfig
from fprf.plugins.stylizers.config import RegionToneConfig
from fprf.splats.config import LookConfig
from fprf.splats.files import read_capture
from fprf.splats.scene import SplatScene, look_at_capture
from fprf.style.files import StyleFile
from fprf.style.restyle import apply_style
from fprf.viewer.cameras import page_transform
from fprf.viewer.gaussian_renderer import page_gaussians
from fprf.viewer.session import Session, Viewed
from fprf.viewer.state import Look, State, set_rule, style_config

TONE = RegionToneConfig(centred=False)


@pytest.fixture(scope="module")
def scene() -> SplatScene:
    return look_at_capture(ball(400), False, BundledSemanticConfig().build(), LookConfig(views=6, size=(96, 72), regions=4))


@pytest.fixture
def session(scene: SplatScene, tmp_path: Path, listener: Listener) -> Iterator[Session]:
    with Session(Viewed(scene, "ball", 0, root=tmp_path, stylizer=TONE), State(pixels=64)) as session:
        session.attach(listener)
        session.move_camera(1, camera_of(scene, 0))
        yield session


def test_a_photograph_sends_the_colours_of_the_restyled_scene(
    session: Session, listener: Listener, scene: SplatScene, world: World
) -> None:
    photograph = session.upload(world.references[0].read_bytes(), "dusk.png")
    listener.until(lambda: len(listener.colours) == 1)
    wanted = scene.restyled(apply_style(scene, StyleFile(style_config(session.state.look, TONE))).restyle)
    colours = to_uint8(scene.seen.colours(wanted.shown.harmonics).clamp(0, 1)[None])[0]
    assert np.abs(listener.colours[0].astype(int) - colours).max() <= 1
    session.move_camera(1, camera_of(scene, 1))
    session.update(lambda state: replace(state, look=set_rule(state.look, 0, "keep")))
    listener.until(lambda: len(listener.colours) == 2)  # none for the camera alone
    assert (listener.colours[1] != listener.colours[0]).any()
    session.update(lambda state: replace(state, look=Look(mix=((photograph, 1.0),), strength=0.0)))
    listener.until(lambda: len(listener.colours) == 3)
    plain = scene.seen.gaussians(scene.gaussians)
    assert np.array_equal(listener.colours[2], to_uint8(plain.colours.clamp(0, 1)[None])[0])
    assert listener.frames == []


def test_maps_and_a_picked_region_are_colours_too(
    session: Session, listener: Listener, scene: SplatScene, world: World
) -> None:
    for number, name in enumerate(("regions", "matches"), 1):
        session.update(lambda state, name=name: replace(state, map=name, map_opacity=1.0))  # type: ignore[misc]
        listener.until(lambda number=number: len(listener.colours) == number)  # type: ignore[misc]
    assert len(np.unique(listener.colours[0], axis=0)) > 3 and (listener.colours[1] == 128).all()
    session.pick(1, (0.5, 0.5))  # the ball is in the middle
    listener.until(lambda: session.state.picked is not None and len(listener.colours) == 3)
    session.update(lambda state: replace(state, map="none"))
    listener.until(lambda: len(listener.colours) == 4)
    plain = to_uint8(scene.gaussians.colours.clamp(0, 1)[None])[0]
    same = (np.abs(listener.colours[3].astype(int) - plain) <= 1).all(1)
    assert 0 < same.mean() < 1  # the region stands out, the others are dimmed
    session.update(lambda state: replace(state, map="matches", picked=None))
    session.upload(world.references[0].read_bytes(), "dusk.png")
    listener.until(lambda: len(listener.colours) == 6)
    shown = listener.colours[5].astype(int)
    assert len(np.unique(shown, axis=0)) > 1 and (shown[:, 0] > shown[:, 2]).all()  # shades of the first hue, which is orange


def test_films_are_rasterised_into_the_scene_s_folder(session: Session, listener: Listener, scene: SplatScene) -> None:
    plan = plan_of(scene, [Look()] * 2)
    session.films.record(plan)
    listener.until(lambda: session.state.film.path is not None)
    shown = cv2.VideoCapture(str(session.state.film.path)).read()[1][..., ::-1].astype(int)
    cameras = session.transform.cameras([plan.keys[0].camera], (32, 24))
    assert np.abs(shown - to_uint8(scene.render(cameras, 0).rgb)).mean() < 6  # what the codec leaves
    session.viewed = replace(session.viewed, root=None)
    session.films.record(plan)
    listener.until_said("no folder")


def test_pictures_and_gaussians_in_the_present_look_are_files(
    session: Session, listener: Listener, scene: SplatScene, world: World, tmp_path: Path
) -> None:
    session.upload(world.references[0].read_bytes(), "dusk.png")
    styled = scene.restyled(session.restyler.restyle(session.state.look))
    camera = camera_of(scene, 0)
    session.save_picture(camera, (48, 36))
    listener.until(lambda: len(session.state.pictures) == 1)
    [path] = session.state.pictures
    assert path.parent.parent == tmp_path
    shown = cv2.imread(str(path))[..., ::-1]
    assert np.array_equal(shown, to_uint8(styled.render(session.transform.cameras([camera], (48, 36)), 0).rgb))
    (tmp_path / "x.ply").write_bytes(session.gaussians())
    again = read_capture(tmp_path / "x.ply").gaussians
    assert torch.equal(again.harmonics, styled.shown.harmonics) and torch.equal(again.means, scene.gaussians.means)
    assert not torch.equal(again.harmonics, scene.gaussians.harmonics)


def test_a_flight_moves_the_browser_s_camera(session: Session, listener: Listener, scene: SplatScene) -> None:
    flown: list[object] = []
    session.films.play(1, plan_of(scene, [Look()] * 2, 0.5), flown.append)
    listener.until(lambda: any(state.playing for state in listener.states) and not session.state.playing)
    assert len(flown) > 2 and listener.frames == [] and session.thumbnail(1) is None


def test_gaussians_on_the_page_have_their_places_and_shapes(scene: SplatScene) -> None:
    transform = page_transform(scene.cameras)
    means, covariances = page_gaussians(scene.gaussians, transform)
    assert torch.allclose(means.double(), transform.to_page(scene.gaussians.means), atol=1e-5)
    lengths, wanted = torch.linalg.eigvalsh(covariances.double()).clamp_min(0).sqrt(), scene.gaussians.log_scales.double().exp()
    assert torch.allclose(lengths, transform.scale * wanted.sort(1).values, rtol=1e-3, atol=1e-5)
