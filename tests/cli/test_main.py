import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from fprf.cli import main as cli
from fprf.errors import DataError


def _verb(monkeypatch: pytest.MonkeyPatch, run: Callable[[list[str]], int]) -> None:
    module = ModuleType("fprf.cli.doctor")
    module.run = run  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "fprf.cli.doctor", module)
    monkeypatch.delenv("FPRF_DEBUG", raising=False)


def _raising(error: BaseException) -> Callable[[list[str]], int]:
    def run(args: list[str]) -> int:
        raise error

    return run


def test_help_lists_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    for name, verb in cli.VERBS.items():
        assert any(line.split()[:1] == [name] and verb.summary in line for line in text.splitlines())
    assert max(map(len, text.splitlines())) <= 110
    assert "\x1b" not in text, "no colours into a pipe"


def test_no_verb_is_a_mistake_that_shows_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2
    assert "usage: fprf VERB" in capsys.readouterr().out


def test_an_unknown_verb_suggests_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["trian"]) == 2
    assert capsys.readouterr().err.startswith("error: fprf trian: no such verb; did you mean 'train'? (verbs: demo,")


def test_arguments_and_exit_code_pass_through(monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[list[str]] = []

    def run(args: list[str]) -> int:
        heard.append(args)
        return 7

    _verb(monkeypatch, run)
    assert cli.main(["doctor", "a", "--b"]) == 7
    assert cli.main(["doctor", "a", "--debug"]) == 7
    assert heard == [["a", "--b"], ["a"]]


def test_a_users_mistake_is_one_line_and_2(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    _verb(monkeypatch, _raising(DataError("x.jpg: broken; remove it")))
    assert cli.main(["doctor"]) == 2
    assert capsys.readouterr() == ("", "error: x.jpg: broken; remove it\n")


def test_our_fault_is_short_and_1(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    _verb(monkeypatch, _raising(ZeroDivisionError("by nought")))
    assert cli.main(["doctor"]) == 1
    text = capsys.readouterr().err
    assert text.startswith("internal error: ZeroDivisionError: by nought (") and "test_main.py:" in text
    assert "Traceback" not in text and "--debug" in text


@pytest.mark.parametrize("switch", ["flag", "environment"])
def test_debug_shows_the_traceback(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], switch: str) -> None:
    _verb(monkeypatch, _raising(ZeroDivisionError("by nought")))
    if switch == "environment":
        monkeypatch.setenv("FPRF_DEBUG", "1")
    assert cli.main(["doctor", *(["--debug"] if switch == "flag" else [])]) == 1
    assert "Traceback (most recent call last)" in capsys.readouterr().err


def test_an_interrupt_is_130(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    _verb(monkeypatch, _raising(KeyboardInterrupt()))
    assert cli.main(["doctor"]) == 130
    assert capsys.readouterr().err == "interrupted\n"


@pytest.mark.parametrize(("code", "wanted"), [(None, 0), (0, 0), (5, 5), ("text", 1)])
def test_an_exit_is_a_code(monkeypatch: pytest.MonkeyPatch, code: int | str | None, wanted: int) -> None:
    _verb(monkeypatch, _raising(SystemExit(code)))
    assert cli.main(["doctor"]) == wanted


def test_a_reader_that_leaves_is_met_with_silence() -> None:
    read, write = os.pipe()
    os.close(read)
    ended = subprocess.run(
        [sys.executable, "-m", "fprf", "--help"], stdout=write, stderr=subprocess.PIPE, timeout=60, check=False
    )
    os.close(write)
    assert (ended.returncode, ended.stderr) == (141, b"")


def test_python_m_works_from_anywhere(tmp_path: Path) -> None:
    ended = subprocess.run(
        [sys.executable, "-m", "fprf", "plugins", "--nope"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr == "error: --nope: no such flag; `fprf plugins --help` lists all\n"
