"""What the documents name exists: files, modules, anchors and flags; the site builds."""

import importlib.util
import os
import re
import subprocess
import sys
from dataclasses import fields as dataclass_fields
from dataclasses import is_dataclass
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from fprf.cli import main as cli
from fprf.cli.main import VERBS

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
LEGENDS = [ROOT / "fprf/interfaces.py", ROOT / "pyproject.toml"]
"""Files beside the documents that say where a newcomer adds what."""
FILE = re.compile(r"`((?:fprf|tests|benchmarks|tools|examples)/[\w./+-]+)`")
BELOW = re.compile(
    r"`((?:blocks|cli|datamanagers|evaluation|export|fields|io|ops|page|plugins|rendering|splats|style|training)/[\w/]+\.py)`"
)
MODULE = re.compile(r"`(fprf(?:\.\w+)+)`")
LINK = re.compile(r"\]\((?!https?:)([^)#\s]*)(#[\w-]*)?\)")
FLAG = re.compile(r"`(--[a-z][\w.-]*)")
OTHERS = {
    "--no-compile",
    "--check",
    "--strict",
    "--scene",
    "--view",
    "--changed-images",
    "--clean",
    "--help",
    "--gentle",
}
"""Of pip, mkdocs and `benchmarks/gpu.sh`, and words that verbs take before their flags are parsed."""


def anchor(title: str) -> str:
    return "#" + re.sub(r"[^\w -]", "", title.lower()).strip().replace(" ", "-")


@pytest.mark.parametrize("page", [*PAGES, *LEGENDS], ids=lambda page: page.stem)
def test_paths_modules_and_anchors_exist(page: Path) -> None:
    text = page.read_text("utf-8")
    missing = [name for name in FILE.findall(text) if not (ROOT / name).exists()]
    missing += [name for name in BELOW.findall(text) if not (ROOT / "fprf" / name).exists()]
    for name in MODULE.findall(text):
        parts = name.split(".")
        found = [n for n in range(1, len(parts) + 1) if _is_module(".".join(parts[:n]))]
        if max(found) < len(parts) - 2:
            missing.append(name)
    for target, fragment in LINK.findall(text):
        path = page if not target else (page.parent / target).resolve()
        if not path.exists():
            missing.append(target)
        elif fragment and path.suffix == ".md":
            titles = re.findall(r"^#+ (.*)$", path.read_text("utf-8"), re.MULTILINE)
            if fragment not in map(anchor, titles):
                missing.append(target + fragment)
    assert not missing


def _is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:
        return False


def test_flags_exist(capsys: pytest.CaptureFixture[str]) -> None:
    for verb in VERBS:
        for method in ("fprf", "fprf-lite", "fprf-splats") if verb == "train" else ("",):
            cli.main([word for word in (verb, method, "--help") if word])
    known = OTHERS | set(re.findall(r"(--[a-z][\w.-]*\w)", capsys.readouterr().out))
    # Of `--slot.field` the field may be that of any plug-in.
    fields = {
        field.name.replace("_", "-")
        for group in entry_points().groups
        if group.startswith("fprf.")
        for point in entry_points(group=group)
        if is_dataclass(made := point.load())
        for field in dataclass_fields(made)
    }
    absent = [
        f"{page.name}: {flag}"
        for page in PAGES
        for flag in FLAG.findall(page.read_text("utf-8"))
        if flag not in known and not ("." in flag and flag.rpartition(".")[2] in fields)
    ]
    assert not absent


MISSING = "the extra `docs` is not installed: pip install -e '.[docs]'"


def test_it_builds_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason=MISSING)
    pytest.importorskip("material", reason=MISSING)
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "-q",
        "-f",
        str(ROOT / "mkdocs.yml"),
        "-d",
        str(tmp_path),
    ]
    quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    made = subprocess.run(command, capture_output=True, text=True, check=False, env=quiet)
    assert made.returncode == 0 and "WARNING" not in made.stderr, made.stderr
    assert {path.stem for path in (tmp_path / "verbs").glob("*.html")} == set(VERBS)
    for verb in VERBS:  # each with a picture, but the demo, which has the garden itself
        page = (tmp_path / "verbs" / f"{verb}.html").read_text()
        shown = re.findall(r'<(?:img|iframe)[^>]+src="([^"]+\.(?:jpg|webp|svg|html))"', page)
        assert shown and all((tmp_path / "verbs" / each).is_file() for each in shown), verb
    for page in [tmp_path / "index.html", tmp_path / "verbs" / "export.html"]:
        text = page.read_text()
        assert not re.search(
            r'<(?:script|img)[^>]+src="https?:|<link[^>]+rel="stylesheet"[^>]+href="https?:', text
        )
    assert "restyle" in (tmp_path / "search" / "search_index.json").read_text()
