import json
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from stand_in_viewers import DEAD, DEAF, GREEDY, NONSENSE, QUIET, REFUSED, viewer
from tiny_world import World

from fprf.errors import UsageError
from fprf.training.trainer import Report
from fprf.viewer import aside
from fprf.viewer.aside import Aside, Place


def event(step: int) -> Report:
    return Report(step, step / 100, 1.0, 20.0, 1000.0, 1.0, {"rgb": 0.01}, 0)


def until(true: Callable[[], bool], act: Callable[[], object] = lambda: None) -> None:
    end = time.monotonic() + 60
    while not true():
        assert time.monotonic() < end
        act()
        time.sleep(0.01)


def test_the_viewer_is_told_where_to_listen_and_says_where_it_does() -> None:
    with Aside(Place("127.0.0.1", 0), viewer(QUIET)) as view:
        assert view.address == "http://here/" and not view.looked_at and view.fault is None


@pytest.mark.parametrize("script", [REFUSED, "", "print('hello')", "print('[]')", "raise SystemExit(3)"])
def test_a_viewer_that_cannot_start_is_one_line(script: str) -> None:
    with pytest.raises(UsageError, match=r"^--view: (no such place|the viewer did not start)"):
        Aside(Place(), viewer(script))


def test_while_nobody_looks_nothing_is_copied_and_nothing_sent(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    with Aside(Place(), viewer(QUIET)) as view:
        view.begin(world.run, world.load().model, "cpu")
        with monkeypatch.context() as patched:
            patched.setattr(view, "_put", None)
            patched.setattr(view, "_model", None)
            for step in range(1000):
                view(event(step))


def test_who_looks_gets_the_parameters_of_now_and_how_it_goes(world: World, tmp_path: Path) -> None:
    model, log = world.load().model, tmp_path / "log"
    with Aside(Place(), viewer(GREEDY, str(log))) as view:
        view.begin(world.run, model, "cpu")
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
    with Aside(Place(), viewer(QUIET)) as view:
        view.begin(world.run, model, "cpu")
        view._looking.set()
        view._wanted.set()
        monkeypatch.setattr(view, "_put", lambda line: said.append(line) if line else None)
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
    monkeypatch.setattr(aside.time, "perf_counter", lambda: float(next(clock)))
    with Aside(Place(), viewer(QUIET)) as view:
        view.begin(world.run, world.load().model, "cpu")
        view._looking.set()
        copies = 0
        for step in range(200):
            view._wanted.set()
            view(event(step))
            copies += not view._wanted.is_set()
    assert 2 <= copies <= 200 / 20 + 1


@pytest.mark.parametrize("script", [DEAF, NONSENSE, DEAD])
def test_no_viewer_holds_training_up(world: World, script: str) -> None:
    with Aside(Place(), viewer(script)) as view:
        view.begin(world.run, world.load().model, "cpu")
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


def test_places() -> None:
    assert Place() == ("127.0.0.1", 8080, False)
