"""The viewer's side of `fprf train --view`, without a browser: a server that opens no page, lines in, lines out."""

import io
import json
import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from session_helpers import camera_of, until
from stand_in_viewers import DEAD, DEAF, GREEDY, NONSENSE, QUIET, REFUSED, viewer
from tiny_world import World

from fprf.errors import UsageError

pytest.importorskip("uvicorn", reason="the extra `viewer` is not installed")
from fprf.training.trainer import Report
from fprf.viewer import live
from fprf.viewer.live import LiveViewer, TrainingFollower, ViewAddress, main
from fprf.viewer.restyler import OpenEncoders
from fprf.viewer.server import ViewerServer, make_access
from fprf.viewer.session import Session, Viewed
from fprf.viewer.state import State, TrainingProgress


class SessionServer(ViewerServer):
    """A server that listens nowhere."""

    def __init__(self) -> None:
        self.visited = threading.Event()
        self.session: Session | None = None

    def open(self, load: Callable[[], Viewed], references: Any, pixels: int, opened: OpenEncoders | None = None) -> Session:
        self.session = Session(load(), State(pixels=64), opened).__enter__()
        return self.session


class Following:
    """A follower of a run that is still trained, what it tells, and the clock."""

    def __init__(self, run: Path, newest: Path, tensors: dict[str, torch.Tensor]) -> None:
        (run / "style.safetensors").unlink()  # training has not come so far
        save_file(tensors, newest)
        self.run, self.newest, self.lines, self.now = run, newest, list[dict[str, Any]](), 100.0
        self.server = SessionServer()
        self.follower = TrainingFollower(self.server, self.lines.append)

    def tick(self, seconds: float = 0.1) -> list[dict[str, Any]]:
        """What is told after so long."""
        before, self.now = len(self.lines), self.now + seconds
        self.follower.tick(self.now)
        return self.lines[before:]

    def receive(self, **line: object) -> None:
        self.follower.receive(line)
        if self.server.session is not None:  # until the worker has done what it was asked
            done = threading.Event()
            self.server.session._worker.run("last", done.set)
            assert done.wait(60)

    def begin(self) -> Session:
        self.receive(run=str(self.run), device="cpu")
        self.server.visited.set()
        self.tick()
        self.receive(snapshot=str(self.newest))
        assert self.server.session is not None
        return self.server.session


@pytest.fixture
def following(world: World, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Following]:
    found = Following(run, tmp_path / "newest.safetensors", world.load().model.state_dict())
    monkeypatch.setattr(live.time, "monotonic", lambda: found.now)
    yield found
    if found.server.session is not None:
        found.server.session.__exit__()


def test_nothing_is_wanted_before_somebody_comes(following: Following) -> None:
    following.receive(run=str(following.run), device="cpu")
    assert following.tick() == [] and following.tick(100) == [] and following.server.session is None
    following.server.visited.set()
    assert following.tick() == [{"looking": True}, {"want": True}] and following.tick() == []
    assert following.tick(60) == [{"looking": False}]
    following.receive(done=True)
    assert following.follower.over


def test_new_parameters_are_wanted_when_all_clients_have_seen_the_old_ones(following: Following) -> None:
    session = following.begin()
    session.move_camera(1, camera_of(session.viewed.scene, 0))
    assert following.tick(0.1) == [] and following.tick(1.0) == []  # a picture stays for a while
    session._worker.close()  # whoever looks now waits for ever
    session.move_camera(1, camera_of(session.viewed.scene, 1))
    assert following.tick(2.0) == [] and not session.idle
    assert following.tick(8.0) == [{"want": True}]  # all the same, after a while
    assert following.tick(8.0) == []  # it has not come yet


def test_the_scene_follows_training_to_what_was_saved(following: Following, world: World) -> None:
    session = following.begin()
    model = session.viewed.scene.model
    following.receive(report=[30, 0.25, 19.5, 10.0])
    assert session.state.training == TrainingProgress(30, 0.25, 19.5, 30.0)
    card = session.upload(world.references[0].read_bytes(), "dusk.png")  # before training has measured the scene
    styled = session.restyler.styled(session.state.look)
    assert styled is not None and session.state.look.mix == ((card, 1.0),)
    session.select_region(1)
    following.receive(snapshot=str(following.newest))
    assert session.restyler.styled(session.state.look) is not styled
    assert session.state.picked is not None and session.state.picked.region == 1  # measured again, from the same parameters
    save_file({name: tensor * 0 for name, tensor in model.state_dict().items()}, following.newest)
    following.receive(snapshot=str(following.newest))
    assert session.viewed.scene.model is model and all(not tensor.any() for tensor in model.state_dict().values())
    shutil.copy(world.run / "style.safetensors", following.run)
    following.receive(done=True)
    assert session.state.training == TrainingProgress(15, 1.0) and session.viewed.scene.step == 15
    assert following.tick(0.5) == [] and not following.follower.over  # somebody looks still
    assert following.tick(60) == [{"looking": False}] and following.follower.over


def answers_of(lines: str) -> str:
    answers = io.StringIO()
    main(io.StringIO(lines), answers)
    return answers.getvalue()


def test_a_port_that_is_taken_is_an_error_or_another_port() -> None:
    with ViewerServer(make_access("127.0.0.1", None), 0, preload=False) as server:
        port = int(server.address.rstrip("/").rpartition(":")[2])
        first, second = (
            json.loads(answers_of(json.dumps({"host": "127.0.0.1", "port": port, "strict": strict}) + "\n"))
            for strict in (True, False)
        )
    assert "cannot listen there" in first["error"] and str(port) not in second["address"]


def test_lines_that_are_not_json_end_the_viewer() -> None:
    lines = '{"host": "127.0.0.1", "port": 0, "strict": false}\n{"run": "/nowhere", "device": "cpu"}\n{'
    assert "address" in answers_of(lines)


def report(step: int) -> Report:
    return Report(step, step / 100, 1.0, 20.0, 1000.0, 1.0, {"rgb": 0.01}, 0)


@pytest.mark.parametrize("script", [REFUSED, "", "print('[]')"])
def test_a_viewer_that_cannot_start_is_a_mistake_of_the_user(script: str) -> None:
    with pytest.raises(UsageError, match=r"^--view: (no such place|the viewer did not start)"):
        LiveViewer(ViewAddress(), viewer(script))


def test_a_viewer_that_looks_gets_the_present_parameters_and_progress(world: World, tmp_path: Path) -> None:
    model, log = world.load().model, tmp_path / "log"
    with LiveViewer(ViewAddress(), viewer(GREEDY, str(log))) as view:
        view.begin(world.run, model.state_dict, "cpu")
        until(lambda: log.is_file() and log.read_text().count("snapshot") >= 2, lambda: view(report(7)))
        assert view.looked_at and view.finish(stay=True)  # returns when the viewer says that nobody looks any more
        assert not view.looked_at and not view.finish(stay=True)
    heard = [json.loads(line) for line in log.read_text().splitlines()]
    assert heard[0] == {"run": str(world.run.resolve()), "device": "cpu", "block": None, "what": ""}
    assert {"report": [7, 0.07, 20.0, 1.0]} in heard and heard[-1] == {"done": True}
    assert all(each["names"] == sorted(model.state_dict()) for each in heard if "snapshot" in each)
    assert not Path(view._folder.name).exists()


def test_a_snapshot_does_not_change_with_the_model(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    model = world.load().model
    said: list[dict[str, Any]] = []
    with LiveViewer(ViewAddress(), viewer(QUIET)) as view:
        view.begin(world.run, model.state_dict, "cpu")
        view._looking.set()
        view._wanted.set()
        with monkeypatch.context() as patched:
            patched.setattr(view, "_send", lambda line: said.append(line) if line else None)
            view(report(1))
            view(report(2))  # not wanted any more
    [copy] = [line["snapshot"] for line in said if "snapshot" in line]
    before = {name: tensor.clone() for name, tensor in copy.items()}
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(1.0)
    assert all(torch.equal(copy[name], tensor) for name, tensor in before.items())


def test_copies_take_a_bounded_share_of_the_time(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(0, 10_000, 1))  # each look at the clock is a second later: a copy takes one
    monkeypatch.setattr(live.time, "perf_counter", lambda: float(next(clock)))
    with LiveViewer(ViewAddress(), viewer(QUIET)) as view:
        view.begin(world.run, world.load().model.state_dict, "cpu")
        view._looking.set()
        copies = 0
        for step in range(200):
            view._wanted.set()
            view(report(step))
            copies += not view._wanted.is_set()
    assert 2 <= copies <= 200 / 20 + 1


@pytest.mark.parametrize("script", [DEAF, NONSENSE, DEAD])
def test_no_viewer_holds_training_up(world: World, script: str) -> None:
    with LiveViewer(ViewAddress(), viewer(script)) as view:
        view.begin(world.run, world.load().model.state_dict, "cpu")
        until(lambda: view.looked_at or view.fault is not None)
        for step in range(500):
            view(report(step))
        if script is DEAD:
            until(lambda: view.fault is not None)
            assert view.fault == "RuntimeError: it fell over"
        if script is not DEAF:
            until(lambda: not view.looked_at)
            assert not view.finish(stay=True)
        else:
            view.finish(stay=False)
