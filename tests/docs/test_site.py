"""The site of the documents: built as it is published, and what is made for it."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from fprf.cli.main import VERBS

ROOT = Path(__file__).resolve().parents[2]
MISSING = "the extra `docs` is not installed: pip install -e '.[docs]'"


def test_it_builds_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason=MISSING)
    pytest.importorskip("material", reason=MISSING)
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-f", str(ROOT / "mkdocs.yml"), "-d", str(tmp_path)]
    quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    made = subprocess.run(command, capture_output=True, text=True, check=False, env=quiet)
    assert made.returncode == 0 and "WARNING" not in made.stderr, made.stderr
    assert {path.stem for path in (tmp_path / "verbs").glob("*.html")} == set(VERBS)
    for page in [tmp_path / "index.html", tmp_path / "verbs" / "export.html"]:
        text = page.read_text()
        assert not re.search(r'<(?:script|img)[^>]+src="https?:|<link[^>]+rel="stylesheet"[^>]+href="https?:', text)
    assert "restyle" in (tmp_path / "search" / "search_index.json").read_text()
