"""The viewer's side of `fprf train --view`, without a browser: a host that opens no page, lines in, lines out."""

import io
import json
import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from safetensors.torch import save_file
from tiny_world import World

from fprf.training.loading import Trained
from fprf.viewer import live
from fprf.viewer.host import Host
from fprf.viewer.live import Follower, main
from fprf.viewer.restyler import Opener
from fprf.viewer.session import Session
from fprf.viewer.state import State
from fprf.viewer.training import Training


class Doorless(Host):
    """A host without a gate."""

    def __init__(self) -> None:
        self.visited = threading.Event()
        self.session: Session | None = None
        self.opener: Opener | None = None

    def open(self, load: Callable[[], Trained], references: Any, pixels: int, opened: Opener | None = None) -> Session:
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
        self.follower = Follower(self.host, self.lines.append)

    lines: list[dict[str, Any]]

    def tick(self, seconds: float = 0.1) -> list[dict[str, Any]]:
        """What is said after so long."""
        before, self.now = len(self.lines), self.now + seconds
        self.follower.tick(self.now)
        return self.lines[before:]

    def begin(self) -> Session:
        self.follower.hear({"run": str(self.run), "device": "cpu"})
        self.host.visited.set()
        self.tick()
        self.follower.hear({"snapshot": str(self.newest)})
        assert self.host.session is not None
        return self.host.session


@pytest.fixture
def told(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Told]:
    found = Told(world, tmp_path)
    monkeypatch.setattr(live.time, "monotonic", lambda: found.now)
    yield found
    if found.host.session is not None:
        found.host.session.close()


def settle(session: Session) -> None:
    """Until the desk has done what it was asked."""
    done = threading.Event()
    session._desk.do("last", done.set)
    assert done.wait(60)


def test_nothing_is_wanted_before_somebody_comes(told: Told) -> None:
    told.follower.hear({"run": str(told.run), "device": "cpu"})
    assert told.tick() == [] and told.tick(100) == [] and told.host.session is None
    told.host.visited.set()
    assert told.tick() == [{"looking": True}, {"want": True}] and told.tick() == []
    assert told.tick(60) == [{"looking": False}]


def test_who_comes_before_the_run_has_begun_waits_for_it(told: Told) -> None:
    told.host.visited.set()
    assert told.tick() == [{"looking": True}]
    told.follower.hear({"snapshot": str(told.newest)})  # of no run: cannot be
    assert told.host.session is None
    told.follower.hear({"run": str(told.run), "device": "cpu"})
    assert told.tick() == [{"want": True}]


def test_new_parameters_are_wanted_when_everybody_has_seen_the_old_ones(told: Told) -> None:
    session = told.begin()
    session.see(1, session.stage.eye(session.trained.known.cameras, 0))
    assert told.tick(0.1) == [] and told.tick(1.0) == []  # a picture stays for a while
    session._desk.close()  # whoever looks now waits for ever
    session.see(1, session.stage.eye(session.trained.known.cameras, 1))
    assert told.tick(2.0) == [] and not session.idle
    assert told.tick(8.0) == [{"want": True}]  # all the same, after a while
    assert told.tick(8.0) == []  # it has not come yet


def test_the_look_follows_training(told: Told, world: World) -> None:
    session = told.begin()
    model = session.trained.model
    told.follower.hear({"report": [30, 0.25, 19.5, 10.0]})
    assert session.state.training == Training(30, 0.25, 19.5, 30.0)
    spoilt = {name: tensor * 0 for name, tensor in model.state_dict().items()}
    save_file(spoilt, told.newest)
    told.follower.hear({"snapshot": str(told.newest)})
    settle(session)
    assert session.trained.model is model and all(not tensor.any() for tensor in model.state_dict().values())


def test_a_photograph_can_be_dropped_before_training_has_measured_the_scene(told: Told, world: World) -> None:
    session = told.begin()
    card = session.drop(world.references[0].read_bytes(), "dusk.png")
    styled = session.studio.styled(session.state.look)
    assert styled is not None and session.state.look.mix == ((card, 1.0),)
    told.follower.hear({"snapshot": str(told.newest)})
    settle(session)
    assert session.studio.styled(session.state.look) is not styled


def test_at_the_end_the_run_is_what_was_saved(told: Told, world: World) -> None:
    session = told.begin()
    shutil.copy(world.run / "style.safetensors", told.run)
    told.follower.hear({"done": True})
    settle(session)
    assert session.state.training == Training(15, 1.0) and session.trained.step == 15
    assert told.tick(0.5) == [] and not told.follower.over  # somebody looks still
    assert told.tick(60) == [{"looking": False}] and told.follower.over


def test_another_block_is_another_model(told: Told) -> None:
    session = told.begin()
    before = session.trained
    told.follower.hear({"run": str(told.run), "device": "cpu", "block": None, "what": "block 01"})
    told.follower.hear({"snapshot": str(told.newest)})
    settle(session)
    assert session.trained is not before and session.studio.trained is session.trained is session._sight._trained
    told.follower.hear({"report": [3, 0.5, 19.5, 10.0]})
    assert session.state.training == Training(3, 0.5, 19.5, 10.0, "block 01")


def test_an_end_that_nobody_sees_is_the_end(told: Told) -> None:
    told.follower.hear({"done": True})
    assert told.follower.over


def test_the_process_says_where_it_listens_and_ends_with_training() -> None:
    answers = io.StringIO()
    main(io.StringIO('{"host": "127.0.0.1", "port": 0, "strict": true}\n'), answers)
    assert json.loads(answers.getvalue())["address"].startswith("http://127.0.0.1:")


def test_a_port_that_is_taken_is_an_error_or_another_port() -> None:
    first = io.StringIO()
    with Host(live.make_access("127.0.0.1", None), 0, eager=False) as host:
        port = int(host.address.rstrip("/").rpartition(":")[2])
        main(io.StringIO(json.dumps({"host": "127.0.0.1", "port": port, "strict": True}) + "\n"), first)
        assert "cannot listen there" in json.loads(first.getvalue())["error"]
        second = io.StringIO()
        main(io.StringIO(json.dumps({"host": "127.0.0.1", "port": port, "strict": False}) + "\n"), second)
        assert str(port) not in json.loads(second.getvalue())["address"]


def test_lines_that_are_none_end_it() -> None:
    answers = io.StringIO()
    main(io.StringIO('{"host": "127.0.0.1", "port": 0, "strict": false}\n{"run": "/nowhere", "device": "cpu"}\n{'), answers)
    assert "address" in answers.getvalue()
