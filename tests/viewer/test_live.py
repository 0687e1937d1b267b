"""The viewer's side of `fprf train --view`, without a browser: a host that opens no page, lines in, lines out."""

import io
import json
import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from photographs import until
from safetensors.torch import save_file
from stand_in_viewers import DEAD, DEAF, GREEDY, NONSENSE, QUIET, REFUSED, viewer
from tiny_world import World

from fprf.errors import UsageError

pytest.importorskip("uvicorn", reason="the extra `viewer` is not installed")
from fprf.training.loading import Trained
from fprf.training.trainer import Report
from fprf.viewer import live
from fprf.viewer.live import LiveViewer, TrainingFollower, ViewAddress, main
from fprf.viewer.restyler import OpenEncoders
from fprf.viewer.server import ViewerServer, make_access
from fprf.viewer.session import Session
from fprf.viewer.state import State, TrainingProgress


class Doorless(ViewerServer):
    """A host without a gate."""

    def __init__(self) -> None:
        self.visited = threading.Event()
        self.session: Session | None = None
        self.opener: OpenEncoders | None = None

    def open(self, load: Callable[[], Trained], references: Any, pixels: int, opened: OpenEncoders | None = None) -> Session:
        self.session = Session(load(), State(pixels=64), opened)
        self.session.__enter__()
        return self.session


class Told:
    """A follower, what it says, and the clock."""

    def __init__(self, world: World, folder: Path) -> None:
        self.run = folder / "run"
        shutil.copytree(world.run, self.run)
        (self.run / "style.safetensors").unlink()  # training has not come so far
        self.newest = folder / "newest.safetensors"
        save_file(world.load().model.state_dict(), self.newest)
        self.host, self.lines, self.now = Doorless(), [], 100.0
        self.follower = TrainingFollower(self.host, self.lines.append)

    lines: list[dict[str, Any]]

    def tick(self, seconds: float = 0.1) -> list[dict[str, Any]]:
        """What is said after so long."""
        before, self.now = len(self.lines), self.now + seconds
        self.follower.tick(self.now)
        return self.lines[before:]

    def begin(self) -> Session:
        self.follower.receive({"run": str(self.run), "device": "cpu"})
        self.host.visited.set()
        self.tick()
        self.follower.receive({"snapshot": str(self.newest)})
        assert self.host.session is not None
        return self.host.session


@pytest.fixture
def told(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Told]:
    found = Told(world, tmp_path)
    monkeypatch.setattr(live.time, "monotonic", lambda: found.now)
    yield found
    if found.host.session is not None:
        found.host.session.__exit__()


def settle(session: Session) -> None:
    """Until the desk has done what it was asked."""
    done = threading.Event()
    session._worker.run("last", done.set)
    assert done.wait(60)


def test_nothing_is_wanted_before_somebody_comes(told: Told) -> None:
    told.follower.receive({"run": str(told.run), "device": "cpu"})
    assert told.tick() == [] and told.tick(100) == [] and told.host.session is None
    told.host.visited.set()
    assert told.tick() == [{"looking": True}, {"want": True}] and told.tick() == []
    assert told.tick(60) == [{"looking": False}]


def test_new_parameters_are_wanted_when_everybody_has_seen_the_old_ones(told: Told) -> None:
    session = told.begin()
    session.move_camera(1, session.transform.camera_state(session.viewed.scene.cameras, 0))
    assert told.tick(0.1) == [] and told.tick(1.0) == []  # a picture stays for a while
    session._worker.close()  # whoever looks now waits for ever
    session.move_camera(1, session.transform.camera_state(session.viewed.scene.cameras, 1))
    assert told.tick(2.0) == [] and not session.idle
    assert told.tick(8.0) == [{"want": True}]  # all the same, after a while
    assert told.tick(8.0) == []  # it has not come yet


def test_the_look_follows_training(told: Told, world: World) -> None:
    session = told.begin()
    model = session.viewed.scene.model
    told.follower.receive({"report": [30, 0.25, 19.5, 10.0]})
    assert session.state.training == TrainingProgress(30, 0.25, 19.5, 30.0)
    spoilt = {name: tensor * 0 for name, tensor in model.state_dict().items()}
    save_file(spoilt, told.newest)
    told.follower.receive({"snapshot": str(told.newest)})
    settle(session)
    assert session.viewed.scene.model is model and all(not tensor.any() for tensor in model.state_dict().values())


def test_a_photograph_can_be_dropped_before_training_has_measured_the_scene(told: Told, world: World) -> None:
    session = told.begin()
    card = session.upload(world.references[0].read_bytes(), "dusk.png")
    styled = session.restyler.styled(session.state.look)
    assert styled is not None and session.state.look.mix == ((card, 1.0),)
    told.follower.receive({"snapshot": str(told.newest)})
    settle(session)
    assert session.restyler.styled(session.state.look) is not styled


def test_at_the_end_the_run_is_what_was_saved(told: Told, world: World) -> None:
    session = told.begin()
    shutil.copy(world.run / "style.safetensors", told.run)
    told.follower.receive({"done": True})
    settle(session)
    assert session.state.training == TrainingProgress(15, 1.0) and session.viewed.scene.step == 15
    assert told.tick(0.5) == [] and not told.follower.over  # somebody looks still
    assert told.tick(60) == [{"looking": False}] and told.follower.over


def test_a_port_that_is_taken_is_an_error_or_another_port() -> None:
    first = io.StringIO()
    with ViewerServer(make_access("127.0.0.1", None), 0, preload=False) as host:
        port = int(host.address.rstrip("/").rpartition(":")[2])
        main(io.StringIO(json.dumps({"host": "127.0.0.1", "port": port, "strict": True}) + "\n"), first)
        assert "cannot listen there" in json.loads(first.getvalue())["error"]
        second = io.StringIO()
        main(io.StringIO(json.dumps({"host": "127.0.0.1", "port": port, "strict": False}) + "\n"), second)
        assert str(port) not in json.loads(second.getvalue())["address"]


def event(step: int) -> Report:
    return Report(step, step / 100, 1.0, 20.0, 1000.0, 1.0, {"rgb": 0.01}, 0)


@pytest.mark.parametrize("script", [REFUSED, "", "print('[]')"])
def test_a_viewer_that_cannot_start_is_one_line(script: str) -> None:
    with pytest.raises(UsageError, match=r"^--view: (no such place|the viewer did not start)"):
        LiveViewer(ViewAddress(), viewer(script))


def test_who_looks_gets_the_parameters_of_now_and_how_it_goes(world: World, tmp_path: Path) -> None:
    model, log = world.load().model, tmp_path / "log"
    with LiveViewer(ViewAddress(), viewer(GREEDY, str(log))) as view:
        view.begin(world.run, model.state_dict, "cpu")
        until(lambda: log.is_file() and log.read_text().count("snapshot") >= 2, lambda: view(event(7)))
        assert view.looked_at and view.finish(stay=True)  # returns when the viewer says that nobody looks any more
        assert not view.looked_at
        assert not view.finish(stay=True)
    heard = [json.loads(line) for line in log.read_text().splitlines()]
    assert heard[0] == {"run": str(world.run.resolve()), "device": "cpu", "block": None, "what": ""}
    assert {"report": [7, 0.07, 20.0, 1.0]} in heard and heard[-1] == {"done": True}
    assert all(each["names"] == sorted(model.state_dict()) for each in heard if "snapshot" in each)
    assert not list(Path(view._folder.name).parent.glob(Path(view._folder.name).name))


def test_what_is_handed_over_does_not_change_with_the_model(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    model = world.load().model
    said: list[dict[str, object]] = []
    with LiveViewer(ViewAddress(), viewer(QUIET)) as view:
        view.begin(world.run, model.state_dict, "cpu")
        view._looking.set()
        view._wanted.set()
        with monkeypatch.context() as patched:
            patched.setattr(view, "_send", lambda line: said.append(line) if line else None)
            view(event(1))
            view(event(2))  # not wanted any more
    copies = [line["snapshot"] for line in said if "snapshot" in line]
    assert len(copies) == 1 and isinstance(copies[0], dict)
    before = {name: tensor.clone() for name, tensor in copies[0].items()}
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(1.0)
    assert all(torch.equal(copies[0][name], tensor) for name, tensor in before.items())


def test_copies_take_a_bounded_share_of_the_time(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(0, 10_000, 1))  # each look at the clock is a second later: a copy takes one
    monkeypatch.setattr(live.time, "perf_counter", lambda: float(next(clock)))
    with LiveViewer(ViewAddress(), viewer(QUIET)) as view:
        view.begin(world.run, world.load().model.state_dict, "cpu")
        view._looking.set()
        copies = 0
        for step in range(200):
            view._wanted.set()
            view(event(step))
            copies += not view._wanted.is_set()
    assert 2 <= copies <= 200 / 20 + 1


@pytest.mark.parametrize("script", [DEAF, NONSENSE, DEAD])
def test_no_viewer_holds_training_up(world: World, script: str) -> None:
    with LiveViewer(ViewAddress(), viewer(script)) as view:
        view.begin(world.run, world.load().model.state_dict, "cpu")
        until(lambda: view.looked_at or view.fault is not None)
        for step in range(500):
            view(event(step))
        if script is DEAD:
            until(lambda: view.fault is not None)
            assert view.fault == "RuntimeError: it fell over"
        if script is not DEAF:
            until(lambda: not view.looked_at)
            assert not view.finish(stay=True)
        else:
            view.finish(stay=False)


def test_lines_that_are_none_end_it() -> None:
    answers = io.StringIO()
    main(io.StringIO('{"host": "127.0.0.1", "port": 0, "strict": false}\n{"run": "/nowhere", "device": "cpu"}\n{'), answers)
    assert "address" in answers.getvalue()


def test_an_end_that_nobody_sees_is_the_end(told: Told) -> None:
    told.follower.receive({"done": True})
    assert told.follower.over
