import os
import subprocess
import sys
from collections.abc import Callable
from unittest.mock import Mock, call

import pytest

from fprf.cli import main as cli
from fprf.errors import DataError


def _verb(monkeypatch: pytest.MonkeyPatch, run: Callable[[list[str]], int]) -> None:
    monkeypatch.setattr("fprf.cli.doctor.run", run)
    monkeypatch.delenv("FPRF_DEBUG", raising=False)


def test_help_lists_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    for name, verb in cli.VERBS.items():
        assert any(line.split()[:1] == [name] and verb.summary in line for line in text.splitlines())
    assert max(map(len, text.splitlines())) <= 110
    assert "\x1b" not in text, "no colours into a pipe"


def test_arguments_and_exit_code_pass_through(monkeypatch: pytest.MonkeyPatch) -> None:
    run = Mock(return_value=7)
    _verb(monkeypatch, run)
    assert cli.main(["doctor", "a", "--b"]) == 7
    assert cli.main(["doctor", "a", "--debug"]) == 7
    assert run.call_args_list == [call(["a", "--b"]), call(["a"])]


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (DataError("x.jpg: broken; remove it"), 2, "error: x.jpg: broken; remove it\n"),
        (MemoryError(), 2, None),
        (KeyboardInterrupt(), 130, "interrupted\n"),
        (SystemExit(None), 0, ""),
        (SystemExit(5), 5, ""),
        (SystemExit("text"), 1, None),
    ],
)
def test_how_a_verb_ends(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: BaseException, code: int, said: str | None
) -> None:
    _verb(monkeypatch, Mock(side_effect=error))
    assert cli.main(["doctor"]) == code
    out, err = capsys.readouterr()
    assert out == "" and (said is None or err == said) and err.count("\n") <= 1


def test_our_fault_is_1_and_short_or_with_debug_whole(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _verb(monkeypatch, lambda args: 1 // 0)
    assert cli.main(["doctor"]) == 1
    text = capsys.readouterr().err
    assert text.startswith("internal error: ZeroDivisionError: ") and "test_main.py:" in text
    assert "Traceback" not in text and "--debug" in text
    assert cli.main(["doctor", "--debug"]) == 1
    assert "Traceback (most recent call last)" in capsys.readouterr().err
    monkeypatch.setenv("FPRF_DEBUG", "1")
    assert cli.main(["doctor"]) == 1
    assert "Traceback (most recent call last)" in capsys.readouterr().err


def test_a_reader_that_leaves_is_met_with_silence() -> None:
    read, write = os.pipe()
    os.close(read)
    ended = subprocess.run(
        [sys.executable, "-m", "fprf", "--help"], stdout=write, stderr=subprocess.PIPE, timeout=60, check=False
    )
    os.close(write)
    assert (ended.returncode, ended.stderr) == (141, b"")
