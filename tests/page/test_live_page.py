"""The whole viewer: a process, a browser, real drops and clicks. Skipped where playwright or Chromium are not
there.
"""

import base64
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

import cv2
import pytest
import torch
from chromium import chromium
from pages import seen
from splat_ball import ball
from tiny_world import World, flags

from fprf.page.access import Access
from fprf.page.server import ViewerServer
from fprf.page.session import Viewed
from fprf.splats.files import read_capture, write_gaussians
from fprf.splats.gaussians import from_tensors
from fprf.training import checkpoint

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]
DROP = """([data, name]) => {
  const bytes = Uint8Array.from(atob(data), (c) => c.charCodeAt(0)), carried = new DataTransfer();
  carried.items.add(new File([bytes], name, { type: "image/png" }));
  for (const kind of ["dragenter", "dragover", "drop"])
    document.querySelector("canvas").dispatchEvent(
      new DragEvent(kind, { dataTransfer: carried, bubbles: true, cancelable: true }));
}"""


@contextmanager
def served(run: Path | None, *args: str) -> Iterator[str]:
    """`fprf view`, without a run its start page, on a free port: its address."""
    command = [
        sys.executable,
        "-m",
        "fprf",
        "view",
        *([] if run is None else [str(run)]),
        "--port",
        "0",
        *args,
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().strip()
        finally:
            process.send_signal(signal.SIGTERM if run is None else signal.SIGINT)  # either cleans up
            try:
                _, error = process.communicate(timeout=60)
            except subprocess.TimeoutExpired:
                process.kill()
                raise
    assert "Traceback" not in error, error
    assert process.returncode == 130


@contextmanager
def front(
    address: str, ready: str = ".place.drawn", width: int = 1000, height: int = 700, script: str = ""
) -> Iterator[Any]:
    """A page that shows the element `ready`; it makes no error."""
    with chromium() as browser:
        page = browser.new_page(viewport={"width": width, "height": height})
        page.add_init_script(script)
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(address, timeout=120_000)
        page.wait_for_selector(ready, timeout=120_000)
        yield page
        assert errors == []


def state(page: Any, holds: str, limit: float = 90_000) -> Any:
    """The state of the server, as soon as something holds of it."""
    page.wait_for_function(f"() => fprf.live.state && ((state) => {holds})(fprf.live.state)", timeout=limit)
    return page.evaluate("() => fprf.live.state")


def test_a_field_is_restyled_compared_picked_and_filmed(run: Path, world: World) -> None:
    with served(run, "--pixels", "128") as address, front(address) as page:
        data = base64.b64encode(world.references[0].read_bytes()).decode()
        page.evaluate(DROP, [data, "dusk.png"])
        found = state(page, "state.shelf.length === 1")
        assert found["shelf"][0]["name"] == "dusk.png" and found["shelf"][0]["weight"] == 1
        page.locator("#wiping").click()
        page.wait_for_function("() => fprf.live.field.last.captured")
        box = page.locator("#line").bounding_box()
        page.mouse.move(box["x"] + 18, 300)
        page.mouse.down()
        page.mouse.move(200, 300, steps=4)
        page.mouse.up()
        assert page.evaluate("() => fprf.place.wipe") == pytest.approx(
            200 / page.locator("#canvas").bounding_box()["width"], abs=0.02
        )
        page.locator("#wiping").click()
        page.mouse.click(300, 350)
        picked = state(page, "state.picked !== null")["picked"]
        assert sum(row["share"] for row in picked["taken"]) == pytest.approx(1, abs=1e-3)
        page.locator("#region button", has_text="keep as it is").click()
        assert state(page, "state.picked.rules.length === 1")["picked"]["rules"] == [
            {"action": "keep", "card": None}
        ]
        page.locator("#panel summary", has_text="Film").click()
        page.locator("#add-key").click()
        state(page, "state.keys.length === 1")
        page.locator("#make-film").click()
        state(page, "state.film.ready", 240_000)
        link = page.get_by_text("download the film")
        answer = page.request.get(urljoin(page.url, link.get_attribute("href")))
        assert answer.status == 200 and b"ftyp" in answer.body()[:32]


def test_gaussians_take_photographs_looks_are_kept_and_two_pages_agree(world: World, tmp_path: Path) -> None:
    write_gaussians(tmp_path / "ball.ply", ball(500, 1))
    with served(tmp_path / "ball.ply", "--output", str(tmp_path / "out")) as address, front(address) as page:
        page.set_input_files("#photographs", [str(path) for path in world.references])
        page.wait_for_function("() => fprf.place.splats.styles.has('Now')", timeout=120_000)
        state(page, "state.shelf.length === 2")
        other = page.context.browser.new_page()
        other.goto(address)
        other.wait_for_function("() => window.fprf?.place.splats.styles.has('Now')", timeout=60_000)
        page.locator("[data-look=strength]").fill("0.5")
        state(other, "state.look.strength === 0.5")
        page.locator("#panel summary", has_text="Looks").click()
        page.locator("#keep-name").fill("faint")
        page.locator("#keep button").click()
        other.wait_for_function("() => fprf.place.splats.styles.has('faint')", timeout=60_000)
        other.set_viewport_size({"width": 400, "height": 800})
        assert other.evaluate("() => document.documentElement.scrollWidth") == 400
        other.close()
        before = page.evaluate("() => [...fprf.place.splats.colours.get('Now').rows.subarray(0, 400)]")
        page.locator("#panel summary", has_text="More").click()
        page.locator("#map").select_option("regions")
        page.wait_for_function(
            "(b) => fprf.place.splats.colours.get('Now').rows.subarray(0, 400).some((x, i) => x !== b[i])",
            arg=before,
        )
        wrong = tmp_path / "wrong.png"
        wrong.write_bytes(b"not a photograph")
        page.set_input_files("#photographs", str(wrong))
        line = page.locator("#said .bad", has_text="no PNG, JPEG")
        line.wait_for()
        page.wait_for_timeout(8000)
        assert line.is_visible(), "it stays until it is read"
        line.click()
        assert not line.is_visible() and len(state(page, "true")["shelf"]) == 2
        page.locator("#map").select_option("none")
        with page.expect_download(timeout=120_000) as downloaded:
            page.locator("#save-ply").click()
        downloaded.value.save_as(tmp_path / "restyled.ply")
        assert len(read_capture(tmp_path / "restyled.ply").gaussians) == 500


def test_a_page_keeps_up_with_its_server(world: World) -> None:
    viewed = Viewed(seen(ball(400, 2)), "ball", 1)
    with ViewerServer(Access("127.0.0.1", None), 0) as server:
        session = server.open(lambda: viewed, warm=False)
        with front(server.address) as page:
            # A newer state comes while a sort is under way.
            page.evaluate("() => { fprf.place.splats.worker.postMessage = () => {}; fprf.place.touch(); }")
            page.wait_for_function("() => fprf.place.sorting")
            session.reload(replace(viewed, step=1))
            page.wait_for_function(
                "() => fprf.live.scene.step === 1 && fprf.place.splats.kept && !fprf.place.sorting"
            )
            # What is changed here is seen here.
            page.set_input_files("#photographs", str(world.references[0]))
            page.wait_for_function("() => fprf.stage.to === 'Now'", timeout=120_000)
            page.evaluate("() => fprf.stage.choose('Captured')")
            page.locator("[data-look=strength]").fill("0.5")
            page.wait_for_function("() => fprf.stage.to === 'Now'")
            # A page that was away for a moment asks for its view again.
            page.evaluate("() => { fprf.place.touch = (moved = true) => { window.before ||= moved; }; }")
            page.evaluate("() => fprf.live.socket.close()")
            page.wait_for_function("() => window.before")
            # Another scene of the same name and step begins anew.
            server.open(lambda: replace(viewed, step=1), warm=False)
            page.wait_for_function("() => !window.before && window.fprf")


def test_a_double_click_picks_nothing_and_escape_undoes_a_pick(world: World) -> None:
    with ViewerServer(Access("127.0.0.1", None), 0) as server:
        session = server.open(lambda: Viewed(seen(ball(400, 2)), "ball", 1), warm=False)
        session.upload(world.references[0].read_bytes(), "dusk.png")
        with front(server.address) as page:
            state(page, "state.shelf.length === 1")
            box = page.locator("#canvas").bounding_box()
            middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
            page.evaluate(
                """() => {
              const tell = fprf.live.tell.bind(fprf.live);
              window.told = [];
              fprf.live.tell = (type, more) => { told.push(type); tell(type, more); };
            }"""
            )
            page.mouse.dblclick(*middle)
            page.wait_for_timeout(800)
            assert "pick" not in page.evaluate("() => told")
            page.mouse.click(*middle)
            state(page, "state.picked !== null")
            page.keyboard.press("Escape")
            state(page, "state.picked === null")


def test_what_is_made_is_kept_and_a_lost_viewer_is_said(world: World, tmp_path: Path) -> None:
    viewed = Viewed(seen(ball(400, 2)), "ball", 1, tmp_path / "ball")
    access = Access("127.0.0.1", None)
    first = ViewerServer(access, 0)
    first.open(lambda: viewed, warm=False)
    with front(first.address) as page:
        with first:
            page.set_input_files("#photographs", [str(path) for path in world.references])
            found = state(page, "state.shelf.length === 2")
            assert [row["weight"] for row in found["shelf"]] == [1, 1], "several at once are mixed"
            page.locator("#panel summary", has_text="Looks").click()
            page.fill("#keep-name", "dusk")
            page.locator("#keep button").click()
            state(page, "state.kept.length === 1")
            strength = page.locator("[data-look=strength]")
            strength.fill("0.4")
            state(page, "state.look.strength === 0.4")
            # A name that is there is asked about.
            page.locator("#keep button").click()
            page.locator("dialog button", has_text="Cancel").click()
            page.locator("#keep button").click()
            page.locator("dialog button", has_text="Replace it").click()
            page.wait_for_function("() => fprf.live.state.undo")
            page.keyboard.press("Control+z")
            page.keyboard.press("Control+z")
            state(page, "state.look.strength === 1")
            page.keyboard.press("Control+Shift+z")
            state(page, "state.look.strength === 0.4")
            strength.dblclick()
            state(page, "state.look.strength === 1")
            page.locator("#panel summary", has_text="Film").click()
            page.locator("#add-key").click()
            state(page, "state.keys.length === 1")
        page.locator("#said .wait", has_text="Connection lost").wait_for()
        key = page.evaluate("() => fprf.live.scene.key")
        page.locator("#add-key").click()
        page.locator("#said .bad", has_text="That was not done").wait_for()
        page.locator("#save-ply").click()
        page.locator("#said .bad", has_text="the viewer does not answer").wait_for()
        with ViewerServer(access, first.port) as server:
            server.open(lambda: viewed, warm=False)
            page.wait_for_function(
                """(key) => window.fprf && fprf.live.scene.key !== key
                  && fprf.live.state.kept.length && fprf.live.state.shelf.length === 2""",
                arg=key,
                timeout=120_000,
            )
            assert len(page.evaluate("() => fprf.live.state.keys")) == 1
            page.wait_for_function("() => fprf.place.splats.styles.has('dusk')")
            page.locator("#said .wait").wait_for(state="detached")
            page.wait_for_function("() => fprf.stage.styles.some((style) => style.name === 'Now')")
            # What is shown is what is saved.
            page.evaluate("() => fprf.stage.choose('Captured')")
            with page.expect_download(timeout=120_000) as downloaded:
                page.locator("#save-ply").click()
            assert downloaded.value.suggested_filename == "ball-captured.ply"
            downloaded.value.save_as(tmp_path / "captured.ply")
            plain = viewed.scene.gaussians.harmonics  # type: ignore[attr-defined]
            assert torch.allclose(
                read_capture(tmp_path / "captured.ply").gaussians.harmonics, plain, atol=1e-6
            )
            page.select_option("#scale", "2")
            with page.expect_download(timeout=120_000) as downloaded:
                page.locator("#save-picture").click()
            downloaded.value.save_as(tmp_path / "picture.png")
            wide = page.evaluate("() => [fprf.place.canvas.height, fprf.place.canvas.width]")
            assert cv2.imread(str(tmp_path / "picture.png")).shape[:2] == (2 * wide[0], 2 * wide[1])


NO_WEBGL = """const get = HTMLCanvasElement.prototype.getContext; HTMLCanvasElement.prototype.getContext =
  function (kind, ...more) { return kind.startsWith("webgl") ? null : get.call(this, kind, ...more); };"""


def test_without_webgl_the_viewer_draws_and_says_so(world: World) -> None:
    with ViewerServer(Access("127.0.0.1", None), 0) as server:
        session = server.open(lambda: Viewed(seen(ball(400, 2)), "ball", 1), warm=False)
        with front(server.address, script=NO_WEBGL) as page:
            said = page.locator(".why").inner_text()
            assert said.startswith("This browser has no WebGL 2. The machine of the viewer draws")
            read = "() => [...at('canvas').getContext('2d').getImageData(200, 100, 300, 300).data]"
            plain = page.evaluate(read)
            assert max(plain) > 60 and page.locator("#said .bad").count() == 0
            session.upload(world.references[0].read_bytes(), "dusk.png")
            page.wait_for_function("() => fprf.stage.to === 'Now' && !fprf.live.remote.busy")
            page.wait_for_function(
                "(before) => [...at('canvas').getContext('2d').getImageData(200, 100, 300, 300).data]"
                ".some((x, i) => Math.abs(x - before[i]) > 20)",
                arg=plain,
                timeout=60_000,
            )


def test_a_lost_context_is_said_and_a_picture_stands_in() -> None:
    with ViewerServer(Access("127.0.0.1", None), 0) as server:
        server.open(lambda: Viewed(seen(ball(400, 2)), "ball", 1), warm=False)
        with front(server.address) as page:
            page.wait_for_function("() => document.querySelector('.still.one').naturalWidth > 100")
            page.evaluate(
                """() => { window.lose = fprf.place.splats.gl.getExtension('WEBGL_lose_context');
                lose.loseContext(); }"""
            )
            page.locator(".why", has_text="The graphics card has dropped the picture").wait_for()
            assert page.locator(".still.one").is_visible()
            page.mouse.dblclick(300, 300)
            page.locator("#save-picture").click()
            page.locator("#said .bad", has_text="The graphics card").wait_for()
            page.evaluate("() => lose.restoreContext()")
            page.locator(".why").wait_for(state="detached")
            page.wait_for_selector(".place.drawn")


def test_without_javascript_the_page_says_what_it_needs() -> None:
    with ViewerServer(Access("127.0.0.1", None), 0) as server, chromium() as browser:
        page = browser.new_context(java_script_enabled=False).new_page()
        page.goto(server.address)
        assert page.locator("noscript").inner_text().startswith("This page needs JavaScript")
        assert not page.locator("#loading").is_visible()


def test_leaving_during_an_upload_asks_and_another_page_is_told_before_it_sends(tmp_path: Path) -> None:
    shipped = Path(str(files("fprf") / "garden"))
    given = [str(path) for path in sorted((shipped / "images").glob("*"))[:4]]
    with served(None, "--output", str(tmp_path / "made")) as address, front(address, "#drop") as page:
        held: list[Any] = []
        page.route("**/start/piece*", lambda route: held.append(route))
        page.locator("#start h1").click()  # browsers ask only where somebody has done something
        page.set_input_files("#files", given)
        page.locator("#what", has_text="sending").wait_for()
        other = page.context.browser.new_page()
        other.goto(address)
        other.locator("#busy", has_text="is being sent from another page").wait_for()
        other.set_input_files("#files", given)
        other.locator("#fault", has_text="is being sent from another page; wait").wait_for()
        asked: list[str] = []
        page.on("dialog", lambda dialog: (asked.append(dialog.type), dialog.accept()))
        page.evaluate("() => { setTimeout(() => location.assign('about:blank')); }")
        page.wait_for_url("about:blank")
        other.locator("#busy").wait_for(state="hidden", timeout=60_000)
        assert asked == ["beforeunload"] and [*tmp_path.glob("made/*")] == []


def test_a_run_without_a_checkpoint_is_waited_for(run: Path) -> None:
    newest = max((run / "checkpoints").glob("step-*"))
    shutil.move(newest, run / "hidden")
    with served(run) as address, front(address, "#loading") as page:
        page.locator("#said .wait", has_text="no checkpoint yet; it is shown as soon as").wait_for()
        shutil.move(run / "hidden", newest)
        page.wait_for_selector(".place.drawn", timeout=120_000)
        page.locator("#said .wait").wait_for(state="detached")


def test_long_names_full_screen_and_a_comparison_with_oneself(world: World) -> None:
    name = "IMG_20240612_a_very_long_name_without_any_space_" * 2
    with ViewerServer(Access("127.0.0.1", None), 0) as server:
        session = server.open(lambda: Viewed(seen(ball(400, 2)), name, 1), warm=False)
        session.upload(world.references[0].read_bytes(), f"{name}.png")
        with front(server.address) as page:
            page.wait_for_function("() => fprf.place.splats.styles.has('Now')", timeout=60_000)
            page.evaluate("() => fprf.stage.set({ from: 'Captured', to: 'Captured' })")
            page.locator("#wiping").click()
            assert page.evaluate("() => [fprf.stage.from, fprf.stage.to]") == ["Captured", "Now"]
            page.locator("#wiping").click()
            page.mouse.click(300, 300)
            state(page, "state.picked?.taken.length > 0")
            share = page.locator("#region data").first
            assert "%" in share.inner_text() and share.bounding_box()["height"] < 30, "on one line"
            page.set_viewport_size({"width": 400, "height": 800})
            assert page.evaluate("() => document.documentElement.scrollWidth") == 400
            page.set_viewport_size({"width": 1000, "height": 700})
            page.locator("#full").click()
            page.wait_for_function("() => document.fullscreenElement")
            page.evaluate("() => say('something', true)")
            assert page.locator("#said .bad").is_visible()
            inside = "() => document.fullscreenElement.contains(at('said'))"
            page.wait_for_function(inside)


def test_photographs_beyond_what_the_shelf_holds_are_named(world: World, tmp_path: Path) -> None:
    many = []
    for number in range(14):
        many.append(tmp_path / f"photograph-{number}.png")
        shutil.copyfile(world.references[number % 2], many[-1])
    with ViewerServer(Access("127.0.0.1", None), 0) as server:
        server.open(lambda: Viewed(seen(ball(300, 1)), "ball", 1), warm=False)
        with front(server.address) as page:
            page.set_input_files("#photographs", [str(path) for path in many])
            told = page.locator("#said .bad", has_text="14 photographs: the first 12 were taken").inner_text()
            assert told.endswith("Left out: photograph-12.png, photograph-13.png")
            found = state(page, "state.shelf.length === 12", 240_000)
            assert all(row["weight"] == 1 for row in found["shelf"])


def test_photographs_become_a_restyled_ply_without_a_terminal(tmp_path: Path) -> None:
    shipped = Path(str(files("fprf") / "garden"))
    given = tmp_path / "garden"
    shutil.copytree(shipped / "images", given / "images")
    for name in ("transforms.json", "points.npz"):
        shutil.copyfile(shipped / name, given / name)
    (tmp_path / "notes.txt").write_text("no photograph")
    made = tmp_path / "made"
    with served(None, "--output", str(made)) as address, front(address, "#drop", 1280, 800) as page:
        page.set_input_files("#files", str(tmp_path / "notes.txt"))
        page.locator("#fault", has_text="notes.txt: cannot become a scene").wait_for()
        page.set_input_files("#files", str(shipped / "references" / "night.jpg"))
        page.locator("#fault", has_text="1 photograph is no scene").wait_for()
        page.fill("#minutes", "5000")
        page.keyboard.press("Tab")
        page.locator(
            "#fault", has_text="Training takes from 0.1 to 600 minutes; 5000 is none of these"
        ).wait_for()
        page.fill("#minutes", "5")
        page.set_input_files("#folder", str(given))
        page.wait_for_selector(".place.drawn", timeout=240_000)  # of the training, which need not end
        page.wait_for_function("() => fprf.live.scene.step > 0")
        page.locator("#finish").click()
        page.locator("#finish").wait_for(state="hidden", timeout=60_000)
        assert {path.name for path in (made / "garden").iterdir()} == {"files", "run"}
        page.set_input_files("#photographs", str(shipped / "references" / "sunset.jpg"))
        page.wait_for_function("() => fprf.place.splats.styles.has('Now')", timeout=240_000)
        with page.expect_download(timeout=120_000) as downloaded:
            page.locator("#save-ply").click()
        assert downloaded.value.suggested_filename == "garden-restyled.ply"
        downloaded.value.save_as(tmp_path / "restyled.ply")
        saved, _ = checkpoint.load_latest(made / "garden" / "run" / "checkpoints")
        assert saved is not None
        plain = from_tensors(saved.model)
        styled = read_capture(tmp_path / "restyled.ply").gaussians
        assert torch.equal(styled.means, plain.means) and not torch.allclose(
            styled.harmonics, plain.harmonics, atol=0.1
        )
        with page.expect_download(timeout=120_000) as downloaded:
            page.locator("#save-picture").click()
        downloaded.value.save_as(tmp_path / "picture.png")
        assert cv2.imread(str(tmp_path / "picture.png")).std() > 20
        page.locator("#scenes").click()
        page.get_by_role("button", name="garden stopped at").wait_for()
        page.get_by_role("button", name="Train on").wait_for()  # it was stopped before its end
        page.wait_for_function("() => document.querySelector('#recent img')?.naturalWidth > 100")
        assert {path.name for path in made.iterdir()} == {"garden"}, "nothing of what was refused"
        page.get_by_role("button", name="Rename garden").click()
        page.locator("dialog input").fill("yard")
        page.locator("dialog button", has_text="Rename").click()
        page.get_by_role("button", name="yard stopped at").wait_for()
        page.get_by_role("button", name="Delete yard").click()
        page.locator("dialog button", has_text="Delete").click()
        page.locator("#recent").wait_for(state="hidden")
        assert [*made.iterdir()] == []


@pytest.mark.parametrize("method", ["fprf-lite", "fprf-splats"])
def test_training_is_shown_as_checkpoints_come_and_goes_on_without_its_viewer(
    world: World, tmp_path: Path, method: str
) -> None:
    few = flags(world, tmp_path / "run")
    few[few.index("--steps") + 1] = "100000"
    if method == "fprf-splats":
        few = [*few[:4], "--steps", "1000000", "--passes", "1000000", "--initial", "300", "--cap", "400"]
    command = [sys.executable, "-m", "fprf", "train", method, *few, "--checkpoint-minutes", "0.05"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            with served(tmp_path / "run", "--follow") as address, front(address) as page:
                first = page.evaluate("() => fprf.live.scene.step")
                page.wait_for_function("(first) => fprf.live.scene.step > first", arg=first, timeout=120_000)
            assert process.poll() is None
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(120)
