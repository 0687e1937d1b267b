"""The start page without a browser: the programs that find poses and train are stood in for by a script."""

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from session_helpers import ask, post

from fprf.errors import DataError, FprfError, UsageError
from fprf.viewer import start_page
from fprf.viewer.start_page import StartPage

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
checkpoint.mkdir(parents=True)
(output / "config.json").touch()
(checkpoint / "manifest.json").touch()
line = {{"event": "training", "step": 7, "share": 0.5, "psnr": 20.0, "seconds_left": 61}}
print(json.dumps(line), file=sys.stderr, flush=True)
if args[args.index("--minutes") + 1] != "1":
    time.sleep(100)
"""


@pytest.fixture
def shown() -> list[tuple[Path, str]]:
    return []


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shown: list[tuple[Path, str]]) -> Iterator[StartPage]:
    program = tmp_path / "python"
    program.write_text(PROGRAM)
    program.chmod(0o755)
    monkeypatch.setattr(start_page.sys, "executable", str(program))
    monkeypatch.chdir(tmp_path)

    def show(path: Path, name: str) -> None:
        if path.suffix == ".ply":
            raise DataError("of two dimensions")
        shown.append((path, name))

    made = StartPage(tmp_path / "made", show, shown.clear)
    yield made
    made.close()


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    folder = tmp_path / "yard"
    folder.mkdir()
    for i in range(3):
        (folder / f"{i}.jpg").touch()
    return folder


def until(page: StartPage, **wanted: object) -> Any:
    end = time.monotonic() + 60
    while True:
        state = json.loads(ask(page.routes, "GET", "/fprf/start").body)
        if all(state[key] == value for key, value in wanted.items()):
            return state
        assert time.monotonic() < end, state
        time.sleep(0.02)


def test_photographs_are_posed_trained_and_shown(
    page: StartPage, photographs: Path, tmp_path: Path, shown: list[tuple[Path, str]]
) -> None:
    post(page.routes, "/fprf/start/open", path=f' "{photographs}" ', minutes=1)
    state = until(page, stage="open")
    assert shown == [(tmp_path / "made" / "yard" / "run", "yard")] and state["error"] is None
    assert state["lines"] == ["hello from process", "hello from train"]
    post(page.routes, "/fprf/start/leave")
    recent = until(page, stage="idle")["recent"]
    assert shown == [] and [(row["name"], row["kind"]) for row in recent] == [("yard", "trained")]
    post(page.routes, "/fprf/start/open", path=recent[0]["path"])
    until(page, stage="open")
    assert shown == [(tmp_path / "made" / "yard" / "run", "yard")]


@pytest.mark.parametrize("then", ["show", "leave"])
def test_training_is_stopped_to_show_what_there_is_or_to_leave_it(
    page: StartPage, photographs: Path, shown: list[tuple[Path, str]], then: str
) -> None:
    post(page.routes, "/fprf/start/open", path=str(photographs), minutes=2)
    state = until(page, stage="training", share=0.5)
    assert state["picture"] == 7 and state["detail"] == "step 7 · 20.0 dB · 1:01 left"
    with pytest.raises(UsageError, match="yard is being made"):
        post(page.routes, "/fprf/start/open", path=str(photographs))
    post(page.routes, "/fprf/start/stop", then=then)
    until(page, stage="open" if then == "show" else "idle")
    assert len(shown) == (then == "show")


def test_a_failure_is_told_and_nothing_is_lost(page: StartPage, photographs: Path, tmp_path: Path) -> None:
    (photographs / "bad.jpg").touch()
    post(page.routes, "/fprf/start/open", path=str(photographs))
    until(page, stage="poses", error="3 photographs show nothing in common")
    post(page.routes, "/fprf/start/stop")
    until(page, stage="idle", error=None)
    scene = post(page.routes, "/fprf/start/new", name="../../x/My capture.ply")["scene"]
    assert scene == "My-capture-ply"
    ask(page.routes, "POST", "/fprf/start/piece", b"ply\n", scene=scene, name="x.ply", at=0, size=4)
    post(page.routes, "/fprf/start/make", scene=scene)
    until(page, error="of two dimensions")
    assert (tmp_path / "made" / scene / "files" / "x.ply").read_bytes() == b"ply\n"
    assert post(page.routes, "/fprf/start/new", name="My capture.ply")["scene"] == "My-capture-ply-2"


def test_requests_that_make_no_sense_are_refused(page: StartPage, photographs: Path) -> None:
    empty = post(page.routes, "/fprf/start/new", name="")["scene"]
    place = str(photographs)
    refused: list[tuple[str, dict[str, object]]] = [
        ("make", {"scene": empty}),
        ("make", {"scene": "../yard"}),
        ("open", {}),
        ("open", {"path": "/no/such"}),
        ("open", {"path": place, "minutes": "2"}),
        ("open", {"path": place, "minutes": float("nan")}),
    ]
    for path, asked in refused:
        with pytest.raises(FprfError):
            post(page.routes, f"/fprf/start/{path}", **asked)
    with pytest.raises(UsageError):
        ask(page.routes, "POST", "/fprf/start/piece", b"x", scene=empty, name="a.ply", at="-1", size=4)
    assert ask(page.routes, "GET", "/fprf/start/picture").status == 404
    assert until(page, stage="idle")["folder"] == ""
