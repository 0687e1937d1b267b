"""`fprf train --view`: `fprf view` on the run folder, in a process of its own.

It reads checkpoints as they come; whatever becomes of it, training goes on.
"""

import contextlib
import json
import signal
import subprocess
import sys
import tempfile
import threading
import urllib.request
from pathlib import Path
from queue import Empty, Queue
from typing import NamedTuple
from urllib.parse import urlsplit

from ..errors import UsageError

_START_TIMEOUT = 60.0
"""Seconds within which the viewer must say where it listens."""


class ViewAddress(NamedTuple):
    """Address to listen at."""

    host: str = "127.0.0.1"
    port: int = 8080
    strict: bool = False
    """True where another free port will not do."""


class LiveViewer:
    """The viewer's process; a context manager, which ends it. Raises UsageError where the viewer does not start."""

    def __init__(self, address: ViewAddress, run: Path, command: tuple[str, ...] = (sys.executable, "-m", "fprf")) -> None:
        self._log = tempfile.TemporaryFile("w+")  # noqa: SIM115  closed with the process
        self._process: subprocess.Popen[str] | None = None
        ports = (address.port,) if address.strict else (address.port, 0)
        for port in ports:
            self.address = self._started([*command, "view", str(run), "--host", address.host, "--port", str(port), "--wait"])
            if self.address:
                return
        why = self.fault or "the viewer did not start; try `fprf view` on a run, or train without --view"
        self.close()
        raise UsageError(f"--view: {why}")

    def __enter__(self) -> "LiveViewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def looked_at(self) -> bool:
        """True while a page is open."""
        place = urlsplit(self.address)
        asked = urllib.request.Request(f"{place.scheme}://{place.netloc}/pages")
        asked.add_header("authorization", f"Bearer {place.query.removeprefix('token=')}")
        try:
            with urllib.request.urlopen(asked, timeout=5) as answer:  # nosec B310  our own address
                return bool(json.load(answer)["pages"])
        except (OSError, ValueError, KeyError):
            return False

    @property
    def fault(self) -> str | None:
        """Why the viewer has ended, in one line; None where it has not."""
        if self._process is None or self._process.poll() is None:
            return None
        self._log.seek(0)
        lines = [line.strip() for line in self._log if line.strip()]
        return lines[-1].removeprefix("error: ")[:200] if lines else "it said nothing"

    def wait(self) -> None:
        """Return when no page is open any more, or the viewer has ended."""
        assert self._process is not None
        while self.looked_at:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(1)

    def close(self) -> None:
        """End the viewer, by force if it does not react."""
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(5)
            self._process.kill()
            self._process.wait()
        if self._process is not None and self._process.stdout is not None:
            self._process.stdout.close()
        self._log.close()

    def _started(self, command: list[str]) -> str:
        """Start the process; the address that it prints, or nothing."""
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=self._log,
            text=True,
            start_new_session=True,  # an interrupt at the terminal is training's
        )
        first: Queue[str] = Queue()
        output = self._process.stdout
        assert output is not None
        threading.Thread(target=lambda: first.put(output.readline().strip()), daemon=True).start()
        with contextlib.suppress(Empty):
            return first.get(timeout=_START_TIMEOUT)
        return ""
