import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from fprf.cli import main as cli
from fprf.cli.main import VERBS
from fprf.cli.parsing import describe


@dataclass(frozen=True, kw_only=True)
class Plain:
    """A config."""

    run: Path = Path()
    """Where it lies,
    over two lines."""
    size: int | None = None
    """How large."""
    loud: bool = True
    bare: tuple[int, ...] = (1, 2)


def told(config: Any, *positional: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(describe(config, prog="p", description="d", positional=positional))
    return found


def test_a_config_in_words() -> None:
    found = told(Plain(), "run")
    assert (found["prog"], found["description"], found["slots"]) == ("p", "d", [])
    assert [row["flag"] for row in found["flags"]] == ["run", "--size", "--loud", "--bare"]
    run, size, loud, bare = found["flags"]
    assert run["positional"] and not size["positional"]
    assert run["meaning"] == "Where it lies, over two lines." and loud["meaning"] == ""
    assert [row["default"] for row in (run, size, loud, bare)] == ["", "none", "true", "1 2"]
    assert "none" in size["takes"]


@pytest.mark.parametrize("verb", sorted(VERBS.keys() - {"completion"}))
def test_every_verb_describes_itself_and_every_flag_has_a_meaning(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    word = {"train": ["fprf-lite"], "bench": ["speed"], "pretrain": ["decoder"]}.get(verb, [])
    assert cli.main([verb, *word, "--describe"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["prog"].startswith(f"fprf {verb}") and found["description"]
    assert found["flags"] and [row["flag"] for row in found["flags"] if not row["meaning"]] == []
