import io
import json
import sys
import types

import pytest
from rich.console import Console

from fprf import progress
from fprf.progress import Display, Progressed, Report


def report(step: int, share: float) -> Report:
    return Report(step, share, 12.34, 20.123, 1000.4, 0.5, {"rgb": 0.01}, 0)


def test_off_a_terminal_lines_come_every_few_seconds_and_at_the_end(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr(progress.time, "perf_counter", lambda: now[0])
    with Display() as display:
        display.say("begin [bold]")
        for step in range(1, 21):
            now[0] += 1.0
            display.training(report(step, step / 20))
    out, err = capsys.readouterr()
    assert out == "" and "\x1b" not in err
    found = [json.loads(line) for line in err.splitlines()]
    assert found[0] == {"event": "begin [bold]"}
    assert [e["step"] for e in found[1:]] == [1, 6, 11, 16, 20]
    rounded = {"share": 1.0, "seconds": 12.3, "psnr": 20.12, "rays_per_second": 1000, "seconds_left": 0}
    assert found[-1] == {"event": "training", "step": 20, **rounded}
    assert found[1]["seconds_left"] == round(12.34 * 0.95 / 0.05)


def test_a_terminal_sees_a_bar_and_no_json(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    made = Console(file=screen, force_terminal=True, width=120, highlight=False)
    monkeypatch.setattr(progress, "Console", lambda **named: made)
    with Display() as display:
        display.say("a town [of] 3")
        display.training(report(5, 0.0))
        display.training(report(7, 0.5))
        display.count(1, 2, "rendering")
    text = screen.getvalue()
    assert (
        "a town [of] 3" in text
        and "step 7" in text
        and "20.12 dB" in text
        and "rendering" in text
        and "{" not in text
    )


def test_a_notebook_sees_one_bar_for_each_step(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shown: list[str] = []

    class Handle:
        def update(self, text: str) -> None:
            shown[-1] = text

    def display(text: str, *, display_id: bool) -> Handle:
        assert display_id
        shown.append(text)
        return Handle()

    stand_in = types.ModuleType("IPython.display")
    stand_in.HTML = str  # type: ignore[attr-defined]
    stand_in.display = display  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "IPython.display", stand_in)
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setattr(progress, "CELL_SECONDS", 0.0)
    with Display() as bar:
        bar.say("a town [of] 3")
        bar.count(1, 2, "<features>")
        bar.training(report(5, 0.25))
        bar.training(report(7, 0.5))
    out, err = capsys.readouterr()
    assert len(shown) == 2 and "&lt;features&gt; 50%" in shown[0] and "step 7" in shown[1]
    assert err == "a town [of] 3\n" and not out


def test_a_listener_is_told_whatever_is_shown() -> None:
    told: list[Progressed] = []
    with Display(quiet=True, listener=told.append) as display:
        display.count(1, 4, "features")
        display.training(report(7, 0.5))
    assert [(each.what, each.share) for each in told] == [("features", 0.25), ("training", 0.5)]
