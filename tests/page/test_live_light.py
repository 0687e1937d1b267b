"""The sun of a served scene, in a browser. Skipped where playwright or Chromium are not there."""

from pathlib import Path

import numpy as np
import pytest
from splat_ball import ball
from test_light_in_browser import beside
from test_live_page import front, served, state

from fprf.rendering.north import Bearings
from fprf.splats.files import write_gaussians
from fprf.splats.gaussians import GaussianRows

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


def test_the_sun_of_a_server_is_dragged_on_its_dome(tmp_path: Path) -> None:
    rows = ball(2000, 1)
    bearings = Bearings((0.6, 0.0, -0.8), (0.0, -1.0, 0.0))
    write_gaussians(tmp_path / "ball.ply", GaussianRows(2000, rows.select, True, bearings))
    with served(tmp_path / "ball.ply", "--output", str(tmp_path / "made")) as address, front(address) as page:
        before = beside(page)
        page.locator("#light").click()
        page.wait_for_function("() => fprf.live.sun.panel", timeout=120_000)
        dome = page.locator("#dome").bounding_box()
        x = dome["x"] + dome["width"] / 2
        y = dome["y"] + dome["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 0.3 * dome["width"], y, steps=5)
        page.mouse.up()
        # Half way to the rim, to the right of where one looks.
        sun = state(page, "state.sun.sun !== null && state.sun.sun[1] < 33")["sun"]["sun"]
        heading = page.evaluate("() => fprf.live.sun.panel.headed()")
        assert (sun[0] - heading) % 360 == pytest.approx(90, abs=4) and sun[1] == pytest.approx(31, abs=4)
        # A sun that counts from the first view is shown where it stands.
        first = page.evaluate("() => fprf.live.sun.first")
        old = {"light": None, "sun": [10.0, 30.0], "from": "view", "strength": 1}
        there = page.evaluate("(sun) => { fprf.live.state.sun = sun; return fprf.live.sun.light; }", old)
        assert abs(first) > 1 and (there["sun"][0] - first) % 360 == pytest.approx(10)
        assert page.locator("#north").text_content() == "N"
        page.wait_for_function("() => fprf.stage.to === 'Now' && fprf.place.splats.lights.has('Now')")
        lit = beside(page)
        assert np.abs(lit - before).mean() > 0.005
        page.keyboard.press("ArrowUp")
        state(page, f"state.sun.sun[1] > {sun[1] + 3}")
        page.locator("#hour").focus()
        page.keyboard.press("End")
        state(page, "state.sun.light === 'blue-hour'")
        page.get_by_role("button", name="Moonlight").click()
        state(page, "state.sun.light === 'moonlight'")
        page.wait_for_function("() => fprf.live.sun.panel.shown.at !== null")
        # Another client, and this one after it came again, see the same.
        page.reload()
        page.wait_for_function(
            "() => window.fprf?.live.state?.sun.light === 'moonlight' && fprf.place.splats.lights.has('Now')",
            timeout=120_000,
        )
        page.locator("#undo").click()
        state(page, "state.sun.light === null && state.sun.sun === null")
        page.wait_for_function("() => !fprf.place.splats.lights.has('Now')")
