"""The start of `fprf view` without a run: photographs, a video or a capture come in, and become a scene that
the viewer shows.

Poses and training are `fprf process` and `fprf train` in processes of their own; the page shows the lines
that they print, and from the first checkpoint on the scene itself (`session.py`). A scene has one folder: its
`files`, the `scene` with their poses, and the run folder `run`.
"""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from ..datamanagers.images import IMAGE_SUFFIXES
from ..errors import DataError, FprfError, UsageError
from . import GARDEN
from .messages import Discard, Leave, Make, New, Open, Remove, Rename, StartRequest, Stop
from .uploads import SceneFiles, Source, Uploads, find_source, is_capture, newest_step, training_progress

if TYPE_CHECKING:
    from .server import ViewerServer
    from .session import Viewed

METHOD = "fprf-splats"
_FILES_FOLDER = "files"
_SCENE_FOLDER = "scene"
_RUN_FOLDER = "run"
_MAX_KEPT_LINES = 40
"""Lines of a process that are kept; by eye."""
_MAX_RECENT_SCENES = 12
"""Scenes that the page offers to open; by eye."""
_MAX_EXIT_SECONDS = 10.0
"""Seconds that a process has to save and end; by eye."""
_TOLD_SECONDS = 0.25
"""Between two tellings of how far an end is."""
_MAX_SILENT_SECONDS = 60.0
"""Without a piece of a file, after which a page that was sending has given up; by eye."""
_PREVIEW_PIXELS = 320
"""Longest side of a picture in the list of scenes; by eye."""
_INCOMING_FOLDER = ".incoming"
"""Files that are being sent: they get their place when a scene is made of them."""
_PREVIEW = Path("page", "preview.png")
"""In the folder of a run or a capture's scene: what its page showed last."""

StartStage: TypeAlias = Literal["idle", "poses", "training", "opening", "open"]


@dataclass(frozen=True, kw_only=True)
class StartProgress:
    """Progress of a scene that is being made."""

    name: str = ""
    stage: StartStage = "idle"
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
    """`output` holds a folder a scene; `load` opens a run folder or a capture under a name, for the `server`
    to show.
    """

    def __init__(self, output: Path, server: "ViewerServer", load: "Callable[[Path, str], Viewed]") -> None:
        self._output = output.resolve()
        self._server = server
        self._load = load
        self._uploads: dict[str, SceneFiles] = {}
        self._incoming = self._output / _INCOMING_FOLDER / str(os.getpid())
        self._heard = 0.0
        """When a piece of a file came last, by `time.monotonic`."""
        self._sending = ""
        """Scene whose files are coming."""
        self._decoder: Uploads | None = None
        self._preview_lock = threading.Lock()
        self._pictures: dict[tuple[Path, int], bytes] = {}
        self._previews: dict[str, Path] = {}
        """Folders of the scenes in the list, by name."""
        self._progress = StartProgress()
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._stopped = ""
        """Request on which it was stopped: `stop` or `leave`."""
        self._thread: threading.Thread | None = None
        self._ended = threading.Event()
        """Nothing is being made."""

    def close(self) -> None:
        """End what is being made, as an interrupt at the terminal would."""
        self._interrupt("leave")
        if self._thread is not None:
            self._thread.join(_MAX_EXIT_SECONDS)
            if self._process is not None:
                _end_group(self._process, getattr(signal, "SIGKILL", signal.SIGTERM))
                self._thread.join(_MAX_EXIT_SECONDS)
        shutil.rmtree(self._incoming, ignore_errors=True)
        self._remove_empty()
        if self._decoder is not None:
            self._decoder.close()

    def state(self) -> dict[str, Any]:
        """Progress as the page reads it, and when idle what can be opened."""
        progress = self._progress
        recent = self._recent() if progress.stage == "idle" else []
        return {
            "type": "start",
            **asdict(progress),
            "output": str(self._output),
            "recent": recent,
            "garden": str(GARDEN),
            "sending": self._sending if self._receiving else "",
        }

    @property
    def _receiving(self) -> bool:
        """Some page is sending files."""
        return bool(self._sending) and time.monotonic() - self._heard < _MAX_SILENT_SECONDS

    def handle(self, asked: StartRequest) -> dict[str, str]:
        """Do what the page asks for. Raises UsageError or DataError where no scene can be made of what is
        named.
        """
        match asked:
            case New():
                # Told before anything is sent.
                self._check_free()
                if self._receiving:
                    raise UsageError(
                        f"{self._sending} is being sent from another page; wait until it is there"
                    )
                self._remove_stale()
                name = self._unused(asked.name)
                self._uploads[name] = SceneFiles(self._incoming / name)
                self._sending = name
                self._heard = time.monotonic()
                self._server.post(None, "start", self.state())
                return {"scene": name}
            case Discard():
                self._discard(asked.scene)
            case Make():
                # The folder came with the first file that was taken: none of those that were sent may have
                # been.
                folder = self._upload(asked.scene).folder
                try:
                    if not folder.is_dir():
                        raise UsageError(
                            "none of these files can become a scene; give photographs, a video or a capture"
                        )
                    find_source(folder)
                    self._check_free()
                except FprfError:
                    self._discard(asked.scene)
                    raise
                target = self._output / asked.scene / _FILES_FOLDER
                target.parent.mkdir(parents=True)
                folder.rename(target)
                self._discard(asked.scene)
                self._begin(find_source(target), asked.scene, asked.minutes)
            case Rename():
                folder = self._listed(asked.scene)
                name = self._unused(asked.name)
                if name != asked.name:
                    raise UsageError(
                        f"{asked.name[:60]!r}: no name for a folder, or there is one already; {name!r} would do"
                    )
                folder.rename(self._output / name)
                self._server.post(None, "start", self.state())
            case Remove():
                shutil.rmtree(self._listed(asked.scene))
                self._server.post(None, "start", self.state())
            case Open():
                # A file or folder of this machine, by its path as it is copied from elsewhere.
                if not (text := asked.path.strip().strip("\"'")):
                    raise UsageError("name a run folder, a capture, a video or a folder of photographs")
                path = Path(os.path.expanduser(text))  # as it is where there is no such user
                source = find_source(path)
                whole = path.resolve()
                if source.kind == "run":
                    if whole.name == _RUN_FOLDER:
                        name = whole.parent.name
                    else:
                        name = whole.name
                else:
                    ours = (
                        whole.name in (_FILES_FOLDER, _SCENE_FOLDER) and whole.parent.parent == self._output
                    )
                    if ours:
                        name = whole.parent.name
                    else:
                        name = self._unused(path.stem)
                self._begin(source, name, asked.minutes)
            case Stop() if self._progress.error is None:
                if self._busy:
                    threading.Thread(target=self._tell_ending, name="fprf-ending", daemon=True).start()
                self._interrupt("stop")
            case Stop() | Leave():  # a failure is put away, with what is shown of it
                if self._busy:
                    self._interrupt("leave")
                self._progress = StartProgress()
                self._server.show_start(self)
        return {}

    @property
    def _busy(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def piece(self, scene: str, name: str, at: int, size: int, data: bytes) -> None:
        """Take a piece of a file. Raises as `SceneFiles.add`."""
        self._heard = time.monotonic()
        self._upload(scene).add(name, at, size, data)

    def _check_free(self) -> None:
        """Raise UsageError while a scene is being made."""
        if self._busy:
            name = self._progress.name  # none after `leave`, while what there is of it is saved
            raise UsageError(
                f"{name} is being made; stop it first" if name else "a scene is being saved; try again"
            )

    def _discard(self, name: str) -> None:
        """Forget files that were sent, where no scene was made of them."""
        upload = self._uploads.pop(name, None)
        if upload is not None:
            shutil.rmtree(upload.folder, ignore_errors=True)
            self._remove_empty()
        if self._sending == name:
            self._sending = ""
            self._server.post(None, "start", self.state())

    def _remove_empty(self) -> None:
        with contextlib.suppress(OSError):  # other files are coming, or there were none
            for folder in (self._incoming, self._incoming.parent):
                if folder.is_dir():
                    folder.rmdir()

    def _remove_stale(self) -> None:
        """Remove files that pages began to send and gave up, to this viewer or to one that was killed."""
        for name in [*self._uploads]:
            self._discard(name)
        for folder in self._incoming.parent.glob("*"):
            if folder.name.isdecimal() and not _is_alive(int(folder.name)):
                shutil.rmtree(folder, ignore_errors=True)

    def _listed(self, name: str) -> Path:
        """The folder of a scene that can be renamed or deleted. Raises UsageError for any other."""
        folder = self._output / name
        if folder.parent != self._output or not folder.is_dir() or name.startswith("."):
            raise UsageError(f"{name[:60]!r}: no scene of {self._output}")
        if self._progress.stage != "idle" and self._progress.name == name:
            raise UsageError(f"{name} is being made or shown; close it first")
        return folder

    def preview(self, name: str) -> bytes | None:
        """A small picture of a scene of the list, as WebP; None where there is none. As those that are dropped,
        photographs are decoded by a process of its own.
        """
        from ..datamanagers.images import load_preview
        from ..io.images import encode  # imports OpenCV

        path = self.preview_file(name)
        if path is None:
            return None
        key = (path, path.stat().st_mtime_ns)
        with self._preview_lock:
            if key not in self._pictures:
                if self._decoder is None:
                    self._decoder = Uploads()
                try:
                    png = self._decoder.store(path.read_bytes())
                    self._pictures[key] = encode(load_preview(png, _PREVIEW_PIXELS), "webp")
                    png.unlink()
                except DataError:  # training says what is wrong with it
                    self._pictures[key] = b""
            return self._pictures[key] or None

    def preview_file(self, name: str) -> Path | None:
        """The file of a scene's picture: what its page showed last, else its first photograph."""
        root = self._previews.get(name)
        if root is None:
            return None
        found = [root / _PREVIEW]
        for folder in (root, root.with_name(_FILES_FOLDER), root / _FILES_FOLDER, root / "images"):
            if folder.is_dir():
                found += sorted(each for each in folder.rglob("*") if each.suffix.lower() in IMAGE_SUFFIXES)[
                    :1
                ]
        return next((path for path in found if path.is_file()), None)

    def _begin(self, source: Source, name: str, minutes: float) -> None:
        with self._lock:
            self._check_free()
            # One scene is made at a time: training takes all cores.
            self._stopped = ""
            if source.kind != "run":
                folder = self._output / name
            else:
                folder = source.path
            self._progress = StartProgress(name=name, stage="opening", folder=str(folder))
            self._ended.clear()
            self._thread = threading.Thread(
                target=self._make, args=(source, name, minutes), name="fprf-make", daemon=True
            )
            self._thread.start()
        self._server.post(None, "start", self.state())

    def _make(self, source: Source, name: str, minutes: float) -> None:
        """Find poses, train, and open the viewer, as far as the source needs it."""
        root = self._output / name
        path = source.path
        # Each stage works on the folder that the one before made, and a source enters where it has what is
        # needed.
        try:
            if source.kind in ("photographs", "video"):
                self._set(stage="poses", what="looking at the photographs", share=0.0)
                self._call(["process", str(path), "--output", str(root / _SCENE_FOLDER)])
                path = root / _SCENE_FOLDER
            if source.kind in ("photographs", "video", "scene"):
                self._set(stage="training", what="reading photographs", share=0.0, detail="")
                self._train(path, root / _RUN_FOLDER, name, minutes)
            else:
                self._set(stage="opening", what="opening the scene", share=None, detail="")
                self._server.open(partial(self._load, path, name))
            if self._stopped == "leave":
                raise _Left
            self._set(stage="open")
        except _Left:
            self._progress = StartProgress()
            self._server.show_start(self)
        except FprfError as error:
            if source.kind == "capture" and source.path.is_relative_to(root / _FILES_FOLDER):
                shutil.rmtree(root, ignore_errors=True)  # it was refused: nothing is left of what was sent
            self._set(error=str(error))
        except Exception as error:  # whatever it is, the page goes on and the files are there
            self._set(error=f"this should not have happened: {type(error).__name__}: {error}")
        finally:
            with self._lock:
                self._ended.set()
                self._server.wait("ending")

    def _train(self, data: Path, run: Path, name: str, minutes: float) -> None:
        """Train a scene; from its first checkpoint on the viewer shows it."""
        from .following import TrainingFollower

        load = partial(self._load, run, name)
        ended = threading.Event()
        follower = TrainingFollower(self._server, run, load)
        following = threading.Thread(target=follower.run, args=(ended,), name="fprf-follow", daemon=True)
        following.start()
        try:
            place = ["--data", str(data), "--output", str(run)]
            self._call(["train", METHOD, *place, "--minutes", f"{minutes:g}"])
        finally:
            ended.set()
            following.join()
        self._set(stage="opening", what="opening the scene", share=None, detail="")
        follower.tick()
        if follower.session is None:  # the last checkpoint could not be shown before
            self._server.open(load)

    def _call(self, args: Sequence[str]) -> None:
        """Run a verb to its end. Raises DataError with what it says when it fails, `_Left` when it is to be
        left.
        """
        if bool(self._stopped):  # not narrowed by mypy: another thread sets it
            raise _Left
        command = [sys.executable, "-m", "fprf", *args]
        # A group of its own: an interrupt at the terminal is ours alone, and a second one would end it before
        # it has saved.
        with subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            process_group=0,
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
        ) as process:
            self._process = process
            assert process.stdout is not None
            last = ""
            for line in process.stdout:
                if line.strip():
                    last = line.strip()
                    self._read(last)
        # What it has begun, as the worker that finds poses, ends with it.
        _end_group(process, getattr(signal, "SIGKILL", signal.SIGTERM))
        self._process = None
        # An interrupted training has saved what there was, if there was anything; nothing else is worth going
        # on with.
        saved = args[0] == "train" and newest_step(Path(args[args.index("--output") + 1])) >= 0
        if self._stopped == "leave" or (self._stopped and not saved):
            raise _Left
        if process.returncode and not self._stopped:
            raise DataError(
                last.removeprefix("error: ") or f"fprf {args[0]} has ended with {process.returncode}"
            )

    def _read(self, line: str) -> None:
        """Take a line that a process printed: progress as JSON, or a message."""
        try:
            event = json.loads(line)
        except ValueError:
            event = None
        if not isinstance(event, dict) or "event" not in event:
            self._set(lines=(*self._progress.lines, line)[-_MAX_KEPT_LINES:])
            return
        what = str(event["event"])
        # Training tells its step and clock, other verbs how much of something is done; anything else is a
        # line to read.
        if "step" in event:
            clock = f"{event['seconds_left'] // 60}:{event['seconds_left'] % 60:02d} left"
            self._set(
                what=what,
                share=event["share"],
                detail=clock,
            )
        elif "total" in event:
            share = event["done"] / max(1, event["total"])
            self._set(what=what, share=share, detail=f"{event['done']} of {event['total']}")
        else:
            self._set(lines=(*self._progress.lines, what)[-_MAX_KEPT_LINES:])

    def _interrupt(self, then: str) -> None:
        """Let the process that runs save and end; one that does not is killed."""
        self._stopped = then
        process = self._process
        if process is not None:
            _end_group(process, getattr(signal, "CTRL_BREAK_EVENT", signal.SIGINT))
            last = threading.Timer(
                _MAX_EXIT_SECONDS, _end_group, (process, getattr(signal, "SIGKILL", signal.SIGTERM))
            )
            last.daemon = True
            last.start()

    def _tell_ending(self) -> None:
        """Tell pages that what runs is saving, and how much is over of the time that it has for it."""
        what = f"Ending it; what there is is being saved, within {_MAX_EXIT_SECONDS:g} s"
        begun = time.monotonic()
        while not self._ended.is_set():
            with self._lock:
                if not self._ended.is_set():
                    share = (time.monotonic() - begun) / _MAX_EXIT_SECONDS
                    self._server.wait("ending", what, min(1.0, share))
            self._ended.wait(_TOLD_SECONDS)

    def _set(self, **changes: Any) -> None:
        self._tell(replace(self._progress, **changes))

    def _tell(self, progress: StartProgress) -> None:
        self._progress = progress
        self._server.post(None, "start", self.state())

    def _upload(self, name: str) -> SceneFiles:
        if name not in self._uploads:
            raise UsageError("no such scene; begin again by dropping the files")
        return self._uploads[name]

    def _unused(self, asked: str) -> str:
        """A folder's name like the one asked for, that no other scene has."""
        last = asked.replace("\\", "/").rstrip("/").rsplit("/", 1)[-1]
        plain = "".join(c if c.isalnum() or c in "-_" else "-" for c in last)[:40].strip("-") or "scene"
        # A number is added until no folder and no upload has the name.
        name = plain
        for number in count(2):
            if name not in self._uploads and not (self._output / name).exists():
                break
            name = f"{plain}-{number}"
        return name

    def _recent(self) -> list[dict[str, str]]:
        """Scenes and runs on this machine, trained ones first and of each kind the newest."""
        rows: list[tuple[bool, float, dict[str, str]]] = []
        previews = {}
        # Runs of the terminal lie in `runs`, that of the demo in its folder; they are not ours to rename.
        for run in (Path("demo/run"), *(path.parent for path in Path("runs").glob("*/config.json"))):
            if newest_step(run) >= 0:
                name = "demo" if run.parent.name == "demo" else run.name
                rows.append((True, run.stat().st_mtime, _row(run, name, "trained")))
                previews[name] = run
        for folder in self._output.glob("*/"):
            name = folder.name
            run = folder / _RUN_FOLDER
            files = folder / _FILES_FOLDER
            scene = folder / _SCENE_FOLDER
            source = files if files.is_dir() else scene
            if newest_step(run) >= 0:
                # What was stopped before its end can go on, where its photographs are still there.
                progress = training_progress(run)
                stopped = progress is not None and progress["share"] < 1
                kind = (
                    f"stopped at {100 * progress['share']:.0f} %"
                    if progress is not None and stopped
                    else "trained"
                )
                row = _row(run, name, kind)
                if stopped and source.is_dir():
                    row["more"] = str(source.resolve())
                rows.append((True, run.stat().st_mtime, {**row, "scene": name}))
                previews[name] = run
            elif source.is_dir():
                capture = any(is_capture(each) for each in (source, *source.iterdir()))
                kind = "capture" if capture else "not trained yet"
                rows.append((capture, source.stat().st_mtime, {**_row(source, name, kind), "scene": name}))
                previews[name] = folder
        self._previews = previews
        rows.sort(key=lambda row: row[:2], reverse=True)
        return [row for _, _, row in rows[:_MAX_RECENT_SCENES]]


def _row(path: Path, name: str, kind: str) -> dict[str, str]:
    """A scene of the list; `scene` is its folder where it can be renamed and deleted, `more` what it can be
    trained on with.
    """
    when = time.strftime("%d %b %H:%M", time.localtime(path.stat().st_mtime))
    return {
        "path": str(path.resolve()),
        "name": name,
        "kind": kind,
        "when": when,
        "scene": "",
        "more": "",
    }


def _end_group(process: "subprocess.Popen[str]", number: int) -> None:
    """Send a signal to a process and all that it has begun; its group is its own."""
    with contextlib.suppress(OSError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, number)
        else:
            process.send_signal(number)


def _is_alive(process: int) -> bool:
    """True for the number of a process that runs."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
