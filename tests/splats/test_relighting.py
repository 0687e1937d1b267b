"""Captures in another light: files, styles and mixes of lights."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from splat_ball import ball
from splat_yard import yard
from tiny_world import World

from fprf.api import FinishedCapture
from fprf.cli import main as cli
from fprf.errors import UsageError
from fprf.io.images import write_image
from fprf.light.config import SunConfig
from fprf.light.relight import LINEAR_OFFSET, SHOULDER, encoded
from fprf.plugins.encoders.config import RandomConfig
from fprf.rendering.cameras import Cameras
from fprf.rendering.north import North, world_axes
from fprf.rendering.paths import look_at, pinhole
from fprf.splats.captures import look_at_capture
from fprf.splats.config import LookConfig
from fprf.splats.drawing import draw
from fprf.splats.files import read_capture, write_gaussians
from fprf.splats.find_light import find_illumination
from fprf.splats.gaussians import Gaussians, joined
from fprf.splats.pinholes import camera_of
from fprf.splats.relighting import facing_north, relit_harmonics
from fprf.splats.scene import SplatScene, illuminated, with_illumination
from fprf.style.config import StyleConfig
from fprf.style.dictionary import save_dictionary
from fprf.style.files import StyleFile, read_style, write_style
from fprf.style.restyle import apply_style
from fprf.training.loading import open_run

SMALL = ["--views", "4", "--size", "64", "48", "--regions", "3"]
NOON = SunConfig(light="noon", sun=(90.0, 40.0))


@pytest.fixture(scope="module")
def scene() -> SplatScene:
    return look_at_capture(
        ball(3000), False, RandomConfig().build(), LookConfig(views=6, size=(96, 72), regions=3)
    )


def lit(scene: SplatScene, config: SunConfig) -> SplatScene:
    style = StyleConfig(**vars(config))
    return scene.restyled(apply_style(scene, StyleFile(style)).restyle)


def test_the_side_towards_the_sun_is_bright_and_the_other_dark(scene: SplatScene) -> None:
    known = scene.illumination
    assert known is not None
    toward = known().sun_direction(90.0, 40.0)
    gain = lit(scene, NOON).light_gain.mean(1)
    facing = torch.nn.functional.normalize(scene.gaussians.means, dim=1) @ toward
    shown = known().surfaces.weights > 1
    assert float(gain[shown & (facing > 0.7)].mean()) > 1.5 * float(gain[shown & (facing < -0.3)].mean())


def test_a_sun_that_nobody_placed_stands_where_most_is_lit(scene: SplatScene) -> None:
    gaussians = scene.gaussians
    # A wall on one side of all that the views show.
    known = find_illumination(gaussians, scene.views, antialiased=False, near=scene.near)
    best = known.azimuth
    wall = known.sun_direction(best, 10.0)
    across = torch.linalg.cross(wall, known.up)
    at = torch.linspace(-3, 3, 40)
    grid = at[:, None, None] * across + (at[None, :, None] + 1.0) * known.up + 3 * wall
    count = 40 * 40
    walled = Gaussians(
        torch.cat([gaussians.means, grid.reshape(-1, 3)]),
        torch.cat([gaussians.quaternions, gaussians.quaternions[:1].expand(count, -1)]),
        torch.cat([gaussians.log_scales, torch.full((count, 3), -2.0)]),
        torch.cat([gaussians.logits, torch.full((count,), 6.0)]),
        torch.cat([gaussians.harmonics, gaussians.harmonics[:1].expand(count, -1, -1)]),
    )
    # The ball alone counts: the wall is seen by nobody.
    blockers = find_illumination(walled, scene.views, antialiased=False, near=scene.near).blockers
    turned = replace(known, blockers=blockers).azimuth
    assert abs((turned - best + 180) % 360 - 180) > 60


def test_a_light_is_exact_on_harmonics_from_every_direction(scene: SplatScene) -> None:
    gaussians = scene.gaussians
    gain = 0.5 + torch.rand(len(gaussians), 3, generator=torch.Generator().manual_seed(0))
    before = gaussians.harmonics.clone()
    before[:, 0] = 0.0  # no colour below 0, which renderers cut
    after = relit_harmonics(before, gain)
    assert torch.allclose(after[:, 1:], before[:, 1:] * gain[:, None], atol=1e-5)


def test_no_strength_is_the_file_bit_for_bit(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "in.ply", ball(300))
    args = [str(tmp_path / "in.ply"), "--sun", "30", "40", *SMALL, "--cache", str(tmp_path / "cache")]
    assert cli.main(["restyle", *args, "--sun-strength", "0", "--output", str(tmp_path / "no.ply")]) == 0
    assert (tmp_path / "no.ply").read_bytes() == (tmp_path / "in.ply").read_bytes()
    capture = FinishedCapture(
        read_capture(tmp_path / "in.ply"), LookConfig(views=4, size=(64, 48), regions=3)
    )
    assert cli.main(["restyle", *args, "--output", str(tmp_path / "lit.ply")]) == 0
    changed = read_capture(tmp_path / "lit.ply").gaussians
    assert torch.equal(changed.means, capture.gaussians.means)
    assert not torch.equal(changed.harmonics, capture.gaussians.harmonics)
    # The style file brings the same light.
    style = read_style(tmp_path / "lit.style.json")
    assert style.style.sun == (30.0, 40.0) and style.style.strength == 1.0
    again = ["restyle", str(tmp_path / "in.ply"), "--style", str(tmp_path / "lit.style.json"), *SMALL]
    assert (
        cli.main([*again, "--cache", str(tmp_path / "cache"), "--output", str(tmp_path / "again.ply")]) == 0
    )
    assert torch.equal(read_capture(tmp_path / "again.ply").gaussians.harmonics, changed.harmonics)
    same = capture.restyled(sun=(30.0, 40.0))
    assert torch.equal(same.gaussians.harmonics, changed.harmonics)


SECOND: dict[str, object] = {
    "light": "moonlight",
    "sun": (-60.0, 20.0),
    "sun_from": "view",
    "sun_elevation": 20.0,
    "sun_over_sky": (2.0, 1.0, 0.5),
    "sun_strength": 0.5,
    "sun_colour": "3000K",
    "sky_colour": "#4080ff",
    "sun_size": 5.0,
    "unlit": True,
}


SOUTH_EAST = -135.0
"""Azimuth of north from the first view's direction, where that is south-east."""


def facing(scene: SplatScene, azimuth: float, southern: bool | None = None) -> SplatScene:
    """The scene, with north so many degrees clockwise from the direction of its first view."""
    assert scene.illumination is not None
    found = scene.illumination()
    x, y, z = found.sun_direction(azimuth, 20.0).tolist()  # its level part counts
    north = North(direction=(x, y, z), source="a compass", southern=southern)
    return replace(scene, north=north, illumination=lambda: facing_north(found, north))


def test_azimuths_count_from_north_where_it_is_known(scene: SplatScene) -> None:
    plain = lit(scene, SunConfig(sun=(-90.0, 35.0)))
    # What is to the left of the first view, which looks south-east, lies north-east.
    turned = facing(scene, SOUTH_EAST)
    assert torch.allclose(lit(turned, SunConfig(sun=(45.0, 35.0))).light_gain, plain.light_gain, atol=1e-4)
    by_view = lit(turned, SunConfig(sun=(-90.0, 35.0), sun_from="view"))
    assert torch.allclose(by_view.light_gain, plain.light_gain, atol=1e-4)
    assert "first view" in plain.light_notes[1] and "a compass" in by_view.light_notes[1]
    assert "first view" in by_view.light_notes[1]
    known = turned.light_found
    assert known.view_azimuth == pytest.approx(-SOUTH_EAST, abs=1e-3)
    assert scene.light_found.view_azimuth == pytest.approx(0, abs=1e-3)
    # A captured sun that was found before stands where it stood.
    sunny = in_the_sun(scene, (60.0, 35.0)).light_found
    sunny = replace(sunny, known_sun=(sunny.captured_sun,))
    assert turned.north is not None
    there = facing_north(sunny, turned.north)
    before = sunny.captured_sun
    after = there.captured_sun
    assert before is not None and after is not None and after.azimuth != before.azimuth
    place = sunny.sun_direction(before.azimuth, before.elevation)
    assert torch.allclose(there.sun_direction(after.azimuth, after.elevation), place, atol=1e-5)


def test_the_sun_stands_in_the_south_at_noon_or_south_of_the_equator_in_the_north(scene: SplatScene) -> None:
    north = facing(scene, 30.0, southern=False).light_found
    south = facing(scene, 30.0, southern=True).light_found
    assert (north.noon, north.clockwise, south.noon, south.clockwise) == (180.0, True, 0.0, False)
    # Where only the direction is known it is the side that lights more.
    unknown = facing(scene, 30.0).light_found
    assert unknown.noon in (0.0, 180.0) and unknown.clockwise == (unknown.noon == 180.0)
    assert scene.light_found.noon == scene.light_found.azimuth and scene.light_found.clockwise
    # A direction that points up is none.
    x, y, z = scene.light_found.up.tolist()
    above = North(direction=(x, y, z), source="a wrong compass")
    assert facing_north(scene.light_found, above).north is None
    notes = lit(replace(scene, north=above), SunConfig(sun=(-90.0, 35.0))).light_notes
    assert "not level: a wrong compass" in notes[1] and "first view" in notes[2]


def in_the_sun(scene: SplatScene, sun: tuple[float, float]) -> SplatScene:
    """The scene as if it had been captured in the sun."""
    lit_by = scene.restyled(apply_style(scene, StyleFile(StyleConfig(sun=sun))).restyle)
    return with_illumination(replace(scene, gaussians=lit_by.shown, look=None, illumination=None))


def test_a_captured_sun_is_found_and_taken_away(scene: SplatScene) -> None:
    sunny = in_the_sun(scene, (60.0, 35.0))
    assert sunny.illumination is not None and scene.illumination is not None
    known = sunny.illumination()
    found = known.captured_sun
    assert found is not None
    apart = known.sun_direction(found.azimuth, found.elevation) @ known.sun_direction(60.0, 35.0)
    assert float(apart) > 0.9
    assert scene.illumination().captured_sun is None
    # Without its sun it is nearer to what it was.
    shown = known.surfaces.weights > 1
    factor = LINEAR_OFFSET + scene.gaussians.colours[shown]
    apart_before = ((LINEAR_OFFSET + sunny.gaussians.colours[shown]) / factor).log()
    unlit = sunny.restyled(apply_style(sunny, StyleFile(StyleConfig(unlit=True))).restyle)
    apart_after = ((LINEAR_OFFSET + unlit.shown.colours[shown]) / factor).log()
    assert float(apart_after.std()) < 0.7 * float(apart_before.std())
    assert "taken away" in unlit.light_notes[0]
    other = scene.restyled(apply_style(scene, StyleFile(StyleConfig(unlit=True))).restyle)
    assert torch.equal(other.light_gain, torch.ones_like(other.light_gain))
    assert "clouds or shade" in other.light_notes[0]


@pytest.mark.parametrize("name", SECOND)
def test_a_second_value_changes_the_light(scene: SplatScene, name: str) -> None:
    if name == "unlit":
        scene = in_the_sun(scene, (60.0, 35.0))
    assert SECOND.keys() == vars(SunConfig()).keys()
    noon = NOON
    if name == "sun_elevation":
        noon = SunConfig(light="noon")
    if name == "sun_from":
        scene = facing(scene, SOUTH_EAST)
    other = replace(noon, **{name: SECOND[name]})  # type: ignore[arg-type]
    assert float((lit(scene, other).light_gain - lit(scene, noon).light_gain).abs().max()) > 1e-3


def shaded_strips(path: Path, strength: tuple[float, float, float]) -> Path:
    """A photograph of four materials side by side, lit but for a shadow across them."""
    colours = torch.tensor([[0.10, 0.11, 0.12], [0.12, 0.20, 0.06], [0.25, 0.10, 0.07], [0.22, 0.20, 0.15]])
    light = torch.ones(180, 1, 3) + torch.tensor(strength)
    light[60:110] = 1.0
    light = light * colours.repeat_interleave(60, 0)
    write_image(path, encoded(light / (1 + SHOULDER * light)).clamp(0, 1).mul(255).round().byte().numpy())
    return path


def test_the_sun_of_references_falls_on_the_scene(scene: SplatScene, tmp_path: Path) -> None:
    sunny = shaded_strips(tmp_path / "sunny.png", (3.0, 2.2, 1.3))
    even = shaded_strips(tmp_path / "even.png", (0.0, 0.0, 0.0))
    style = StyleConfig(references=(even, sunny), sun="auto")
    found = apply_style(scene, StyleFile(style))
    light = found.restyle.sun
    assert light is not None and light.sun_over_sky is not None
    assert light.sun_over_sky[0] > light.sun_over_sky[1] > light.sun_over_sky[2] > 1.0
    assert any("sunny.png" in note for note in found.controls.notes)
    lit_by = scene.restyled(found.restyle)
    assert float(lit_by.light_gain.std()) > 0.05
    # Nothing else is in a style file than the word.
    write_style(tmp_path / "style.json", StyleFile(style))
    assert read_style(tmp_path / "style.json").style.sun == "auto"
    # What does not tell changes nothing.
    untold = apply_style(scene, StyleFile(replace(style, references=(even,))))
    assert untold.restyle.sun is None
    assert any("stays as captured" in note for note in untold.controls.notes)
    with pytest.raises(UsageError, match="name at least one"):
        apply_style(scene, StyleFile(StyleConfig(sun="auto")))


def test_lights_fade_into_each_other(scene: SplatScene) -> None:
    first = apply_style(scene, StyleFile(StyleConfig(light="noon"))).restyle
    second = apply_style(scene, StyleFile(StyleConfig(light="moonlight"))).restyle
    gains = [scene.restyled(look).light_gain for look in (first, second, first.mixed(second, 0.25))]
    assert torch.allclose(gains[2], torch.lerp(gains[0], gains[1], 0.25), atol=1e-5)
    half = scene.restyled(first.faded.mixed(first, 0.5)).light_gain
    assert torch.allclose(half, (1 + gains[0]) / 2, atol=1e-5)
    assert first.faded.idle and not first.idle


def test_a_light_comes_over_the_colours_of_photographs(scene: SplatScene, photograph: Path) -> None:
    photographs = StyleConfig(references=(photograph,))
    plain = scene.restyled(apply_style(scene, StyleFile(photographs)).restyle).shown
    both = scene.restyled(apply_style(scene, StyleFile(replace(photographs, light="noon"))).restyle)
    wanted = relit_harmonics(plain.harmonics, both.light_gain)
    assert torch.allclose(both.shown.harmonics, wanted, atol=1e-5)


def test_a_style_file_keeps_lights(tmp_path: Path) -> None:
    style = StyleConfig(
        light="golden-hour", sun=(10.0, 12.0), sun_colour="3000K", sun_size=2.0, sun_strength=0.5
    )
    write_style(tmp_path / "style.json", StyleFile(style))
    assert read_style(tmp_path / "style.json").style == style


def test_up_and_ahead_are_those_of_level_cameras() -> None:
    up = torch.nn.functional.normalize(torch.tensor([0.2, -0.9, 0.3]).double(), dim=0)
    draw_ = torch.Generator().manual_seed(0)
    eye = torch.randn(9, 3, generator=draw_).double()
    cameras: Cameras = pinhole(look_at(eye, 0.1 * eye.flip(0), up), width=32, height=24, fov=60)
    found, ahead = world_axes(cameras)
    assert float(found.double() @ up) > 0.999
    view = -cameras.pose[0, :, 2].double()
    level = torch.nn.functional.normalize(view - (view @ up) * up, dim=0)
    assert float(ahead.double() @ level) > 0.99
    # Seen from above, the top of the picture is ahead.
    flat = torch.cat([torch.randn(9, 2, generator=draw_), torch.full((9, 1), 5.0)], 1).double()
    poses = torch.zeros(9, 3, 4).double()
    turn = torch.randn(9, generator=draw_).double()
    poses[:, 0, 0] = poses[:, 1, 1] = turn.cos()
    poses[:, 1, 0] = turn.sin()
    poses[:, 0, 1] = -turn.sin()
    poses[:, 2, 2] = 1.0
    poses[:, :, 3] = flat
    found, ahead = world_axes(replace(cameras, pose=poses))
    assert float(found[2]) > 0.99 and float(ahead.double() @ poses[0, :, 1]) > 0.99


def test_a_capture_looks_alike_after_its_file_was_read_again(tmp_path: Path, scene: SplatScene) -> None:
    shown: Gaussians = lit(scene, NOON).shown
    write_gaussians(tmp_path / "lit.ply", shown)
    read = read_capture(tmp_path / "lit.ply").gaussians
    camera = camera_of(scene.views, 0)
    assert torch.allclose(draw(read, camera).image, draw(shown, camera).image, atol=1e-5)


def test_fields_are_told_to_become_gaussians(world: World) -> None:
    with pytest.raises(UsageError, match="fprf export"):
        apply_style(open_run(world.run, device="cpu").scene, StyleFile(StyleConfig(light="noon")))


def test_a_light_alone_has_a_dictionary_that_can_be_kept(scene: SplatScene, tmp_path: Path) -> None:
    styled = apply_style(scene, StyleFile(StyleConfig(light="noon")))
    save_dictionary(tmp_path / "dictionary.safetensors", styled.dictionary)
    assert (tmp_path / "dictionary.safetensors").stat().st_size > 0


@pytest.mark.parametrize("count", [1, 2, 30])
@pytest.mark.parametrize("logit", [-2.0, 3.0])
def test_small_and_faint_captures_are_lit_without_a_fault(count: int, logit: float) -> None:
    made = replace(ball(count), logits=torch.full((count,), logit))
    small = look_at_capture(
        made, False, RandomConfig().build(), LookConfig(views=3, size=(48, 36), regions=1)
    )
    for name in ("noon", "overcast"):
        gain = illuminated(small).gain(SunConfig(light=name))
        assert bool(gain.isfinite().all()) and float(gain.min()) > 0


def test_a_capture_far_from_the_origin_is_lit_alike() -> None:
    made = ball(2000)
    far = replace(made, means=made.means + torch.tensor([4000.0, -3000.0, 2000.0]))
    gains = []
    for each in (made, far):
        views = look_at_capture(
            each, False, RandomConfig().build(), LookConfig(views=6, size=(96, 72), regions=2)
        )
        gains.append(lit(views, NOON).light_gain)
    apart = (gains[0] - gains[1]).abs().mean(1)
    # Float32 tells places to a two-thousandth there, a tenth of what takes no light away.
    assert float(apart.median()) < 0.02 and float(apart.quantile(0.9)) < 0.2


def test_what_was_found_about_light_is_kept(scene: SplatScene, tmp_path: Path) -> None:
    sunny = in_the_sun(scene, (60.0, 35.0))
    first = with_illumination(sunny, tmp_path)
    found = first.light_found
    (file,) = tmp_path.iterdir()
    again = with_illumination(sunny, tmp_path).light_found
    assert again.known_sun and found.captured_sun is not None and again.captured_sun is not None
    assert again.captured_sun.azimuth == pytest.approx(found.captured_sun.azimuth, abs=1e-4)
    for config in (NOON, SunConfig(unlit=True)):
        assert torch.equal(again.gain(config), found.gain(config))
    # Other Gaussians, and a damaged file, are looked at again.
    assert with_illumination(scene, tmp_path).light_found.captured_sun is None
    file.write_bytes(b"torn")
    assert torch.equal(with_illumination(sunny, tmp_path).light_found.gain(NOON), found.gain(NOON))


def around_the_yard(away: float = 4.0) -> Cameras:
    """Level views of the yard from eight places, as high as its house."""
    turn = torch.arange(8).double() * (math.pi / 4)
    eye = torch.stack([away * turn.cos(), away * turn.sin(), torch.full((8,), 1.2).double()], 1)
    up = torch.tensor([0.0, 0.0, 1.0]).double()
    middle = torch.tensor([[0.0, 0.0, 0.9]]).double().expand(8, 3)
    return pinhole(look_at(eye, middle, up), width=96, height=72, fov=60)


def test_a_sky_of_most_gaussians_casts_no_shadows() -> None:
    made = yard(2000)
    draw_ = torch.Generator().manual_seed(0)
    way = torch.nn.functional.normalize(torch.randn(3000, 3, generator=draw_), dim=1)
    way[:, 2] = way[:, 2].abs()
    dome = Gaussians(
        60 * way,
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(3000, 1),
        torch.full((3000, 3), math.log(2.0)),
        torch.full((3000,), 4.0),
        torch.full((3000, 1, 3), 1.0),
    )
    known = find_illumination(joined([made, dome]), around_the_yard(), antialiased=False, near=0.05)
    alone = find_illumination(made, around_the_yard(), antialiased=False, near=0.05)
    high = way[:, 2] > 0.2
    assert bool(known.sky[2000:][high].all()) and not bool(known.sky[:1000].any())
    sun = known.sun_direction(30.0, 40.0)
    assert float((known.reach(sun)[:2000] - alone.reach(sun)).abs().mean()) < 0.05
    assert float(known.openness[:1000].mean()) > 0.5


def test_a_facade_over_a_few_floaters_is_no_sky() -> None:
    made = yard(2000)
    draw_ = torch.Generator().manual_seed(0)
    facade = 2 + 30 * torch.rand(2000, 3, generator=draw_)
    facade[:, 1] = 10.0
    facade[:5] = 0.1 * torch.rand(5, 3, generator=draw_)
    eye = torch.tensor([[14.0, 0.0, 1.6], [20.0, 0.0, 1.6]]).double()
    views = look_at(
        eye, torch.tensor([[17.0, 10.0, 12.0]]).double().expand(2, 3), torch.tensor([0.0, 0.0, 1.0]).double()
    )
    cameras = pinhole(views, width=64, height=48, fov=80)
    known = find_illumination(replace(made, means=facade), cameras, antialiased=False, near=0.05)
    assert not bool(known.sky.any()) and not bool(known.far[5:].any())


def test_shadows_fall_on_ground_that_a_training_left_too_deep() -> None:
    made = yard(4000)
    cameras = around_the_yard().select(torch.tensor([0]))
    eye = cameras.pose[0, :, 3].float()
    ground = torch.arange(4000) < 2000
    deep = ground & (torch.arange(4000) % 9 == 0)
    # As one view sees it nothing changes: nine times as far away, and nine times as wide.
    pushed = replace(
        made,
        means=torch.where(deep[:, None], eye + 9 * (made.means - eye), made.means),
        log_scales=torch.where(deep[:, None], made.log_scales + math.log(9.0), made.log_scales),
    )
    known = find_illumination(pushed, cameras, antialiased=False, near=0.05)
    before = find_illumination(made, cameras, antialiased=False, near=0.05)
    shown = deep & (before.surfaces.weights > 1)
    assert float(known.far[shown].float().mean()) > 0.8
    for azimuth in (60.0, -60.0):
        sun = known.sun_direction(azimuth, 30.0)
        wanted = before.reach(sun)[shown]
        assert 0.05 < float((wanted < 0.5).float().mean()) < 0.95
        assert float((known.reach(sun)[shown] - wanted).abs().mean()) < 0.15
