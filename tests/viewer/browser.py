"""The viewer as a process and a headless Chromium in front of it, for tests. Needs viser, playwright and a Chromium."""

import base64
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

_DROP = """async ([data, name]) => {
  const bytes = Uint8Array.from(atob(data), (c) => c.charCodeAt(0));
  const carried = new DataTransfer();
  carried.items.add(new File([bytes], name, { type: "image/png" }));
  const canvas = document.querySelector("canvas");
  for (const kind of ["dragenter", "dragover", "drop"])
    canvas.dispatchEvent(new DragEvent(kind, { dataTransfer: carried, bubbles: true, cancelable: true }));
}"""
_CHROMIUM = next((p for name in ("chromium", "chromium-browser", "google-chrome") if (p := shutil.which(name))), None)
_ARGUMENTS = [
    "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--no-first-run",
    "--disable-quic", "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip


@contextmanager
def served(run: Path | None, *args: str) -> Iterator[tuple[str, int]]:
    """`fprf view`, without a run its start page, on a free port: its address and the number of its process."""
    pytest.importorskip("viser", reason="the extra `viewer` is not installed")
    command = [sys.executable, "-m", "fprf", "view", *([] if run is None else [str(run)]), "--port", "0", *args]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().strip(), process.pid
        finally:
            process.send_signal(signal.SIGINT)
            try:
                _, error = process.communicate(timeout=60)
            except subprocess.TimeoutExpired:
                process.kill()
                raise
    assert "Traceback" not in error, error
    assert process.returncode == 130


class Front:
    """A page, and the pictures that reach it."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.pictures: list[float] = []
        self.errors: list[str] = []
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("websocket", lambda socket: socket.on("framereceived", self._came))

    def _came(self, payload: str | bytes) -> None:
        if isinstance(payload, bytes) and b"\xff\xd8\xff" in payload:  # a JPEG
            self.pictures.append(time.monotonic())

    def rest(self, seconds: float = 3.0, limit: float = 120.0) -> None:
        """Until no picture has come for a while, and one has come at all."""
        end = time.monotonic() + limit
        while time.monotonic() < end:
            self.page.wait_for_timeout(100)
            if self.pictures and time.monotonic() - self.pictures[-1] > seconds:
                return
        raise AssertionError("no picture ever came, or they never ended")

    def turn(self, times: int) -> None:
        """Drags on the picture."""
        mouse = self.page.mouse
        for i in range(times):
            x, y = 150 + 7 * (i % 11), 200 + 5 * (i % 7)
            mouse.move(x, y)
            mouse.down()
            mouse.move(x + 30 - 60 * (i % 2), y + 6, steps=2)
            mouse.up()

    def drop(self, path: Path) -> float:
        """Drop a photograph; seconds until the next picture."""
        count, start = len(self.pictures), time.monotonic()
        self.page.evaluate(_DROP, [base64.b64encode(path.read_bytes()).decode(), path.name])
        while len(self.pictures) == count:
            assert time.monotonic() - start < 60, "nothing came of the drop"
            self.page.wait_for_timeout(10)
        return self.pictures[-1] - start

    def state(self) -> Any:
        """What the page knows."""
        return self.page.evaluate("() => fetch('/fprf/state').then((answer) => answer.json())")

    def until(self, true: Any, limit: float = 60.0) -> Any:
        """The state, as soon as something holds of it."""
        end = time.monotonic() + limit
        while not true(state := self.state()):
            assert time.monotonic() < end, state
            self.page.wait_for_timeout(100)
        return state


@contextmanager
def front(address: str, width: int = 640, height: int = 480, ready: str = "canvas") -> Iterator[Front]:
    """A browser that has opened the address and shows the element `ready`."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if _CHROMIUM is None or os.name != "posix":
        pytest.skip("no Chromium on this machine")
    with api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=_CHROMIUM, args=_ARGUMENTS)
        try:
            found = Front(browser.new_page(viewport={"width": width, "height": height}))
            found.page.goto(address, timeout=120_000)
            found.page.wait_for_selector(ready, timeout=120_000)
            yield found
        finally:
            browser.close()
