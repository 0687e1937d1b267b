"""The site of the documents: built as it is published, and what is made for it."""

import importlib
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from fprf.cli.main import VERBS

ROOT = Path(__file__).resolve().parents[2]
MISSING = "the extra `docs` is not installed: pip install -e '.[docs]'"


@pytest.fixture(scope="module")
def hooks() -> ModuleType:
    pytest.importorskip("mkdocs", reason=MISSING)
    spec = importlib.util.spec_from_file_location("site_hooks", ROOT / "docs" / "site" / "hooks.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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


@pytest.mark.parametrize(
    ("source", "page", "text", "wanted"),
    [
        ("README.md", "index.md", "[a](docs/method.md#x)", "[a](method.md#x)"),
        ("README.md", "index.md", "[a](CONTRIBUTING.md)", "[a](CONTRIBUTING.md)"),
        ("README.md", "index.md", "![a](docs/images/town.jpg)", "![a](images/town.jpg)"),
        ("docs/method.md", "method.md", "[a](../benchmarks/a.json)", "[a](repository/benchmarks/a.json)"),
        ("docs/python.md", "python.md", "[a](../examples/plugin)", "[a](repository/examples/plugin/README.md)"),
        ("docs/evidence/x.md", "evidence/x.md", "[a](../../README.md)", "[a](../index.md)"),
        ("README.md", "index.md", "[a](https://example.org/a.md) [b](#c)", "[a](https://example.org/a.md) [b](#c)"),
        ("README.md", "index.md", "```\n[a](docs/b.md)\n```", "```\n[a](docs/b.md)\n```"),
    ],
)
def test_links_lead_to_the_same_files(hooks: ModuleType, source: str, page: str, text: str, wanted: str) -> None:
    assert hooks.moved(text, source, page) == wanted
