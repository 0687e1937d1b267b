"""A tour of the viewer in a headless Chromium, with real drops, drags and clicks, as a film and as pictures.

    python -m benchmarks viewer_tour RUN --references autumn.png winter.png night.png [--output docs/images]

RUN is a trained run, by preference one of `town`. Writes
viewer-tour.mp4 and viewer-style.png, viewer-wipe.png, viewer-region.png, viewer-matches.png, viewer-flight.png. Needs the
extras `viewer` and `video`, playwright and a Chromium. The film shows one picture of the page after the other: its clock is
not that of the machine; benchmarks/viewer_speed.py measures times.
"""

import base64
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from .common import ROOT, arguments

sys.path.insert(0, str(ROOT / "tests" / "viewer"))

from browser import Front, front, served

from fprf.io.images import Picture, write_image
from fprf.io.video import write_video

WIDTH, HEIGHT = 1280, 720
FILM = (960, 540)
FPS = 10
FLIGHT = (13, 16, 19)
"""Captured cameras that the flight goes by."""
OVERLAY = """() => {
  const make = (style) => {
    const node = document.createElement("div");
    node.style.cssText = `position:fixed;pointer-events:none;${style}`;
    document.body.append(node);
    return node;
  };
  window.tourWords = make("left:410px;bottom:26px;max-width:510px;z-index:9000;padding:9px 18px;border-radius:12px;" +
    "background:rgba(10,12,16,.8);color:#fff;font:600 17px system-ui;opacity:0");
  const hand = make("left:0;top:0;width:22px;height:22px;margin:-3px;z-index:9001");
  hand.innerHTML = '<svg viewBox="0 0 22 22"><path fill="#fff" stroke="#000" ' +
    'd="M3 2 L3 17 L7.5 13.5 L10.5 20 L13 19 L10 12.5 L16 12.5 Z"/></svg>';
  const follow = (event) => { hand.style.transform = `translate(${event.clientX}px, ${event.clientY}px)`; };
  for (const kind of ["mousemove", "pointermove", "dragover"]) window.addEventListener(kind, follow, true);
}"""
DRAG = """async ([data, name, kind, x, y]) => {
  window.tourFile ??= {};
  if (!window.tourFile[name]) {
    const bytes = Uint8Array.from(atob(data), (c) => c.charCodeAt(0));
    window.tourFile[name] = new DataTransfer();
    window.tourFile[name].items.add(new File([bytes], name, { type: "image/png" }));
  }
  document.querySelector("canvas").dispatchEvent(new DragEvent(kind,
    { dataTransfer: window.tourFile[name], bubbles: true, cancelable: true, clientX: x, clientY: y }));
}"""
PRESS = "(text) => [...document.querySelectorAll('button')].find((each) => each.textContent.trim() === text).click()"


class Tour:
    """What was seen so far."""

    def __init__(self, found: Front, output: Path) -> None:
        self.front, self.page, self.output = found, found.page, output
        self.frames: list[Picture] = []
        self.at = (640.0, 400.0)
        self.page.evaluate(OVERLAY)

    def shot(self, hold: int = 1) -> Picture:
        """The page now, for so many frames."""
        data = np.frombuffer(self.page.screenshot(type="jpeg", quality=95), np.uint8)
        picture = np.asarray(cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB), np.uint8)
        self.frames += [np.asarray(cv2.resize(picture, FILM, interpolation=cv2.INTER_AREA), np.uint8)] * hold
        return picture

    def settle(self, hold: int = 12, most: int = 8) -> None:
        """Pictures as they grow sharper, then the last for a while."""
        seen = -1
        for _ in range(most):
            if len(self.front.pictures) > seen:
                seen = len(self.front.pictures)
                self.shot()
            self.page.wait_for_timeout(150)
        self.front.rest(1.5)
        self.page.wait_for_timeout(300)
        self.shot(hold)

    def say(self, text: str) -> None:
        """A line over the page; none where it is empty."""
        self.page.evaluate("(text) => { tourWords.textContent = text; tourWords.style.opacity = text ? 1 : 0; }", text)

    def save(self, name: str) -> None:
        """The page as a picture in the documents, without words."""
        self.say("")
        write_image(self.output / f"viewer-{name}.png", cv2.resize(self.shot(0), FILM, interpolation=cv2.INTER_AREA))

    def point(self, x: float, y: float, steps: int = 5, *, shown: bool = True) -> None:
        """Move the mouse there."""
        (x0, y0), self.at = self.at, (x, y)
        for step in range(1, steps + 1):
            self.page.mouse.move(x0 + (x - x0) * step / steps, y0 + (y - y0) * step / steps)
            if shown:
                self.page.wait_for_timeout(60)
                self.shot()

    def click(self, where: Any, **options: Any) -> None:
        """Point at something and click it."""
        box = where.bounding_box()
        self.point(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2, 4)
        where.click(force=True, **options)

    def drag(self, x: float, y: float, steps: int = 8) -> None:
        """With the button down from here to there."""
        self.page.mouse.down()
        self.point(x, y, steps)
        self.page.mouse.up()

    def drop(self, path: Path) -> None:
        """A photograph, held over the page before it is let go."""
        data, count = base64.b64encode(path.read_bytes()).decode(), len(self.front.state()["shelf"])
        for kind, hold in (("dragenter", 2), ("dragover", 8), ("drop", 1)):
            self.page.evaluate(DRAG, [data, path.name, kind, *self.at])
            self.page.wait_for_timeout(120)
            self.shot(hold)
        self.front.until(lambda state: len(state["shelf"]) == count + 1)
        self.settle()

    def fly_to(self, view: int, hold: int = 6) -> None:
        """To a captured camera, by the panel's number."""
        number = self.page.locator("input.mantine-NumberInput-input:visible").nth(7)
        self.click(number)
        number.fill(str(view))
        number.press("Enter")
        self.page.wait_for_timeout(300)
        self.settle(hold)

    def key(self, wanted: int) -> None:
        """Add a key to the flight."""
        if wanted == 1:
            self.page.evaluate(PRESS, "Add a key here")
        else:
            self.click(self.page.locator("#fprf-flight .acts button").nth(0))
        self.front.until(lambda state: len(state["keys"]) == wanted)
        self.page.wait_for_timeout(400)
        self.shot(5)


def take(tour: Tour, references: list[Path]) -> None:
    page, found = tour.page, tour.front
    box = page.locator("input[type=checkbox]:visible")
    maps = page.locator("input[role=combobox], input.mantine-Select-input").nth(2)
    tour.say("A captured town, as it was trained")
    tour.settle(10)
    tour.say("Drag to turn, W A S D to fly: coarse while it moves, sharp at rest")
    tour.point(500, 420)
    tour.drag(590, 425, 10)
    tour.settle(4)
    for _ in range(3):
        page.keyboard.press("w", delay=40)
        tour.shot()
    tour.settle(6)
    tour.say("Or to a captured camera")
    tour.fly_to(16)
    tour.say("Drop a photograph: the scene takes its style")
    tour.drop(references[0])
    tour.save("style")
    tour.say("Another one")
    tour.drop(references[1])
    tour.say("Before and after: drag the line")
    tour.click(box.nth(0))
    found.until(lambda state: state["wipe"] is not None)
    tour.settle(3)
    handle = page.locator("#fprf-wipe").bounding_box()
    tour.point(handle["x"] + 15, 380, 3)
    tour.drag(300, 380)
    tour.drag(620, 380)
    tour.settle(4)
    tour.save("wipe")
    tour.click(box.nth(0))
    tour.say("Several photographs: shift-click mixes them, sliders weigh them")
    tour.drop(references[2])
    for number in (0, 1):
        tour.click(page.locator("#fprf-shelf .fprf-card img").nth(number), modifiers=["Shift"])
        tour.settle(3)
    tour.say("Which photograph each place takes its style from")
    maps.click()
    page.wait_for_timeout(400)
    tour.shot(3)
    page.get_by_role("option", name="matches").click()
    found.until(lambda state: state["map"] == "matches")
    tour.settle(12)
    tour.save("matches")
    maps.click()
    page.get_by_role("option", name="none").click()
    found.until(lambda state: state["map"] == "none")
    tour.say("Pick a region, and choose what it takes")
    tour.click(box.nth(1))
    found.until(lambda state: state["picking"])
    page.wait_for_timeout(1000)
    tour.point(430, 250)
    page.mouse.click(430, 250)
    found.until(lambda state: state["picked"] is not None)
    tour.settle(6)
    tour.click(page.locator("#fprf-region .row").nth(1).get_by_text("only"))
    found.until(lambda state: state["picked"]["orders"] != [])
    tour.settle(8)
    tour.save("region")
    page.locator("#fprf-region .close").click()
    tour.click(box.nth(1))
    tour.settle(6)
    tour.say("A flight: each key is a view with a look")
    for number, view in enumerate(FLIGHT):
        tour.click(page.locator("#fprf-shelf .fprf-card img").nth(number))
        tour.fly_to(view, 3)
        tour.key(number + 1)
    tour.save("flight")
    page.get_by_text("Film", exact=True).click()
    page.wait_for_timeout(600)
    slow = page.locator("input.mantine-NumberInput-input:visible").nth(8)
    slow.fill("6")  # seconds from key to key: so that the film has some of it
    slow.press("Enter")
    page.get_by_text("Film", exact=True).click()
    page.wait_for_timeout(600)
    tour.say("Play it; ● film makes an mp4 of it")
    tour.click(page.locator("#fprf-flight .acts button").nth(1))
    found.until(lambda state: state["playing"])
    while found.state()["playing"]:
        page.wait_for_timeout(80)
        tour.shot()
    tour.settle(15)


def main(argv: list[str]) -> None:
    parser = arguments("viewer_tour", __doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--references", type=Path, nargs=3, required=True)
    parser.add_argument("--output", type=Path, default=Path("docs/images"))
    args = parser.parse_args(argv)
    with served(args.run, "--pixels", "480") as (address, _), front(address, WIDTH, HEIGHT) as found:
        found.rest(2.0)
        tour = Tour(found, args.output)
        take(tour, args.references)
        if found.errors:
            raise SystemExit(f"the page has faults: {found.errors}")
    write_video(args.output / "viewer-tour.mp4", tour.frames, FPS)
    size = (args.output / "viewer-tour.mp4").stat().st_size
    print(f"{len(tour.frames)} frames, {len(tour.frames) / FPS:.0f} s, {size / 2**20:.1f} MiB")
