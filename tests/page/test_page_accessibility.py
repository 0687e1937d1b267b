"""The start page, a scene and a file by axe: WCAG 2.2 A and AA, in both themes. Skipped where playwright, a Chromium
or axe (the package `axe-playwright-python`) is not there.
"""

import shutil
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from chromium import chromium
from pages import seen, written
from splat_ball import ball

from fprf.page import EXAMPLES
from fprf.page.access import Access
from fprf.page.server import ViewerServer
from fprf.page.session import Viewed
from fprf.page.start import Start

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
RULES = {
    "runOnly": {
        "type": "tag",
        "values": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"],
    },
    "rules": {"target-size": {"enabled": True}},
}


@pytest.fixture(params=["light", "dark"])
def page(request: pytest.FixtureRequest) -> Iterator[Any]:
    with chromium() as browser:
        context = browser.new_context(
            color_scheme=request.param,
            viewport={"width": 1280, "height": 800},
            reduced_motion="reduce",
            bypass_csp=True,
        )
        yield context.new_page()


def violations(page: Any) -> list[str]:
    """What axe finds, a line each element."""
    package = pytest.importorskip("axe_playwright_python", reason="axe-playwright-python is not installed")
    page.evaluate((Path(package.__file__).parent / "axe.min.js").read_text("utf-8"))
    found = []
    for rule in page.evaluate("(rules) => axe.run(document, rules)", RULES)["violations"]:
        for node in rule["nodes"]:
            summary = " ".join((node["failureSummary"] or "").split())[:200]
            found.append(f"{rule['id']}: {node['html'][:110]}: {summary}")
    return found


def test_the_start_page(page: Any, tmp_path: Path) -> None:
    files = tmp_path / "made" / "yard" / "files"
    files.mkdir(parents=True)
    shutil.copyfile(EXAMPLES["night.jpg"], files / "a.jpg")
    with ExitStack() as stack, ViewerServer(Access("127.0.0.1", None), 0) as server:
        start = Start(tmp_path / "made", server, lambda path, name: pytest.fail("nothing is opened"))
        stack.callback(start.close)
        server.show_start(start)
        page.goto(server.address)
        page.locator("#recent li").wait_for()
        assert violations(page) == []
        page.fill("#minutes", "9999")
        page.keyboard.press("Tab")
        page.locator("#fault").wait_for()
        assert violations(page) == []


def test_a_scene_with_all_that_unfolds(page: Any, tmp_path: Path) -> None:
    with ViewerServer(Access("127.0.0.1", None), 0) as server:
        viewed = Viewed(seen(ball(400, 2)), "ball", 1, tmp_path / "root")
        session = server.open(lambda: viewed, warm=False)
        page.goto(server.address)
        page.wait_for_selector(".place.drawn", timeout=120_000)
        assert violations(page) == []
        for name in ("night.jpg", "sunset.jpg"):
            session.upload(EXAMPLES[name].read_bytes(), name, join=True)
        page.wait_for_function("() => fprf.place.splats.styles.has('Now')", timeout=120_000)
        page.evaluate("() => document.querySelectorAll('details').forEach((each) => { each.open = true; })")
        page.locator("#add-key").click()
        page.fill("#keep-name", "dusk")
        page.locator("#keep button").click()
        page.wait_for_function("() => fprf.place.splats.styles.has('dusk')", timeout=120_000)
        page.mouse.click(450, 400)
        page.wait_for_function("() => fprf.live.state.picked", timeout=120_000)
        page.keyboard.press("?")
        page.evaluate("() => { say('something is wrong', true); say('a note'); wait('x', 'working', 0.5); }")
        page.wait_for_timeout(1000)
        assert violations(page) == []
        page.evaluate("() => { at('said').replaceChildren(); question('Really?', { Yes() {} }); }")
        assert violations(page) == []


def test_a_file(page: Any, tmp_path: Path) -> None:
    page.goto(written(tmp_path / "page.html", seen(ball(500))).as_uri())
    page.wait_for_selector(".place.ready", timeout=120_000)
    assert violations(page) == []


def light_of_a_file(page: Any, tmp_path: Path) -> None:
    """Open a file, and the light in it."""
    page.goto(written(tmp_path / "page.html", seen(ball(500)), suns=4).as_uri())
    page.wait_for_selector(".place.ready", timeout=120_000)
    page.keyboard.press("l")
    page.locator("#dome").wait_for()


def light_of_a_server(page: Any, address: str) -> None:
    """Open a scene, and the light in it."""
    page.goto(address)
    page.wait_for_selector(".place.drawn", timeout=120_000)
    page.locator("#light").click()
    page.wait_for_function("() => fprf.live.sun.panel", timeout=120_000)


def test_the_light_of_a_file(page: Any, tmp_path: Path) -> None:
    light_of_a_file(page, tmp_path)
    assert violations(page) == []
    assert page.evaluate("() => at('lighting').scrollWidth <= at('lighting').clientWidth")
    page.get_by_role("button", name="Golden hour").click()
    page.set_viewport_size({"width": 400, "height": 800})
    page.wait_for_timeout(500)
    assert violations(page) == []


def test_the_light_of_a_scene(page: Any) -> None:
    with ViewerServer(Access("127.0.0.1", None), 0) as server:
        server.open(lambda: Viewed(seen(ball(300)), "ball", 1), warm=False)
        light_of_a_server(page, server.address)
        assert violations(page) == []
        page.locator("#sun").focus()
        page.keyboard.press("ArrowUp")
        page.wait_for_function("() => fprf.live.state.sun.sun", timeout=120_000)
        page.set_viewport_size({"width": 400, "height": 800})
        page.wait_for_timeout(500)
        assert violations(page) == []


def test_escape_leads_from_a_panel_to_the_button_that_opened_it(page: Any, tmp_path: Path) -> None:
    light_of_a_file(page, tmp_path)
    focused = "() => document.activeElement.id"
    for button, field in (("light", "sun"), ("see", "angle"), ("send", "link")):
        if page.locator(f"#{field}").is_hidden():
            page.locator(f"#{button}").press("Enter")
        page.locator(f"#{field}").focus()
        page.keyboard.press("Escape")
        assert page.locator(f"#{field}").is_hidden() and page.evaluate(focused) == button


STOPS = """() => {
  const all = [...document.querySelectorAll("a[href], button, input, select, textarea, summary, [tabindex]")];
  window.stops = all.filter((each) => !each.disabled && each.tabIndex >= 0 && each.type !== "file"
    && each.checkVisibility({ visibilityProperty: true, opacityProperty: false }) && each.getClientRects().length);
  window.stops[0].focus();
  return window.stops.map((each) => each.id || each.className || each.textContent.trim() || each.tagName);
}"""
REACHED = """() => {
  const each = document.activeElement, box = each.getBoundingClientRect();
  const seen = [[0.5, 0.5], [0.25, 0.25], [0.75, 0.75]].some(([x, y]) => {
    const top = document.elementFromPoint(box.x + x * box.width, box.y + y * box.height);
    return top && (each.contains(top) || top.contains(each) || top.closest("label"));
  });
  return { stop: window.stops.indexOf(each), seen };
}"""


def focus_order(page: Any) -> None:
    """Tab goes once through all that can be focused, in the order of the document, and each is seen then."""
    assert page.locator("[tabindex]:not([tabindex='0']):not([tabindex='-1'])").count() == 0
    names = page.evaluate(STOPS)
    assert len(names) > 4
    reached = [page.evaluate(REACHED)]
    while len(reached) < len(names):
        page.keyboard.press("Tab")
        reached.append(page.evaluate(REACHED))
    assert [names[each["stop"]] if each["stop"] >= 0 else "?" for each in reached] == names
    assert [name for name, each in zip(names, reached, strict=True) if not each["seen"]] == []


def test_the_focus_goes_through_a_file_in_order(page: Any, tmp_path: Path) -> None:
    page.goto(written(tmp_path / "page.html", seen(ball(300))).as_uri())
    page.wait_for_selector(".place.ready", timeout=120_000)
    focus_order(page)


def test_the_focus_goes_through_the_light_in_order(page: Any, tmp_path: Path) -> None:
    light_of_a_file(page, tmp_path)
    focus_order(page)


def test_the_focus_goes_through_the_start_page_in_order(page: Any, tmp_path: Path) -> None:
    with ExitStack() as stack, ViewerServer(Access("127.0.0.1", None), 0) as server:
        start = Start(tmp_path / "made", server, lambda path, name: pytest.fail("nothing is opened"))
        stack.callback(start.close)
        server.show_start(start)
        page.goto(server.address)
        page.locator("#choose").wait_for()
        focus_order(page)


def test_the_focus_goes_through_a_scene_in_order(page: Any) -> None:
    with ViewerServer(Access("127.0.0.1", None), 0) as server:
        server.open(lambda: Viewed(seen(ball(300)), "ball", 1), warm=False)
        page.goto(server.address)
        page.wait_for_selector(".place.drawn", timeout=120_000)
        focus_order(page)
