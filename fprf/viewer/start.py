"""The start of `fprf view` without a run: photographs, a video or a capture come in, and become a scene that the viewer shows.

Poses and training are `fprf process` and `fprf train` in processes of their own; the page shows the lines that they print. A
scene has one folder: its `files`, the `scene` with their poses, and the run folder `run`.
"""

import asyncio
import contextlib
import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, Literal, TypeAlias

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from ..errors import DataError, FprfError, UsageError
from .scene_files import SceneFiles, Source, find_source, is_capture, newest_step

METHOD = "fprf-splats"
_FILES, _SCENE, _RUN = "files", "scene", "run"
_MAX_JSON = 4096
"""Bytes of a request that is JSON."""
_LINES = 40
"""Lines of a process that are kept."""
_RECENT = 12
_EXIT_TIMEOUT = 10.0
"""Seconds that a process has to save and end."""
_PICTURE = 480
"""Longest side of the picture of training, in pixels."""
_SAVES = 40
"""Times that training saves, and so shows another picture, at most every six seconds."""

Stage: TypeAlias = Literal["idle", "poses", "training", "opening", "open"]


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Progress of a scene that is being made."""

    name: str = ""
    stage: Stage = "idle"
    what: str = ""
    """Present stage, in words."""
    share: float | None = None
    """Of `what`, in [0, 1]; None = not known."""
    detail: str = ""
    lines: tuple[str, ...] = ()
    """Last lines of the processes' output."""
    error: str | None = None
    folder: str = ""
    """Folder that everything lies in."""


class _Left(Exception):
    """The user wants nothing more of a scene."""


class Start:
    """`output` holds a folder a scene; `show` opens the viewer on a run folder or a capture, `leave` closes it.

    `post` sends all pages how far it is.
    """

    def __init__(
        self,
        output: Path,
        show: Callable[[Path, str], None],
        leave: Callable[[], None],
        post: Callable[[None, str, Mapping[str, Any]], None] = lambda client, kind, message: None,
    ) -> None:
        self._output, self._show, self._leave, self._post = output.resolve(), show, leave, post
        self._uploads: dict[str, SceneFiles] = {}
        self._progress = Progress()
        self._lock, self._drawing = threading.Lock(), threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._stopped = ""
        """Request on which it was stopped: `show` or `leave`."""
        self._thread: threading.Thread | None = None
        self._picture: tuple[int, bytes] = (-1, b"")

    def close(self) -> None:
        """End what is being made, as an interrupt at the terminal would."""
        self._interrupt("leave")
        if self._thread is not None:
            self._thread.join(_EXIT_TIMEOUT)

    def state(self) -> dict[str, Any]:
        """How far it is, as the page reads it; idle, what can be opened."""
        progress = self._progress
        step = newest_step(self._output / progress.name / _RUN) if progress.stage == "training" else -1
        recent = self._recent() if progress.stage == "idle" else []
        return {"type": "start", **asdict(progress), "picture": step, "output": str(self._output), "recent": recent}

    def picture(self) -> bytes:
        """A view of the newest checkpoint as a JPEG; empty where there is none."""
        return self._drawn(self._output / self._progress.name / _RUN)

    def new(self, asked: Mapping[str, Any]) -> dict[str, str]:
        """Begin a scene under a name like the one that is asked for."""
        name = self._unused(str(asked.get("name", "")))
        self._uploads[name] = SceneFiles(self._output / name / _FILES)
        return {"scene": name}

    def piece(self, query: Mapping[str, str], data: bytes) -> None:
        """Take a piece of a file. Raises as `SceneFiles.add`."""
        upload = self._upload(query.get("scene"))
        upload.add(query.get("name", ""), integer(query, "at"), integer(query, "size"), data)

    def make(self, asked: Mapping[str, Any]) -> None:
        """Make a scene of the files that came. Raises UsageError or DataError where none can be made."""
        name = str(asked.get("scene"))
        folder = self._upload(name).folder
        if not folder.is_dir():
            raise UsageError("none of these files can become a scene; give photographs, a video or a capture")
        self._begin(find_source(folder), name, _minutes(asked))

    def open(self, asked: Mapping[str, Any]) -> None:
        """Open, or make a scene of, a file or folder of this machine."""
        text = str(asked.get("path", "")).strip().strip("\"'")
        if not text:
            raise UsageError("name a run folder, a capture, a video or a folder of photographs")
        path = Path(text).expanduser()
        source, whole = find_source(path), path.resolve()
        if source.kind == "run":
            name = whole.parent.name if whole.name == _RUN else whole.name
        else:
            ours = whole.name == _FILES and whole.parent.parent == self._output
            name = whole.parent.name if ours else self._unused(path.stem)
        self._begin(source, name, _minutes(asked))

    def stop(self, asked: Mapping[str, Any]) -> None:
        """Stop what is being made, to show what there is, or to leave it; a failure is put away."""
        busy = self._thread is not None and self._thread.is_alive()  # asked before it ends by this very request
        self._interrupt("show" if asked.get("then") == "show" else "leave")
        if not busy:
            self._reset()

    def leave(self, asked: Mapping[str, Any]) -> None:
        """Close the scene that is shown."""
        if self._progress.stage in ("idle", "open"):
            self._progress = Progress()
            self._leave()

    def _begin(self, source: Source, name: str, minutes: float) -> None:
        with self._lock:
            if self._thread is not None and self._thread.is_alive():
                raise UsageError(f"{self._progress.name} is being made; stop it first")
            self._stopped, self._picture = "", (-1, b"")
            folder = self._output / name if source.kind != "run" else source.path
            self._progress = Progress(name=name, stage="opening", folder=str(folder))
            self._thread = threading.Thread(target=self._make, args=(source, name, minutes), name="fprf-make", daemon=True)
            self._thread.start()
        self._post(None, "start", self.state())

    def _make(self, source: Source, name: str, minutes: float) -> None:
        """Find poses, train, and open the viewer, as far as the source needs it."""
        root, path = self._output / name, source.path
        try:
            if source.kind in ("photographs", "video"):
                self._set(stage="poses", what="looking at the photographs")
                self._call(["process", str(path), "--output", str(root / _SCENE)])
                path = root / _SCENE
            if source.kind in ("photographs", "video", "scene"):
                self._set(stage="training", what="reading photographs", share=None, detail="")
                often = f"{max(0.1, minutes / _SAVES):g}"
                place = ["--data", str(path), "--output", str(root / _RUN)]
                self._call(["train", METHOD, *place, "--minutes", f"{minutes:g}", "--checkpoint-minutes", often])
                path = root / _RUN
            self._set(stage="opening", what="opening the scene", share=None, detail="")
            self._show(path, name)
            self._set(stage="open")
        except _Left:
            self._reset()
        except FprfError as error:
            self._set(error=str(error))
        except Exception as error:  # whatever it is, the page goes on and the files are there
            self._set(error=f"this should not have happened: {type(error).__name__}: {error}")

    def _call(self, args: Sequence[str]) -> None:
        """Run a verb to its end. Raises DataError with what it says when it fails, `_Left` when it is to be left."""
        if self._stopped == "leave":
            raise _Left
        command = [sys.executable, "-m", "fprf", *args]
        with subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
        ) as process:
            self._process = process
            assert process.stdout is not None
            last = ""
            for line in process.stdout:
                if line.strip():
                    last = line.strip()
                    self._follow(last)
        self._process = None
        if self._stopped == "leave" or (self._stopped and newest_step(self._output / self._progress.name / _RUN) < 0):
            raise _Left
        if process.returncode and not self._stopped:
            raise DataError(last.removeprefix("error: ") or f"fprf {args[0]} has ended with {process.returncode}")

    def _follow(self, line: str) -> None:
        """Take a line that a process printed: progress as JSON, or a message."""
        try:
            event = json.loads(line)
        except ValueError:
            event = None
        if not isinstance(event, dict) or "event" not in event:
            self._set(lines=(*self._progress.lines, line)[-_LINES:])
            return
        what = str(event["event"])
        if "step" in event:
            clock = f"{event['seconds_left'] // 60}:{event['seconds_left'] % 60:02d} left"
            self._set(what=what, share=event["share"], detail=f"step {event['step']} · {event['psnr']:.1f} dB · {clock}")
        elif "total" in event:
            share = event["done"] / max(1, event["total"])
            self._set(what=what, share=share, detail=f"{event['done']} of {event['total']}")
        else:
            self._set(lines=(*self._progress.lines, what)[-_LINES:])

    def _interrupt(self, then: str) -> None:
        """Let the process that runs save and end; one that does not is killed."""
        self._stopped = then
        process = self._process
        if process is not None:
            with contextlib.suppress(OSError):
                process.send_signal(signal.SIGINT)
            last = threading.Timer(_EXIT_TIMEOUT, process.kill)
            last.daemon = True
            last.start()

    def _set(self, **changes: Any) -> None:
        self._progress = replace(self._progress, **changes)
        self._post(None, "start", self.state())

    def _reset(self) -> None:
        self._progress = Progress()
        self._post(None, "start", self.state())

    def _upload(self, name: str | None) -> SceneFiles:
        upload = self._uploads.get(name or "")
        if upload is None:
            raise UsageError("no such scene; begin again by dropping the files")
        return upload

    def _unused(self, asked: str) -> str:
        """A folder's name like the one asked for, that no other scene has."""
        last = asked.replace("\\", "/").rstrip("/").rsplit("/", 1)[-1]
        plain = "".join(c if c.isalnum() or c in "-_" else "-" for c in last)[:40].strip("-") or "scene"
        names = (plain if k == 1 else f"{plain}-{k}" for k in count(1))
        return next(name for name in names if name not in self._uploads and not (self._output / name).exists())

    def _recent(self) -> list[dict[str, str]]:
        """Scenes and runs on this machine, the newest first."""
        runs = [(path.parent, path.parent.name) for path in Path("runs").glob("*/config.json") if newest_step(path.parent) >= 0]
        scenes = [*_scenes(self._output), *runs, (Path("demo/run"), "demo")]
        dated = [(path.stat().st_mtime, path, name) for path, name in scenes if path.is_dir()]
        return [
            {
                "path": str(path.resolve()),
                "name": name,
                "kind": _kind(path),
                "when": time.strftime("%d %b %H:%M", time.localtime(date)),
            }
            for date, path, name in sorted(dated, reverse=True)[:_RECENT]
        ]

    def _drawn(self, run: Path) -> bytes:
        """A view of the newest checkpoint as a JPEG; empty where there is none."""
        with self._drawing:
            step = newest_step(run)
            if step > self._picture[0]:
                with contextlib.suppress(FprfError, OSError):  # while it is saved or replaced the one before is good
                    self._picture = (step, _render(run))
            return self._picture[1]


def _render(run: Path) -> bytes:
    from ..io.images import encode, to_uint8
    from ..training.loading import open_run
    from ..training.quality import QualityConfig

    opened = open_run(run, "cpu", QualityConfig())
    views = opened.known.test or opened.known.train
    view = views[len(views) // 2]
    small = min(1.0, _PICTURE / int(opened.known.cameras.size[view].amax()))
    return encode(to_uint8(opened.scene.render(opened.known.cameras, view, resolution=small).rgb), "jpg")


def _kind(path: Path) -> str:
    """Kind of a scene on the list: `trained`, a `capture`, or photographs that are `not trained yet`."""
    if path.name != _FILES:
        return "trained"
    return "capture" if any(is_capture(each) for each in (path, *path.iterdir())) else "not trained yet"


def _scenes(output: Path) -> Iterator[tuple[Path, str]]:
    """Path that each scene's folder is opened by: its run, or its files where there is none yet."""
    for folder in output.glob("*/"):
        opened = folder / _RUN if newest_step(folder / _RUN) >= 0 else folder / _FILES
        if opened.is_dir():
            yield opened, folder.name


def _minutes(asked: Mapping[str, Any]) -> float:
    value = asked.get("minutes", 2)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.05 <= value <= 600:
        raise UsageError("minutes: must be a number from 0.05 to 600")
    return float(value)


def start_routes(start: "Callable[[], Start | None]", body: Callable[[Request], Awaitable[bytes]]) -> list[Route]:
    """Requests of the start page; it may be there or not."""

    def found() -> Start:
        if (each := start()) is None:
            raise HTTPException(404, "no start page here")
        return each

    def asked(name: str, act: Callable[[Start, dict[str, Any]], dict[str, str] | None]) -> Route:
        async def respond(request: Request) -> Response:
            return JSONResponse(await asyncio.to_thread(act, found(), json_body(await body(request))) or {})

        return Route(f"/start/{name}", respond, methods=["POST"])

    async def piece(request: Request) -> Response:
        await asyncio.to_thread(found().piece, request.query_params, await body(request))
        return JSONResponse({})

    async def picture(request: Request) -> Response:
        data = await asyncio.to_thread(found().picture)
        if not data:
            raise HTTPException(404, "no picture yet")
        return Response(data, media_type="image/jpeg")

    actions = {"new": Start.new, "make": Start.make, "open": Start.open, "stop": Start.stop, "leave": Start.leave}
    return [
        Route("/start/piece", piece, methods=["POST"]),
        Route("/start/picture", picture),
        *(asked(name, act) for name, act in actions.items()),
    ]


def json_body(body: bytes) -> dict[str, Any]:
    """The object that a body holds. Raises UsageError where it holds none."""
    try:
        asked = json.loads(body) if len(body) <= _MAX_JSON else None
    except (ValueError, RecursionError):
        asked = None
    if not isinstance(asked, dict):
        raise UsageError("request: no short JSON object")
    return asked


def integer(asked: Mapping[str, Any], name: str) -> int:
    """A whole number from 0 on, of at most 12 digits, in a query. Raises UsageError for anything else."""
    text = str(asked.get(name))
    if not (text.isdigit() and text.isascii() and len(text) <= 12):
        raise UsageError(f"{name}: {text[:20]!r} is no number from 0")
    return int(text)
