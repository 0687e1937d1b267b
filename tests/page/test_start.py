"""The start page without a browser, and following a run: programs that find poses and train are stood in for
by a script.
"""

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from session_helpers import until

from fprf.errors import CheckpointError, DataError, FprfError, UsageError
from fprf.page import EXAMPLES
from fprf.page import start as start_module
from fprf.page.access import Access
from fprf.page.following import TrainingFollower
from fprf.page.messages import Discard, Leave, Make, New, Open, Remove, Rename, Stop
from fprf.page.server import ViewerServer
from fprf.page.session import Viewed, view_of_run
from fprf.page.start import Start
from fprf.page.uploads import training_progress
from fprf.training.driver import is_watched
from fprf.training.loading import open_run

PROGRAM = f"""#!{sys.executable}
import json, pathlib, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where the tests run in the background
verb, args = sys.argv[3], sys.argv[4:]
output = pathlib.Path(args[args.index("--output") + 1])
print("hello from", verb, flush=True)
if verb == "process":
    print(json.dumps({{"event": "matching", "done": 3, "total": 4}}), file=sys.stderr, flush=True)
    if (pathlib.Path(args[0]) / "bad.jpg").exists():
        print("error: 3 photographs show nothing in common", file=sys.stderr)
        sys.exit(2)
    output.mkdir(parents=True)
    (output / "transforms.json").touch()
    sys.exit(0)
assert pathlib.Path(args[args.index("--data") + 1], "transforms.json").is_file()
checkpoint = output / "checkpoints" / "step-0000007"
checkpoint.mkdir(parents=True, exist_ok=True)
(output / "config.json").touch()
(checkpoint / "manifest.json").touch()
line = {{"event": "training", "step": 7, "share": 0.5, "psnr": 20.0, "seconds_left": 61}}
print(json.dumps(line), file=sys.stderr, flush=True)
if args[args.index("--minutes") + 1] == "3":
    (output / "events.jsonl").write_text("\\n" + json.dumps({{**line, "seconds": 9}}))
    time.sleep(1)
    sys.exit("error: out of memory")
if args[args.index("--minutes") + 1] != "1":
    try:
        time.sleep(100)
    except KeyboardInterrupt:
        time.sleep(0.5)  # it saves
"""


class Shown(Start):
    """A start whose server notes what it is to show, and what is posted."""

    def __init__(self, output: Path) -> None:
        self.shown: list[tuple[Path, str]] = []
        self.posted: list[Any] = []
        self.waits: list[tuple[str, str, float | None]] = []
        self.pages = 0
        super().__init__(output, self, self.view)  # type: ignore[arg-type]

    def view(self, path: Path, name: str) -> Any:
        if path.suffix == ".ply":
            raise DataError("of two dimensions")
        self.shown.append((path, name))
        return self

    def open(self, load: Callable[[], Any], *, warm: bool = True) -> Any:
        return load()

    def trained(self, progress: Any) -> None:
        """A session's."""

    def show_start(self, start: Start) -> None:
        self.shown.clear()

    def wait(self, kind: str, what: str = "", share: float | None = None) -> None:
        self.waits.append((kind, what, share))

    def post(self, client: None, kind: str, message: Any) -> None:
        self.posted.append(message)

    def reached(self, **wanted: object) -> Any:
        """The state, as soon as it is so."""
        until(lambda: wanted.items() <= self.state().items())
        return self.state()


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Shown]:
    program = tmp_path / "python"
    program.write_text(PROGRAM)
    program.chmod(0o755)
    monkeypatch.setattr(start_module.sys, "executable", str(program))
    monkeypatch.chdir(tmp_path)
    page = Shown(tmp_path / "made")
    yield page
    page.close()


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    folder = tmp_path / "yard"
    folder.mkdir()
    for i in range(3):
        (folder / f"{i}.jpg").touch()
    return folder


def test_photographs_are_posed_trained_and_shown(page: Shown, photographs: Path, tmp_path: Path) -> None:
    page.handle(Open(path=f' "{photographs}" ', minutes=1))
    state = page.reached(stage="open")
    assert page.shown == [(tmp_path / "made" / "yard" / "run", "yard")] and state["error"] is None
    assert [each["stage"] for each in page.posted][-2:] == ["opening", "open"]
    assert list(state["lines"]) == ["hello from process", "hello from train"]
    page.handle(Leave())
    recent = page.reached(stage="idle")["recent"]
    assert page.shown == [] and [(row["name"], row["kind"]) for row in recent] == [("yard", "trained")]
    page.handle(Open(path=recent[0]["path"]))
    page.reached(stage="open")
    assert page.shown == [(tmp_path / "made" / "yard" / "run", "yard")]


@pytest.mark.parametrize(("asked", "stage"), [(Stop(), "open"), (Leave(), "idle")])
def test_a_scene_in_training_is_shown_until_it_is_left(
    page: Shown, photographs: Path, asked: Any, stage: str
) -> None:
    page.handle(Open(path=str(photographs)))
    state = page.reached(stage="training", share=0.5)
    assert state["detail"] == "1:01 left"
    until(lambda: len(page.shown) == 1)
    # An interrupt at the terminal does not reach it past the viewer, whose own would be the second.
    assert page._process is not None and os.getpgid(page._process.pid) == page._process.pid
    with pytest.raises(UsageError, match="yard is being made"):
        page.handle(Open(path=str(photographs)))
    page.handle(asked)
    until(lambda: not page._busy)
    assert page.reached(stage=stage) and len(page.shown) == (stage == "open")
    ending = [(what, share) for kind, what, share in page.waits if kind == "ending"]
    assert ending[-1] == ("", None), "told as ended"
    if isinstance(asked, Stop):
        shares = [share for what, share in ending if what]
        assert len(shares) > 1 and shares == sorted(shares) and 0 <= shares[0] <= shares[-1] <= 1


def test_a_failure_is_told_and_nothing_is_lost(page: Shown, photographs: Path, tmp_path: Path) -> None:
    (photographs / "bad.jpg").touch()
    page.handle(Open(path=str(photographs)))
    page.reached(stage="poses", error="3 photographs show nothing in common")
    page.handle(Stop())
    page.reached(stage="idle", error=None)
    scene = page.handle(New(name="../../x/My capture.ply"))["scene"]
    assert scene == "My-capture-ply"
    page.piece(scene, "x.ply", 0, 4, b"ply\n")
    page.handle(Make(scene=scene))
    page.reached(error="of two dimensions")
    assert left(tmp_path) == set(), "nothing of what was refused"


def left(tmp_path: Path) -> set[str]:
    """What there is of the scenes on the disk."""
    return {path.name for path in (tmp_path / "made").glob("*")}


def test_nothing_is_left_of_what_was_refused_or_given_up(page: Shown, tmp_path: Path) -> None:
    scene = page.handle(New(name="yard"))["scene"]
    with pytest.raises(UsageError, match="yard is being sent from another page"):
        page.handle(New(name="house"))
    page.piece(scene, "a.ply", 0, 4, b"ply\n")
    assert page.state()["sending"] == "yard" and page.state()["recent"] == []
    page.handle(Discard(scene=scene))
    assert page.state()["sending"] == "" and left(tmp_path) == set()
    # One photograph is no scene.
    scene = page.handle(New(name="yard"))["scene"]
    page.piece(scene, "a.jpg", 0, 4, b"\xff\xd8\xff\xe0")
    with pytest.raises(DataError, match="1 photograph is no scene"):
        page.handle(Make(scene=scene))
    assert left(tmp_path) == set() and page.handle(New(name="yard"))["scene"] == "yard"
    page.handle(Discard(scene="yard"))
    # A page that went away in the middle, and a viewer that was killed.
    page.piece(page.handle(New(name="yard"))["scene"], "a.ply", 0, 9, b"ply\n")
    page._heard -= 100
    killed = tmp_path / "made" / ".incoming" / "999999999" / "yard"
    killed.mkdir(parents=True)
    assert page.handle(New(name="yard"))["scene"] == "yard" and not killed.exists()
    page.piece("yard", "a.ply", 0, 9, b"ply\n")
    page.close()
    assert left(tmp_path) == set()


def test_scenes_are_renamed_and_deleted(page: Shown, photographs: Path, tmp_path: Path) -> None:
    page.handle(Open(path=str(photographs), minutes=1))
    page.reached(stage="open")
    with pytest.raises(UsageError, match="close it first"):
        page.handle(Remove(scene="yard"))
    page.handle(Leave())
    page.reached(stage="idle")
    (tmp_path / "made" / "other").mkdir()
    for wrong in (
        Rename(scene="yard", name="other"),
        Rename(scene="yard", name="../x"),
        Rename(scene="../yard", name="x"),
        Remove(scene="no such"),
        Remove(scene=""),
        Remove(scene="../yard"),
    ):
        with pytest.raises(UsageError):
            page.handle(wrong)
    page.handle(Rename(scene="yard", name="garden"))
    row = page.state()["recent"][0]
    assert (row["name"], row["scene"], row["kind"]) == ("garden", "garden", "trained")
    assert page.preview("yard") is None
    page.handle(Remove(scene="garden"))
    assert page.state()["recent"] == [] and photographs.is_dir() and left(tmp_path) == {"other"}


def test_scenes_that_are_trained_come_first(page: Shown, tmp_path: Path) -> None:
    for number in range(14):
        folder = tmp_path / "made" / f"failed-{number}" / "files"
        folder.mkdir(parents=True)
        (folder / "a.jpg").touch()
    run = tmp_path / "made" / "yard" / "run"
    (run / "checkpoints" / "step-0000007").mkdir(parents=True)
    (run / "checkpoints" / "step-0000007" / "manifest.json").touch()
    os.utime(run, (1, 1))
    recent = page.state()["recent"]
    assert len(recent) == 12 and (recent[0]["name"], recent[0]["kind"]) == ("yard", "trained")
    (run.parent / "files").mkdir()
    shutil.copyfile(EXAMPLES["night.jpg"], run.parent / "files" / "a.jpg")
    assert page.state() and page.preview_file("yard") == run.parent / "files" / "a.jpg"
    picture = page.preview("yard")
    assert picture is not None and cv2.imdecode(np.frombuffer(picture, np.uint8), 1).shape[1] == 320
    (run / "page").mkdir()
    (run / "page" / "preview.png").write_bytes(b"no picture")
    assert page.preview("yard") is None
    assert page.preview_file("yard") == run / "page" / "preview.png"


DEAF = f"""#!{sys.executable}
import pathlib, signal, subprocess, sys, time
signal.signal(signal.SIGINT, signal.SIG_IGN)
deaf = "import signal, time; signal.signal(signal.SIGINT, signal.SIG_IGN); print('ready', flush=True); time.sleep(1000)"
worker = subprocess.Popen([{sys.executable!r}, "-c", deaf], stdout=subprocess.PIPE)
worker.stdout.readline()
print("worker", worker.pid, flush=True)
time.sleep(1000)
"""


def test_nothing_that_was_begun_outlives_a_stop(
    page: Shown, photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "python").write_text(DEAF)
    monkeypatch.setattr(start_module, "_MAX_EXIT_SECONDS", 0.3)
    page.handle(Open(path=str(photographs)))
    until(lambda: bool(page.state()["lines"]))
    worker = int(page.state()["lines"][-1].split()[1])
    assert page._process is not None
    leader = page._process.pid
    page.handle(Stop())
    until(lambda: not page._busy)
    for process in (leader, worker):
        until(lambda process=process: has_ended(process))  # type: ignore[misc]


def has_ended(process: int) -> bool:
    """True where no process has this number, or one that waits to be collected by the system."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


def test_a_training_that_failed_past_its_first_checkpoint_is_put_away(page: Shown, photographs: Path) -> None:
    page.handle(Open(path=str(photographs), minutes=3))
    page.reached(error="out of memory")
    assert len(page.shown) == 1
    page.handle(Stop())
    recent = page.reached(stage="idle")["recent"]
    assert page.shown == [] and [(row["name"], row["kind"]) for row in recent] == [
        ("yard", "stopped at 50 %")
    ]
    page.handle(Open(path=recent[0]["more"]))
    page.reached(name="yard", stage="training", share=0.5)
    page.handle(Leave())
    with pytest.raises(UsageError, match="a scene is being saved"):
        page.handle(Open(path=str(photographs)))


def test_requests_that_make_no_sense_are_refused(page: Shown) -> None:
    empty = page.handle(New(name=""))["scene"]
    page.handle(Discard(scene=empty))
    wrong = (Open(path=" "), Open(path="/no/such"), Open(path="~nobody-here/x"))
    for asked in (Make(scene=empty), Make(scene="../yard"), *wrong):
        with pytest.raises(FprfError):
            page.handle(asked)
    with pytest.raises(UsageError):
        page.piece("../yard", "a.ply", 0, 4, b"x")
    assert page.reached(stage="idle")["folder"] == ""


def test_a_run_is_opened_at_its_first_checkpoint_and_followed(run: Path) -> None:
    newest = max((run / "checkpoints").glob("step-*"))
    hidden = run / "hidden"
    shutil.move(newest, hidden)

    def load() -> Viewed:
        return view_of_run(open_run(run, "cpu"))

    with ViewerServer(Access("127.0.0.1", None), 0) as server:
        follower = TrainingFollower(server, run, load)
        follower.tick()
        assert follower.session is None and not is_watched(run)
        shutil.move(hidden, newest)
        follower.tick()
        session = follower.session
        assert session is not None and session.viewed.step == 15
        follower.tick()
        assert follower.session is session
        server._clients[1] = None  # type: ignore[assignment]  # somebody looks
        follower.tick()
        server._clients.clear()
        assert is_watched(run)


def test_what_cannot_be_opened_is_tried_again_with_the_next_checkpoint(run: Path) -> None:
    def load() -> Viewed:
        raise CheckpointError("damaged")

    with ViewerServer(Access("127.0.0.1", None), 0) as server:
        follower = TrainingFollower(server, run, load)
        with pytest.raises(CheckpointError):
            follower.tick()
        follower.tick()  # not the same one again


def test_progress_is_what_the_last_event_says(run: Path, tmp_path: Path) -> None:
    found = training_progress(run)
    assert found is None or (found["share"] == 1 and found["step"] == 15)
    assert training_progress(tmp_path) is None
