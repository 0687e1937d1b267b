"""What others need before they have a clone: metadata, the workflows of CI, images, the commands of the README."""

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from packaging.version import Version

import fprf
from tools.readme_command import commands

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def read_yaml(path: Path) -> dict[str, Any]:
    yaml = pytest.importorskip("yaml", reason="the extra `docs` is not installed: mkdocs brings it")
    content = yaml.safe_load(path.read_text("utf-8"))
    assert isinstance(content, dict)
    return content


def test_the_version_is_one_and_the_first_of_the_changes_is_not_older() -> None:
    assert "version" in PROJECT["dynamic"]
    version = Version(fprf.__version__)
    titles = re.findall(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE)
    assert titles
    released = [Version(title.split()[0]) for title in titles if title != "Unreleased"]
    assert released == sorted(released, reverse=True)
    if not version.is_devrelease and version.local is None and released:
        assert released[0] >= version


def test_every_python_is_tested_on_every_system() -> None:
    minors = {c.rpartition(" ")[2] for c in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", c)}
    matrix = read_yaml(ROOT / ".github" / "workflows" / "test.yml")["jobs"]["test"]["strategy"]["matrix"]
    assert set(matrix["python"]) == minors and min(minors) in PROJECT["requires-python"]
    assert {name.partition("-")[0] for name in matrix["os"]} == {"ubuntu", "macos", "windows"}


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_install_what_is_pinned_and_name_what_is_there(path: Path) -> None:
    steps = [step for job in read_yaml(path)["jobs"].values() for step in job["steps"]]
    lines = []
    for step in steps:
        lines += [
            line for line in str(step.get("run", "")).splitlines() if "pip " in line or "python " in line
        ]
    for line in lines:
        if "[test" in line or "[dev" in line or "[docs" in line:
            assert "-c constraints" in line, line
        for module in re.findall(r"python -m (tools\.\w+)", line):
            assert (ROOT / f"{module.replace('.', '/')}.py").is_file()
    extras = {
        name for line in lines for text in re.findall(r"\[([\w,]+)\]", line) for name in text.split(",")
    }
    assert extras <= PROJECT["optional-dependencies"].keys()


def test_only_publishing_may_ask_for_an_identity() -> None:
    jobs = read_yaml(ROOT / ".github" / "workflows" / "release.yml")["jobs"]
    asking = [name for name, job in jobs.items() if "id-token" in job.get("permissions", {})]
    assert asking == ["publish"] and jobs["publish"]["needs"] == "package"


def test_images_install_what_is_pinned() -> None:
    container = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text())
    text = (ROOT / "Dockerfile").read_text()
    assert "-c constraints.txt" in container["postCreateCommand"]
    assert text.count("pip install") == text.count("-c /src/constraints.txt") == 2
    extras = {name for found in re.findall(r"/src\[([\w,]+)\]", text) for name in found.split(",")}
    assert extras <= PROJECT["optional-dependencies"].keys()


def test_the_commands_of_the_readme_are_two() -> None:
    assert len(commands()) == 2 and all(each.startswith("python3 -m venv .venv") for each in commands())
    assert commands()[0].endswith("fprf demo") and "pytest" in commands()[1]
    ended = subprocess.run(
        [sys.executable, "-m", "tools.readme_command", "1"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": ""},
        capture_output=True,
        text=True,
        check=True,
    )
    assert ended.stdout.strip() == commands()[0]


def test_the_citation_is_of_the_paper_that_the_readme_cites() -> None:
    content = read_yaml(ROOT / "CITATION.cff")
    assert content["license"] == PROJECT["license"]
    title = content["preferred-citation"]["title"]
    bibtex = (ROOT / "README.md").read_text("utf-8").replace("{", "").replace("}", "")
    assert title in bibtex and "2401.05516" in str(content["preferred-citation"]["identifiers"])
