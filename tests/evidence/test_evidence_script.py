"""One command makes every page: its command lines are valid, and the index names what they write."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

from fprf.cli import main as cli
from fprf.cli.parsing import parse
from fprf.evidence.config import PaperConfig, RestyleConfig

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    path = ROOT / "benchmarks/evidence.py"
    spec = importlib.util.spec_from_file_location("evidence_pages", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "evidence_pages", module)
    spec.loader.exec_module(module)
    return module


def test_every_command_is_understood(script: ModuleType) -> None:
    config = script.EvidencePages()
    pages = set()
    for name in script.NAMES:
        bench, kind, *rest = script.command(name, config)
        assert bench == "bench" and kind in ("restyle", "paper")
        if kind == "restyle":
            made = parse(RestyleConfig(), ["--run", *rest], prog="bench", description="")
            assert made.sheet is not None and made.sheet.suffix == ".jpg"
        else:
            made = parse(PaperConfig(), rest, prog="bench", description="")
            assert made.table == ("reconstruction" if name in script.SCENES else name)
        assert made.output is not None and made.page is not None and made.device == "cpu"
        pages.add(made.page)
    assert len(pages) == len(script.NAMES), "no page is written twice"


def test_the_index_names_every_page(script: ModuleType) -> None:
    index = (ROOT / "docs/evidence/README.md").read_text(encoding="utf-8")
    for name in script.NAMES:
        _, _, *rest = script.command(name, script.EvidencePages())
        page = Path(rest[rest.index("--page") + 1])
        if page.is_file():
            assert f"]({page.name})" in index, f"{page.name} is not in the index"


def test_only_what_is_asked_for_is_made(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calls: list[list[str]] = []
    monkeypatch.setattr(cli, "main", lambda args: calls.append(args) or 3 * (args[0] == "bench"))
    monkeypatch.setattr(sys, "argv", ["evidence.py", "--only", "time", "reconstruction", "--runs", str(tmp_path)])
    monkeypatch.setattr(script, "parse", lambda config, *rest, **more: replace(parse(config, *rest, **more), scenes=tmp_path))
    assert script.main() == 3, "the worst of all codes"
    train, table = calls
    assert train[:2] == ["train", "fprf-lite"] and str(tmp_path / "town") in train
    assert table[:4] == ["bench", "paper", "--table", "time"]
    assert "reconstruction: skipped" in capsys.readouterr().err
    (tmp_path / "town").mkdir()
    (tmp_path / "town/style.safetensors").touch()
    calls.clear()
    script.main()
    assert [call[0] for call in calls] == ["bench"], "a run that is there is used"


def test_pages_that_do_not_exist(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["evidence.py", "--only", "weather"])
    assert script.main() == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "weather" in error and "large-scale" in error
