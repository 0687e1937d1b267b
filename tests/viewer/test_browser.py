"""The whole viewer: a process, a browser, real drops and clicks. Skipped where viser, playwright or Chromium are not there."""

import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from urllib.parse import urljoin

import cv2
import pytest
import torch
from browser import Front, front, served
from tiny_world import World, flags

from fprf.splats.files import read_capture
from fprf.splats.gaussians import from_tensors
from fprf.training import checkpoint

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]
PRESS = "(text) => [...document.querySelectorAll('button')].find((each) => each.textContent.trim() === text).click()"


@pytest.fixture
def opened(run: Path) -> Iterator[tuple[Front, int]]:
    with served(run, "--pixels", "128") as (address, pid), front(address) as found:
        found.rest()
        yield found, pid
        assert found.errors == []


def memory(pid: int) -> int:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1])


def test_a_drop_a_click_a_wipe_and_a_pin(opened: tuple[Front, int], world: World) -> None:
    found, _ = opened
    found.drop(world.references[0])
    state = found.until(lambda state: len(state["shelf"]) == 1)
    assert state["shelf"][0]["name"] == "dusk.png" and state["shelf"][0]["weight"] == 1
    found.page.locator(".fprf-card img").first.wait_for()
    boxes = found.page.locator("input[type=checkbox]:visible")
    boxes.nth(0).click(force=True)
    found.until(lambda state: state["wipe"] == 0.5)
    handle = found.page.locator("#fprf-wipe").bounding_box()
    found.page.mouse.move(handle["x"] + 15, 300)
    found.page.mouse.down()
    found.page.mouse.move(160, 300, steps=4)
    found.page.mouse.up()
    found.until(lambda state: state["wipe"] == pytest.approx(0.25, abs=0.01))
    boxes.nth(0).click(force=True)
    boxes.nth(1).click(force=True)
    found.until(lambda state: state["picking"] and state["wipe"] is None)
    found.page.wait_for_timeout(2000)  # the page is told by two ways; clicks by the slower one
    found.page.mouse.click(200, 200)
    picked = found.until(lambda state: state["picked"] is not None)["picked"]
    assert sum(row["share"] for row in picked["taken"]) == pytest.approx(1, abs=1e-3)
    found.page.locator("#fprf-region button", has_text="keep as it is").click()
    found.until(lambda state: state["picked"]["orders"] == [{"verb": "keep", "card": None}])


def test_what_is_no_photograph_is_told_on_the_page(opened: tuple[Front, int], tmp_path: Path) -> None:
    found, _ = opened
    wrong = tmp_path / "wrong.png"
    wrong.write_bytes(b"not a photograph")
    found.page.set_input_files("#fprf-files", str(wrong))
    found.page.locator("#fprf-said .bad", has_text="no PNG, JPEG").wait_for()
    assert found.state()["shelf"] == []


def test_many_moves_and_drops_leave_no_memory_behind(opened: tuple[Front, int], world: World) -> None:
    found, pid = opened
    held = []
    for _ in range(2):  # the shelf is full after fourteen, allocators have what they keep after the first round
        found.turn(150)
        for i in range(40):
            found.drop(world.references[i % 2])
        found.rest()
        held.append(memory(pid))
    assert held[1] <= 1.03 * held[0]
    assert len(found.state()["shelf"]) == 12


def test_keys_are_set_seen_put_in_another_order_and_played(opened: tuple[Front, int], world: World) -> None:
    found, _ = opened
    found.page.evaluate(PRESS, "Add a key here")
    found.until(lambda state: len(state["keys"]) == 1)
    found.drop(world.references[0])
    found.rest()
    found.turn(2)
    found.rest()
    strip = found.page.locator("#fprf-flight")
    strip.get_by_text("+ key").click()
    keys = found.until(lambda state: len(state["keys"]) == 2)["keys"]
    loaded = "() => [...document.querySelectorAll('#fprf-flight img')].every((each) => each.naturalWidth > 0)"
    found.page.wait_for_function(loaded)
    strip.locator(".key").nth(1).hover()
    strip.locator(".key").nth(1).get_by_title("earlier").click()
    found.until(lambda state: state["keys"] == keys[::-1] and state["chosen"] == 0)
    strip.locator(".key").nth(1).locator("b").click()  # back to where it began, in the look of then
    found.until(lambda state: state["chosen"] == 1 and state["shelf"][0]["weight"] == 0)
    found.rest()
    count = len(found.pictures)
    strip.get_by_text("play").click()
    found.until(lambda state: state["playing"])
    found.until(lambda state: not state["playing"])
    assert len(found.pictures) > count + 3
    strip.locator(".key").nth(0).hover()
    strip.locator(".key").nth(0).get_by_title("remove").click()
    found.until(lambda state: state["keys"] == keys[:1])


def test_a_film_is_made_from_the_page_and_can_be_downloaded(opened: tuple[Front, int]) -> None:
    found, _ = opened
    found.page.evaluate(PRESS, "Add a key here")
    found.until(lambda state: len(state["keys"]) == 1)
    found.page.locator("#fprf-flight").get_by_text("film").click()
    found.until(lambda state: state["film"]["ready"], 240)
    link = found.page.get_by_text("download the film")
    link.wait_for()
    answer = found.page.request.get(urljoin(found.page.url, link.get_attribute("href")))
    assert answer.status == 200 and b"ftyp" in answer.body()[:32]


def test_photographs_become_a_restyled_ply_without_a_terminal(tmp_path: Path) -> None:
    shipped, given = Path(str(files("fprf") / "garden")), tmp_path / "garden"
    shutil.copytree(shipped / "images", given / "images")
    for name in ("transforms.json", "points.npz"):
        shutil.copyfile(shipped / name, given / name)
    (tmp_path / "notes.txt").write_text("no photograph")
    made = tmp_path / "made"
    with served(None, "--output", str(made)) as (address, _), front(address, 1280, 800, "#drop") as found:
        page = found.page
        page.set_input_files("#files", str(tmp_path / "notes.txt"))
        page.locator("#fault", has_text="notes.txt: cannot become a scene").wait_for()
        page.set_input_files("#files", str(shipped / "references" / "night.jpg"))
        page.locator("#fault", has_text="1 photograph is no scene").wait_for()
        page.fill("#minutes", "5")
        page.set_input_files("#folder", str(given))
        page.locator("#picture").wait_for(timeout=240_000)  # of training, which need not end
        page.locator("#show").click()
        page.wait_for_selector("canvas", timeout=120_000)
        assert {path.name for path in (made / "garden").iterdir()} == {"files", "run"}
        assert len([*(made / "garden" / "files" / "images").iterdir()]) == 25
        page.set_input_files("#fprf-files", str(shipped / "references" / "sunset.jpg"))
        found.until(lambda state: len(state["shelf"]) == 1, 240)
        acts = page.locator("#fprf-shelf .acts button")
        with page.expect_download(timeout=120_000) as downloaded:
            acts.filter(has_text=".ply").click()
        assert downloaded.value.suggested_filename == "garden-restyled.ply"
        downloaded.value.save_as(tmp_path / "restyled.ply")
        plain = from_tensors(checkpoint.load_latest(made / "garden" / "run" / "checkpoints")[0].model)
        styled = read_capture(tmp_path / "restyled.ply").gaussians
        assert torch.equal(styled.means, plain.means) and not torch.allclose(styled.harmonics, plain.harmonics, atol=0.1)
        with page.expect_download(timeout=120_000) as downloaded:
            acts.filter(has_text="picture").click()
        downloaded.value.save_as(tmp_path / "picture.png")
        assert cv2.imread(str(tmp_path / "picture.png")).std() > 20
        acts.filter(has_text="scenes").click()
        page.locator("#recent b", has_text="garden").wait_for()
        assert found.errors == []


@pytest.mark.parametrize("method", ["fprf-lite", "fprf-splats"])
def test_training_is_shown_live_and_goes_on_without_its_viewer(world: World, tmp_path: Path, method: str) -> None:
    few = flags(world, tmp_path / "run")
    few[few.index("--steps") + 1] = "100000"
    if method == "fprf-splats":
        few = [*few[:4], "--steps", "1000000", "--passes", "1000000", "--initial", "300", "--cap", "400"]
    command = [sys.executable, "-m", "fprf", "train", method, *few, "--view", "0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        try:
            address = next(line.split("live at ")[1].rstrip('"}\n') for line in process.stderr if "live at" in line)
            threading.Thread(target=process.stderr.read, daemon=True).start()
            with front(address) as found:
                found.page.locator("#fprf-training.on").wait_for(timeout=120_000)
                first = found.until(lambda state: state["training"]["step"] > 0)["training"]["step"]
                found.page.set_input_files("#fprf-files", str(world.references[0]))
                found.until(lambda state: len(state["shelf"]) == 1)
                if method == "fprf-lite":  # Gaussians are drawn by the browser
                    found.turn(5)
                found.until(lambda state: state["training"]["step"] > first)
                assert found.errors == []
            assert process.poll() is None  # the page is gone, training is not
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(120) == 130
    assert list((tmp_path / "run" / "checkpoints").glob("step-*/manifest.json"))
