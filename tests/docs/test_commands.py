"""The commands and the Python of the README and the documents, on a tiny scene: run, or for heavy commands
parsed to the end.

A command that is neither stands in `ELSEWHERE` with the reason; nothing else is left out.
"""

import json
import os
import re
import shlex
import shutil
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import create_autospec

import cv2
import numpy as np
import pytest
from splat_ball import ball
from tiny_world import World, flags

import fprf
from fprf.cli import main as cli
from fprf.cli.main import VERBS, verb_module
from fprf.io.atomic import write_json
from fprf.io.video import write_video
from fprf.methods import fprf_splats
from fprf.splats.files import read_capture, write_gaussians
from fprf.testing import check_encoder
from fprf.training.driver import train

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]

RUN = ("eval", "stylize", "restyle", "render", "gallery", "export", "plugins", "config-schema", "doctor")
"""Verbs whose commands are run here."""
PARSED = {
    "demo": "minutes; tests/cli/test_scene_verbs.py runs it small",
    "process": "needs pycolmap; tests/reconstruction/test_colmap.py runs it",
    "train": "minutes; run below with `-m slow`",
    "view": "stays up; tests/page run it",
    "pretrain": "hours; tests/pretraining run it small",
}
"""Verbs whose commands are parsed whole, with the files that they name."""
ELSEWHERE = {
    "contrast": "an encoder that `fprf plugins new` writes: tests/test_example_plugin.py installs and runs it",
    "opacity": "a loss, likewise",
    "--tone": "needs a run whose photographs differ in exposure: tests/training/test_camera_optimizers.py",
}
"""Commands with these words, and where they are tested instead."""
TOOLS = ("python3", "python", ".", "pip", "export", "pytest", "ruff", "mypy", "mkdocs", "uvx", "pipx", "npx")
"""Programs that are not fprf: that their options exist in pyproject.toml is checked, they are not run."""
SMALL = {
    "0015:67,33": "0005:20,12", "0015": "0005", "--keep 7": "--keep 2", "--cells 16": "--cells 2",
    "--max-memory 500": "--max-memory 5",
}  # fmt: skip
"""What is named by its place in a larger scene."""
FEWER = {"render": ["--frames", "2"], "export": ["--fit", "0.01", "--fit-cap", "200"]}
FEWER["restyle"] = ["--views", "3", "--size", "64", "48", "--regions", "3"]
"""The tiny model renders few frames, and has barely begun to agree with itself."""
SCENES = ("my_scene", "SCENE", "DIR", "FOLDER", "scenes/yard", "fox")
RUNS = ("RUN", "OTHER_RUN", "runs/my_scene-fprf-lite", "runs/my_scene-fprf-splats", "runs/yard-fprf-splats")
PHOTOGRAPHS = (
    "autumn.jpg",
    "night.jpg",
    "dusk.jpg",
    "snow.jpg",
    "a.jpg",
    "A.jpg",
    "photos/one.jpg",
    "my_photos/one.jpg",
)
CAPTURES = ("capture.ply", "plant.splat", "my_scan.spz")
WEIGHTS = ("vgg19.safetensors", "F")


class Command(NamedTuple):
    page: str
    words: list[str]


class Parsed(Exception):
    """Arguments were understood."""


def commands(page: Path) -> Iterator[Command]:
    """The commands of a page's `sh` blocks; words that are flags alone belong to `fprf train`."""
    for block in re.findall(r"^```sh\n(.*?)^```", page.read_text("utf-8"), re.DOTALL | re.MULTILINE):
        for line in block.replace("\\\n", " ").splitlines():
            for part in re.split(r"\s&&\s", line):
                words = shlex.split(part, comments=True)
                if words and words[0].startswith("--"):
                    words = ["fprf", "train", "fprf-lite", "--data", "DIR", *words]
                if words:
                    yield Command(str(page.relative_to(ROOT)), words)


EVERY = [command for page in PAGES for command in commands(page)]
GAUSSIANS = ["--steps", "5", "--initial", "300", "--cap", "400"]
OURS = [
    command for command in EVERY if command.words[0] == "fprf" and not set(command.words) & ELSEWHERE.keys()
]


def smaller(words: Sequence[str]) -> list[str]:
    text = shlex.join(words)
    for large, small in SMALL.items():
        text = text.replace(large, small)
    return shlex.split(text)


@pytest.fixture
def place(world: World, tmp_path: Path) -> Path:
    """A folder with something under every name that documents use."""
    folder = tmp_path / "documents"
    for name in RUNS:
        shutil.copytree(world.run, folder / name, dirs_exist_ok=True)
    for name in SCENES:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).symlink_to(world.town)
    for number, name in enumerate(PHOTOGRAPHS):
        (folder / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(folder / name), cv2.imread(str(world.references[number % 2])))
    for name in WEIGHTS:
        (folder / name).write_bytes(b"")
    pose = [float(x) for x in np.eye(4).ravel()]
    frames = [{"camera_to_world": pose, "fov": 50, "aspect": 1.3}] * 2
    write_json(
        folder / "camera_path.json",
        {"camera_path": frames, "render_width": 32, "render_height": 24, "fps": 2},
    )
    for name in CAPTURES:
        write_gaussians(folder / name, ball(300))
    (folder / "night").mkdir()
    write_json(
        folder / "night" / "style.json", {"format": 1, "style": {"references": [str(folder / "night.jpg")]}}
    )
    write_video(folder / "clip.mp4", [np.full((24, 32, 3), 90, np.uint8)] * 2, 2)
    (folder / "clip.mp4").rename(folder / "IMG_0001.MOV")
    return folder


def test_documents_have_commands_and_each_is_looked_at() -> None:
    assert len(OURS) > 30 and {command.words[1] for command in OURS} <= VERBS.keys()
    assert set(RUN) | PARSED.keys() == VERBS.keys() and not set(RUN) & PARSED.keys()
    strangers = {command.words[0] for command in EVERY if command.words[0] != "fprf"}
    assert strangers <= set(TOOLS)
    unused = [word for word in ELSEWHERE if not any(word in command.words for command in EVERY)]
    assert not unused, "an exception that nothing needs"


def pages(*, run: bool) -> list[Any]:
    """The commands of each page in their order: one may need what another wrote."""
    found: dict[str, list[list[str]]] = {}
    for command in OURS:
        if (command.words[1] in RUN) == run:
            found.setdefault(command.page, []).append(command.words)
    return [pytest.param(lines, id=page) for page, lines in found.items()]


@pytest.mark.parametrize("lines", pages(run=True))
def test_it_runs(place: Path, lines: list[list[str]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    for words in lines:
        assert cli.main([*smaller(words)[1:], *FEWER.get(words[1], [])]) == 0, shlex.join(words)


@pytest.mark.parametrize("lines", pages(run=False))
def test_it_is_understood(place: Path, lines: list[list[str]], monkeypatch: pytest.MonkeyPatch) -> None:
    """By the real parser; every file that is read exists under its name."""
    monkeypatch.chdir(place)
    for words in lines:
        config = parsed(smaller(words), monkeypatch)
        for name in ("data", "run", "source"):
            value = getattr(config, name, None)
            if isinstance(value, Path) and value != Path() and str(value) != "garden":
                assert value.exists(), shlex.join(words)


def parsed(words: list[str], monkeypatch: pytest.MonkeyPatch) -> Any:
    """The config that a verb would start with."""
    module = verb_module(words[1])
    real = module.parse
    heard = []

    def stop(*args: Any, **named: Any) -> None:
        heard.append(real(*args, **named))
        raise Parsed

    with monkeypatch.context() as patched, pytest.raises(Parsed):
        patched.setattr(module, "parse", stop)
        module.run(words[2:])
    return heard[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        pytest.param(command.words, id=shlex.join(command.words))
        for command in OURS
        if command.words[1] == "train" and not set(command.words) & {*WEIGHTS, "--view"}
    ],
)
def test_it_trains(
    world: World, place: Path, words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(place)
    words = smaller(words)
    if words[2] in ("fprf", "fprf-lite"):  # what the command says comes last, and so counts
        line = [*words[1:3], *flags(world, tmp_path / "run")[2:], *words[3:]]
    else:
        line = [*words[1:], *GAUSSIANS, "--output", str(tmp_path / "run")]
    assert cli.main(line) == 0
    assert (tmp_path / "run" / "config.json").is_file()


@pytest.mark.parametrize(
    "command", [command for command in EVERY if command.words[0] in ("pip", "pytest")], ids=str
)
def test_what_is_installed_and_marked_exists(command: Command) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    extras = {extra for word in command.words for extra in re.findall(r"\[([\w,]+)\]", word)}
    assert {name for extra in extras for name in extra.split(",")} <= project["project"][
        "optional-dependencies"
    ].keys()
    if command.words[:2] == ["pytest", "-m"]:
        markers = [line.partition(":")[0] for line in project["tool"]["pytest"]["ini_options"]["markers"]]
        assert command.words[2] in markers


@pytest.mark.parametrize("command", [command for command in EVERY if command.words[0] == "python"], ids=str)
def test_scripts_are_there(command: Command) -> None:
    if command.words[1] == "-m":
        package, name = command.words[2:4]
        assert (ROOT / package / "__main__.py").is_file() and (ROOT / package / f"{name}.py").is_file()
    else:
        assert (ROOT / command.words[1]).is_file()


def test_the_python_of_pages_runs_and_the_plug_in_of_the_readme_keeps_its_contract() -> None:
    # The README's first lines need a run: the notebook, which is run below, begins with the same.
    for page, section in (("docs/plugins.md", ""), ("README.md", "## You do research")):
        text = (ROOT / page).read_text("utf-8").partition(section or "# ")[2]
        for block in re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
            defined: dict[str, Any] = {"__name__": "page"}
            exec(compile(block, page, "exec"), defined)
    check_encoder(defined["ContrastConfig"]())


DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE = DOCS / "python.md"
NOTEBOOK = DOCS / "tour.ipynb"


def test_the_page_runs(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    os.symlink(world.run, tmp_path / "runs" / "town-fprf-lite")
    for name, reference in zip(("autumn.jpg", "night.jpg"), world.references, strict=True):
        cv2.imwrite(name, cv2.imread(str(reference)))
    write_gaussians(Path("scan.ply"), ball(200))
    # Minutes long; tests/test_api.py runs both small. Here their arguments are looked at.
    for name, result in (("process", world.town), ("train", fprf.load(world.run))):
        monkeypatch.setattr(fprf, name, create_autospec(getattr(fprf, name), return_value=result))
    names: dict[str, object] = {}
    for block in re.findall(r"^```python\n(.*?)^```", PAGE.read_text("utf-8"), re.DOTALL | re.MULTILINE):
        exec(compile(block, str(PAGE), "exec"), names)
    told = capsys.readouterr().out
    assert "torch.Size([120, 160, 3])" in told and "'autumn.jpg'" in told and "'night.jpg'" in told
    made = {path.name for path in tmp_path.iterdir()}
    assert {"autumn.png", "film.mp4", "mine.json", "between-0.png", "between-2.png"} <= made
    assert "(200, 3) True" in told
    scans = [
        f"scan{name}" for name in ("_autumn.spz", "-0.5.ply", "-1.0.ply", "_night.splat", "_grey.ply", ".glb")
    ]
    assert all(len(read_capture(Path(name)).gaussians) == 200 for name in scans)


def cells(kind: str) -> list[str]:
    return [
        "".join(cell["source"])
        for cell in json.loads(NOTEBOOK.read_text("utf-8"))["cells"]
        if cell["cell_type"] == kind
    ]


def test_every_cell_runs_in_order_on_the_garden(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    few = replace(fprf_splats(), steps=10, initial=800, cap=900, downscale=8)
    train(
        replace(few, data=Path(str(files("fprf") / "garden")), output=Path("demo/run")),
        "fprf-splats",
        quiet=True,
    )
    names: dict[str, object] = {}
    for number, source in enumerate(cells("code"), 1):
        exec(compile(source, f"cell {number}", "exec"), names)
    told = capsys.readouterr().out
    assert "25 captured views" in told and "film.mp4:" in told and "'night.jpg'" in told
    assert len(read_capture(Path("night.ply")).gaussians) > 500
    made = {path.name for path in tmp_path.iterdir()}
    assert {"plain.png", "wide.png", "sunrise.png", "mine.json", "film.mp4"} <= made
