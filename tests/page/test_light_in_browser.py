"""The light of a page in a headless Chromium. Skipped where playwright or Chromium are not there."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from chromium import chromium
from pages import seen, street, written
from splat_ball import ball
from test_page_in_browser import drawn, inside, opened, pixels, psnr, rasterised

from fprf.light.day import day as hours_of
from fprf.page.pack import pack
from fprf.page.suns import packed_day
from fprf.rendering.north import North
from fprf.splats.relighting import relit_harmonics
from fprf.splats.scene import with_illumination

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
SUNS = 5
GAINS = """async (hour) => {
  fprf.stage.light.set({ name: "", hour });
  while (fprf.stage.light.waiting) await new Promise((done) => setTimeout(done, 20));
  return [...fprf.place.splats.lights.get("Captured").gains];
}"""

LIT = "() => !fprf.stage.light.waiting"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


@pytest.mark.parametrize("kind", ["ball", "street"])
def test_a_sun_draws_what_the_rasteriser_draws(browser: Any, tmp_path: Path, kind: str) -> None:
    scene = seen({"ball": ball(3000, 1), "street": street(2000)}[kind])
    scene = inside(scene) if kind == "street" else scene
    known = scene.light_found
    day = packed_day(known, SUNS)
    page = opened(browser, written(tmp_path / "page.html", scene, suns=SUNS))
    order = pack(scene.gaussians).order
    for light in (day.day[2], day.day[-1]):
        hour = light.head["hour"]
        found = torch.tensor(page.evaluate(GAINS, hour)).view(-1, 4)[:, :3]
        config = next(each.config for each in hours_of(SUNS, known.azimuth) if each.hour == hour)
        gain = known.gain(config)
        assert float((found - gain[order]).abs().mean()) < 0.02
        lit = rasterised(scene, 2, relit_harmonics(scene.gaussians.harmonics, gain))
        assert psnr(drawn(page, scene, 2, {"first": "Captured", "blend": 0}), lit) > 36
    # Half way between two suns falls half of the light of each.
    hour = (day.day[2].head["hour"] + day.day[3].head["hour"]) / 2
    between = torch.tensor(page.evaluate(GAINS, hour)).view(-1, 4)[:, :3]
    ends = [
        torch.tensor(page.evaluate(GAINS, light.head["hour"])).view(-1, 4)[:, :3] for light in day.day[2:4]
    ]
    least = torch.minimum(*ends)
    most = torch.maximum(*ends)
    assert bool(((between > least - 1e-4) & (between < most + 1e-4)).all())
    page.evaluate("() => fprf.stage.light.choose('captured')")
    page.wait_for_function(LIT)
    plain = rasterised(scene, 2, scene.gaussians.harmonics)
    assert psnr(drawn(page, scene, 2, {"first": "Captured", "blend": 0}), plain) > 38
    assert page.errors == []
    page.close()


@pytest.fixture
def page(browser: Any, tmp_path: Path) -> Iterator[Any]:
    path = written(tmp_path / "page.html", seen(ball(2000, 1)), suns=SUNS)
    found = opened(browser, path, 1000, 700)
    found.keyboard.press("0")
    found.keyboard.press("l")
    yield found
    assert found.errors == []
    found.close()


def beside(page: Any) -> np.ndarray:
    """What is seen of the scene beside the panel."""
    return pixels(page)[100:380, 60:400]


def shown(page: Any) -> Any:
    page.wait_for_function(LIT)
    return page.evaluate("() => fprf.stage.light.panel.shown")


def test_the_sun_is_dragged_and_moved_by_keys(page: Any) -> None:
    before = beside(page)
    assert shown(page)["name"] == "captured" and page.locator("#north").text_content() == ""
    dome = page.locator("#dome").bounding_box()
    x = dome["x"] + dome["width"] / 2
    y = dome["y"] + dome["height"] / 2
    # To where the sun stands in the morning.
    spot = page.evaluate("() => fprf.stage.light.panel.spot(sunAt(fprf.stage.light.head.day, 8))")
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + spot[0] / 200 * dome["width"], y + spot[1] / 200 * dome["height"], steps=4)
    page.mouse.up()
    morning = shown(page)
    assert morning["name"] == "" and morning["hour"] == pytest.approx(8, abs=0.3)
    assert np.abs(beside(page) - before).mean() > 0.005
    sun = page.locator("#sun")
    assert sun.evaluate("node => node === document.activeElement")
    words = sun.get_attribute("aria-valuetext")
    page.keyboard.press("ArrowRight")
    assert shown(page)["hour"] == pytest.approx(morning["hour"] + 0.25)
    assert sun.get_attribute("aria-valuetext") != words
    page.locator("#hour").focus()
    page.locator("#hour").fill("16")
    assert shown(page)["hour"] == 16 and page.locator("#hour").get_attribute("aria-valuetext") == "16:00"
    # What is seen is sent.
    link = page.evaluate("() => fprf.stage.sending.hash")
    assert "l=16.00" in link
    page.get_by_role("button", name="As captured").click()
    assert np.abs(beside(page) - before).max() < 2 / 255
    page.evaluate("(link) => { location.hash = link; }", link)
    assert shown(page)["hour"] == 16


def test_north_is_marked_on_the_dome_and_noon_is_in_the_south(browser: Any, tmp_path: Path) -> None:
    scene = seen(ball(2000, 1))
    north = North(direction=(0.6, 0.0, -0.8), source="a compass", southern=False)
    scene = with_illumination(replace(scene, north=north))
    page = opened(browser, written(tmp_path / "page.html", scene, suns=SUNS), 1000, 700)
    page.keyboard.press("l")
    page.wait_for_function("() => document.getElementById('north').textContent === 'N'")
    dome = page.locator("#dome").bounding_box()
    letter = page.locator("#north").bounding_box()
    x = letter["x"] + letter["width"] / 2 - dome["x"] - dome["width"] / 2
    y = letter["y"] + letter["height"] / 2 - dome["y"] - dome["height"] / 2
    heading = page.evaluate("() => fprf.stage.light.panel.headed()")
    assert math.hypot(x, y) == pytest.approx(0.4 * dome["width"], abs=4)
    assert (math.degrees(math.atan2(x, -y)) + heading + 180) % 360 - 180 == pytest.approx(0, abs=4)
    # What one looks at lies as far from north as the scene says.
    ahead = torch.tensor(page.evaluate("() => fprf.place.camera.axes[2]"))
    found = scene.light_found
    looked = ahead - torch.dot(ahead, found.up) * found.up
    azimuth = found.degrees_of(torch.nn.functional.normalize(looked, dim=0))[0]
    assert (azimuth - heading + 180) % 360 - 180 == pytest.approx(0, abs=0.5)
    page.get_by_role("button", name="Noon").click()
    assert abs(shown(page)["at"][0]) == pytest.approx(180, abs=0.1)
    assert "from north" in page.locator("#sun").get_attribute("aria-valuetext")
    assert page.errors == []
    page.close()


def test_no_strength_is_the_scene_as_captured(page: Any) -> None:
    before = beside(page)
    page.get_by_role("button", name="Golden hour").click()
    assert np.abs(beside(page) - before).mean() > 0.005
    page.locator("#shine").fill("0")
    assert np.abs(beside(page) - before).max() < 2 / 255


def test_a_style_of_its_own_light_is_left_alone(browser: Any, tmp_path: Path) -> None:
    from pages import page_of

    scene = seen(ball(1500, 1))
    plain = page_of(scene)
    styles = [plain.styles[0]._replace(lit=True), plain.styles[1]]
    page = opened(browser, written(tmp_path / "page.html", scene, suns=SUNS, styles=styles))
    page.evaluate("() => fprf.stage.light.choose('noon')")
    page.wait_for_function(LIT)
    assert page.evaluate("() => [...fprf.place.splats.lights.keys()]") == ["Captured", "plain"]
    assert page.errors == []
    page.close()


def test_a_finger_finds_all_of_it(browser: Any, tmp_path: Path) -> None:
    page = opened(browser, written(tmp_path / "page.html", seen(ball(500)), suns=SUNS), width=400, height=800)
    page.locator("#light").click()
    for node in page.locator("#lighting button, #lighting input").all():
        if node.is_visible():
            box = node.bounding_box()
            assert box["height"] >= 44 and box["x"] >= 0 and box["x"] + box["width"] <= 400
    assert page.errors == []
    page.close()
