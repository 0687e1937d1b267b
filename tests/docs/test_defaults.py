"""The page of defaults says the values that the configs have."""

import json
import re
from pathlib import Path

import pytest

from fprf.cli import main as cli

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "defaults.md").read_text("utf-8")
SECTIONS = dict(re.findall(r"^## fprf (.*?)\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE))
ROW = re.compile(r"^\| `(--[\w.-]+)` \| `([^`]*)` \| (.+) \| .*\|$", re.MULTILINE)


@pytest.mark.parametrize("title", SECTIONS)
def test_it_says_the_values_of_the_configs(title: str, capsys: pytest.CaptureFixture[str]) -> None:
    rows = ROW.findall(SECTIONS[title])
    assert len(rows) > 5 and len(rows) == SECTIONS[title].count("\n| `--"), "a row that the pattern does not read"
    assert cli.main([*title.partition(",")[0].split(), "--describe"]) == 0
    known = json.loads(capsys.readouterr().out)
    values = {row["flag"]: row["default"] for row in [*known["flags"], *known["slots"]]}
    assert {flag: value for flag, value, _ in rows} == {flag: values.get(flag) for flag, _, _ in rows}
    assert all(why.strip() for _, _, why in rows)
