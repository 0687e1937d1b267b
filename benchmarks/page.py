"""The page against the rasteriser, and what it costs in a headless Chromium with software GL.

    python -m benchmarks page RUN ... --reference photo.jpg [--parts pictures frames million drop] [--few]

pictures  captured views as the page draws them, against the rasteriser: PSNR, the worst and the mean
frames    seconds of a clock and of the processor: a frame at 1280 x 720, as for a moving camera at full resolution and at rest,
          and the first picture
million   a page of a million Gaussians: milliseconds of a sort, memory of the page
drop      `fprf view RUN`: seconds from a dropped photograph to its colours on the page, the third of three

    python -m benchmarks page --film docs/garden.html docs/images/garden.webp

films a page instead: a walk through its cameras and back, a column for each of its first five styles.

Needs playwright and a Chromium. Times want free
cores: the load average is written down.
"""

import base64
import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from fprf.errors import UsageError
from fprf.io.video import write_video
from fprf.page.writer import Page, PageView, write_page
from fprf.plugins.encoders.config import BundledSemanticConfig
from fprf.rendering.cameras import Cameras
from fprf.splats.captures import look_at_capture
from fprf.splats.config import LookConfig
from fprf.splats.drawing import draw
from fprf.splats.gaussians import Gaussians
from fprf.splats.pinholes import camera_of
from fprf.splats.scene import SplatScene
from fprf.training.loading import open_run

from .common import ROOT, arguments, report

sys.path.insert(0, str(ROOT / "tests"))

from chromium import chromium

TARGETS = {
    "psnr": 35.0,
    "frame_seconds": 0.7,
    "first_picture_seconds": 2.0,
    "sort_milliseconds": 40.0,
    "drop_seconds": 1.0,
}
PARTS = ("pictures", "frames", "million", "drop")
DRAW = """async ([view, lens, width, height, options]) => {
  const { splats, scene, canvas } = fprf.place;
  fprf.place.lost = true;
  while (fprf.place.sorting) await new Promise((done) => setTimeout(done, 5));
  await splats.sort(new Float32Array(view), scene.near);
  [canvas.width, canvas.height] = [width, height];
  const start = performance.now();
  const { near, background } = scene;
  splats.draw(new Float32Array(view), lens, { first: "Captured" }, { near, background, ...options });
  splats.gl.readPixels(0, 0, 1, 1, splats.gl.RGBA, splats.gl.UNSIGNED_BYTE, new Uint8Array(4));
  const seconds = (performance.now() - start) / 1000;
  return { seconds, sort: splats.sortMilliseconds, picture: options.timed ? null : canvas.toDataURL("image/png") };
}"""

WALK = (2, 13)
"""Cameras of a page, in its order, between which the film walks."""
FRAMES = 18
COLUMN = (200, 356)
GAP = 6
"""Frames one way, size of a column and room between columns, in pixels."""
STEP = """async ([t, [from, to], width, height]) => {
  const { place, stage } = fprf, { splats, scene, canvas } = place;
  place.lost = true;
  while (place.sorting) await new Promise((done) => setTimeout(done, 5));
  const keys = scene.cameras.slice(from, to + 1).map((each) => new Camera(each)), at = t * (keys.length - 1);
  const key = Math.min(Math.floor(at), keys.length - 2), camera = keys[key].towards(keys[key + 1], at - key);
  await splats.sort(camera.view, scene.near);
  // Not before: the page fits its canvas to the window once more.
  [canvas.width, canvas.height] = [width, height];
  return stage.styles.slice(0, 5).map(({ name }) => {
    splats.draw(camera.view, camera.fitted(width, height), { first: name }, scene);
    return canvas.toDataURL("image/png");
  });
}"""


def opened(browser: Any, scene: SplatScene, folder: Path) -> Any:
    """The page of a scene, as soon as all of it is there."""
    path = folder / "page.html"
    write_page(
        path,
        Page(
            title="page",
            facts={},
            views=[PageView("0", np.zeros((72, 128, 3), np.uint8))],
            styles=[],
            scene=scene,
        ),
    )
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    start = time.perf_counter()
    before = processor_seconds()
    page.goto(path.as_uri())
    page.wait_for_selector(".place.drawn", timeout=120_000)
    page.first = time.perf_counter() - start
    page.first_processor = processor_seconds() - before
    page.wait_for_timeout(2000)
    return page


def view_of(cameras: Cameras, view: int, near: float, size: tuple[int, int] | None = None) -> list[Any]:
    """World to camera, lens and size of a view, in another size where one is given."""
    camera = camera_of(cameras, view, near)
    width, height = size or (camera.width, camera.height)
    by = min(width / camera.width, height / camera.height)
    fx, fy, cx, cy = (float(camera.intrinsics[k]) for k in ((0, 0), (1, 1), (0, 2), (1, 2)))
    lens = [
        fx * by,
        fy * by,
        width / 2 + (cx - camera.width / 2) * by,
        height / 2 + (cy - camera.height / 2) * by,
    ]
    return [camera.world_to_camera.T.flatten().tolist(), lens, width, height]


def picture_of(url: str) -> np.ndarray:
    """The RGB picture of a canvas's data URL."""
    return np.asarray(cv2.imdecode(np.frombuffer(base64.b64decode(url.split(",")[1]), np.uint8), 1))[
        ..., ::-1
    ]


def film(browser: Any, source: Path, output: Path) -> None:
    """Film a page in its first styles: there by frames of the browser, and back by the same ones."""
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.goto(source.resolve().as_uri())
    page.wait_for_selector(".place.ready", timeout=120_000)
    frames = []
    for step in range(FRAMES + 1):
        t = 0.5 - 0.5 * np.cos(np.pi * step / FRAMES)  # begins and ends at rest
        drawn = page.evaluate(STEP, [t, WALK, 2 * COLUMN[0], 2 * COLUMN[1]])
        columns = [
            np.asarray(cv2.resize(picture_of(url), COLUMN, interpolation=cv2.INTER_AREA), np.uint8)
            for url in drawn
        ]
        gap = np.full((COLUMN[1], GAP, 3), 255, np.uint8)
        frames.append(np.hstack([part for column in columns for part in (gap, column)][1:]).astype(np.uint8))
    write_video(output, iter([*frames, *frames[-2:0:-1]]), fps=10)


def pictures(page: Any, scene: SplatScene, count: int) -> dict[str, float]:
    found = []
    for view in sorted({*torch.linspace(0, len(scene.views) - 1, count).round().long().tolist()}):
        drawn = page.evaluate(DRAW, [*view_of(scene.views, view, scene.near), {}])["picture"]
        mine = picture_of(drawn) / 255
        camera = camera_of(scene.views, view, scene.near)
        theirs = (
            draw(scene.gaussians, camera, antialiased=scene.antialiased, background=scene.background)
            .image.clamp(0, 1)
            .numpy()
        )
        found.append(float(-10 * np.log10(((mine - theirs) ** 2).mean())))
    return {
        "views": len(found),
        "psnr_mean": round(statistics.fmean(found), 2),
        "psnr_worst": round(min(found), 2),
    }


def processor_seconds() -> float:
    """Time that processes started from this one, and from those, have used: other than wall clocks, it bears
    a busy machine.
    """
    rows = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has ended
            fields = path.read_text().rsplit(")", 1)[1].split()
            rows[int(path.parent.name)] = (int(fields[1]), int(fields[11]) + int(fields[12]))
    ours = {os.getpid()}
    size = 0
    while size < len(ours):
        size = len(ours)
        ours |= {each for each, (parent, _) in rows.items() if parent in ours}
    return sum(rows[each][1] for each in ours - {os.getpid()} if each in rows) / os.sysconf("SC_CLK_TCK")


def frames(page: Any, scene: SplatScene, count: int) -> dict[str, float]:
    place = view_of(scene.views, len(scene.views) // 2, scene.near, (1280, 720))
    said: dict[str, float] = {
        "gaussians": len(scene.gaussians),
        "first_picture_seconds": round(page.first, 2),
    }
    said["first_picture_processor_seconds"] = round(page.first_processor, 2)
    for name, options in (
        ("moving", {"exact": False}),
        ("moving_half", {"exact": False, "share": 0.5}),
        ("resting", {"exact": True}),
    ):
        times = []
        used = []
        for _ in range(count):
            before = processor_seconds()
            times.append(page.evaluate(DRAW, [*place, {**options, "timed": True}])["seconds"])
            used.append(processor_seconds() - before)
        said[f"{name}_seconds"] = round(statistics.median(times), 3)
        said[f"{name}_processor_seconds"] = round(statistics.median(used), 2)
    return said


def million(browser: Any, folder: Path, count: int) -> dict[str, float]:
    draw_ = torch.Generator().manual_seed(0)
    parts = (
        torch.randn(count, 3, generator=draw_),
        torch.randn(count, 4, generator=draw_),
        torch.full((count, 3), -3.5),
    )
    gaussians = Gaussians(*parts, torch.full((count,), 2.0), 0.3 * torch.randn(count, 1, 3, generator=draw_))
    scene = look_at_capture(
        gaussians, True, BundledSemanticConfig().build(), LookConfig(views=4, size=(160, 120), inside=False)
    )
    page = opened(browser, scene, folder)
    sorts = [
        page.evaluate(DRAW, [*view_of(scene.views, k, scene.near), {"timed": True}])["sort"] for k in range(4)
    ]
    heap = page.evaluate("() => performance.memory.usedJSHeapSize") / 2**20
    size = (folder / "page.html").stat().st_size / 2**20
    # Shapes and order on the graphics card and in the page, projected Gaussians, means and keys of the
    # sorter.
    held = count * (2 * 16 + 2 * 4 + 2 * 32 + 4 + 4 + 12 + 4 + 2) / 2**20
    sizes = {"heap_mib": round(heap, 1), "held_mib": round(held), "file_mib": round(size, 1)}
    return {"gaussians": count, "sort_milliseconds": round(min(sorts), 1), **sizes}


def drop(browser: Any, run: Path, reference: Path) -> dict[str, float]:
    command = [sys.executable, "-m", "fprf", "view", str(run), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        assert process.stdout is not None
        try:
            page = browser.new_page(viewport={"width": 1280, "height": 720})
            page.goto(process.stdout.readline().strip())
            page.wait_for_selector(".place.drawn", timeout=120_000)
            page.wait_for_timeout(15_000)  # what the first photograph needs is prepared meanwhile
            times = []
            for _ in range(3):
                before = page.evaluate("() => fprf.place.splats.colours.get('Now')?.rows?.length ?? 0")
                page.evaluate("() => { fprf.seen = fprf.place.splats.colours.get('Now'); }")
                start = time.perf_counter()
                page.set_input_files("#photographs", str(reference))
                page.wait_for_function(
                    "() => fprf.place.splats.colours.get('Now') !== fprf.seen", timeout=60_000, polling=20
                )
                times.append(time.perf_counter() - start)
                page.wait_for_timeout(3000)
                assert before >= 0
        finally:
            process.terminate()
    return {"first_seconds": round(times[0], 2), "drop_seconds": round(min(times[1:]), 2)}


def main(argv: list[str]) -> None:
    parser = arguments("page", __doc__)
    parser.add_argument("runs", type=Path, nargs="*")
    parser.add_argument("--reference", type=Path)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--film", type=Path, nargs=2, metavar=("PAGE", "OUTPUT"))
    parser.add_argument("--few", action="store_true", help="few views, frames and Gaussians")
    parser.add_argument(
        "--output", type=Path, help="JSON to write; parts that are not run keep what is there"
    )
    args = parser.parse_args(argv)
    if args.film:
        with chromium() as browser:
            film(browser, *args.film)
        return
    found: dict[str, Any] = (
        json.loads(args.output.read_text()) if args.output and args.output.is_file() else {}
    )
    found |= {"format": 1, "targets": TARGETS}
    few = 2 if args.few else 5
    with chromium() as browser, tempfile.TemporaryDirectory() as name:
        for run in args.runs:
            scene = open_run(run, "cpu").scene
            if not isinstance(scene, SplatScene):
                raise UsageError(f"{run}: a run of fields; name runs of Gaussians")
            page = opened(browser, scene, Path(name))
            for part, measure in (("pictures", pictures), ("frames", frames)):
                if part in args.parts:
                    load = round(os.getloadavg()[0], 2)
                    found.setdefault(part, {})[run.name] = measure(page, scene, few) | {
                        "load_average_before": load
                    }
                    print(part, run.name, found[part][run.name], flush=True)
            page.close()
        if "million" in args.parts:
            found["million"] = million(browser, Path(name), 50_000 if args.few else 1_000_000)
            print("million", found["million"], flush=True)
        if "drop" in args.parts and args.runs and args.reference:
            load = round(os.getloadavg()[0], 2)
            found["drop"] = drop(browser, args.runs[0], args.reference) | {"load_average_before": load}
            print("drop", found["drop"], flush=True)
    report(args.output, found)
