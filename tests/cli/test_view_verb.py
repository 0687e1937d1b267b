import importlib.util
from pathlib import Path

import pytest

from fprf.cli import main as cli


@pytest.fixture
def with_viser(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())


def test_without_viser_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert cli.main(["view", str(tmp_path)]) == 2
    assert "pip install 'fprf[viewer]'" in capsys.readouterr().err


@pytest.mark.usefixtures("with_viser")
@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["--port", "70000"], "--port"),
        (["--port", "-1"], "--port"),
        (["--pixels", "3"], "--pixels"),
        (["--token", "short"], "--token"),
        (["--host", "no.such.host.invalid", "--port", "0", "--token", "a-long-enough-token"], "--host no.such.host.invalid"),
    ],
)
def test_mistakes_are_one_line(args: list[str], said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert cli.main(["view", str(tmp_path), *args]) == 2
    error = capsys.readouterr().err.strip()
    assert said in error and len(error.splitlines()) == 1


@pytest.mark.usefixtures("with_viser")
def test_a_folder_that_is_no_run_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["view", str(tmp_path), "--port", "0"]) == 2
    out = capsys.readouterr()
    assert "no config.json" in out.err and out.out == "", "no address before there is something to see"
