"""Packages of plug-ins, installed by pip into a folder of their own, as a stranger would install them: those that
`fprf plugins new` writes, of which examples/plugin is one, and the README's.
"""

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import pytest
from fake_packages import packages_in
from tiny_world import World, trained_for

from fprf.cli import new_plugin
from fprf.cli.main import main
from fprf.cli.parsing import load_method, parse
from fprf.cli.plugins import run as plugins
from fprf.plugins import registry
from fprf.plugins.codec import Missing
from fprf.plugins.encoders.config import EncoderConfig
from fprf.progress import Report
from fprf.testing import check_encoder

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "plugin"
NAMES = {
    "encoder": "contrast",
    "stylizer": "mean-shift",
    "parser": "table",
    "format": "plain",
    "layout": "slabs",
    "loss": "opacity",
}
"""Plug-ins that are written here, by their kind."""
TESTS = '[project]\nname = "{name}"\nversion = "1"\n[tool.setuptools]\npy-modules = ["{name}"]\n'
"""What a README leaves out of pyproject.toml."""


def readme_package(folder: Path) -> None:
    """The README's example, as it stands there."""
    text = (ROOT / "README.md").read_text("utf-8").partition("## You do research")[2]
    (code,) = re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    (points,) = re.findall(r"^```toml\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    folder.mkdir()
    (folder / "my_package.py").write_text(code)
    (folder / "pyproject.toml").write_text(TESTS.format(name="my_package") + points)


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of packages by kind, and the README's."""
    folder = tmp_path_factory.mktemp("sources")
    for kind, name in NAMES.items():
        assert plugins(["new", name, "--kind", kind, "--output", str(folder / kind)]) == 0
    readme_package(folder / "readme")
    return folder


@pytest.fixture(scope="module")
def sites(sources: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Where pip has put the packages that were written, and that of the README, which has an encoder of a name that
    one of the others has as well.
    """
    places = {}
    for name, packages in (("written", list(NAMES)), ("readme", ["readme"])):
        target = tmp_path_factory.mktemp(name)
        command = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-build-isolation", "--no-index"]
        command += ["--quiet", "--target", str(target), *(str(sources / each) for each in packages)]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        if ended.returncode and "No module named pip" in ended.stderr:
            pytest.skip("pip is not installed in this environment")
        assert ended.returncode == 0, ended.stderr
        places[name] = target
    return places


@pytest.fixture
def installed(sites: dict[str, Path]) -> Iterator[Path]:
    with packages_in(sites["written"]):
        yield sites["written"]


def test_the_example_is_what_the_command_writes(sources: Path) -> None:
    written = sources / "encoder"
    files = {
        path.relative_to(EXAMPLE) for path in EXAMPLE.rglob("*") if path.suffix in (".py", ".md", ".toml")
    }
    made = new_plugin.package_files("contrast", "encoder")
    assert {str(path) for path in files} == {str(Path(path)) for path in made}
    for path in files:
        assert (EXAMPLE / path).read_text() == (written / path).read_text()


def test_every_kind_is_written_here() -> None:
    assert NAMES.keys() == set(get_args(new_plugin.Kind))


@pytest.mark.parametrize("kind", NAMES)
def test_its_own_tests_pass(kind: str, sources: Path, sites: dict[str, Path]) -> None:
    code = f"import sys; sys.path.insert(0, {str(sites['written'])!r}); import pytest; sys.exit(pytest.main(sys.argv[1:]))"
    options = ["-q", "-p", "no:cacheprovider", "-W", "error", str(sources / kind / "tests")]
    ended = subprocess.run(
        [sys.executable, "-c", code, *options],
        cwd=sources / kind,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr


def test_they_are_listed_and_load(
    installed: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")  # where a screen is narrow, packages wrap
    assert plugins(["--check"]) == 0
    text = capsys.readouterr().out
    assert "broken" not in text
    assert all(f"fprf-{name} 0.1.0" in text for name in NAMES.values())


def test_the_example_is_chosen_by_name_with_its_own_fields(installed: Path) -> None:
    args = ["--semantic.encoder.window", "5", "--steps", "9", "--semantic.encoder", "contrast"]
    config = parse(load_method("fprf-lite")[0], args, prog="x", description="")
    assert type(config.semantic.encoder).__name__ == "ContrastConfig"
    assert config.semantic.encoder.window == 5 and config.steps == 9  # type: ignore[union-attr]


def test_a_loss_trains(sites: dict[str, Path], world: World, tmp_path: Path) -> None:
    args = ["--loss.extra", "opacity", "--loss.extra.weight", "0.5", "--steps", "2"]
    seen: list[Report] = []
    with packages_in(sites["written"]):
        config = parse(world.config, args, prog="x", description="")
        run = trained_for(world, tmp_path / "run", config, report=seen.append)
        run.save_config(config, "fprf-lite")
        assert run.load_config()[0].loss.extra == config.loss.extra
    assert 0 < seen[-1].losses["extra"] < 1
    assert isinstance(run.load_config()[0].loss.extra, Missing), "where it is not installed"


def test_a_stylizer_and_a_format_are_used_by_verbs(installed: Path, world: World, tmp_path: Path) -> None:
    shutil.copytree(world.run, tmp_path / "run")
    style = ["--references", str(world.references[0]), "--stylizer", "mean-shift", "--views", "0005"]
    assert main(["stylize", str(tmp_path / "run"), *style, "--output", str(tmp_path / "dusk")]) == 0
    assert (tmp_path / "dusk" / "0005.png").is_file()


def test_choosing_it_imports_no_torch(sites: dict[str, Path]) -> None:
    code = (
        "import sys; from fprf.cli.main import main\n"
        "code = main(['train', 'fprf-lite', '--semantic.encoder', 'contrast', '--help'])\n"
        "print(code, 'torch' in sys.modules, file=sys.stderr)"
    )
    script = f"import sys; sys.path.insert(0, {str(sites['written'])!r})\n{code}"
    ended = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False
    )
    assert "--semantic.encoder.window INT" in ended.stdout
    assert ended.stderr.strip() == "0 False"


def test_the_package_of_the_readme_works_where_it_says(
    sites: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    with packages_in(sites["readme"]):
        check_encoder(registry.make("fprf.encoders", "contrast", EncoderConfig))
        assert plugins(["--check"]) == 0
        for words in (["train", "fprf-lite"], ["train", "fprf-splats"], ["restyle"], ["view"]):
            capsys.readouterr()
            assert main([*words, "--semantic.encoder", "contrast", "--help"]) == 0
            shown = re.sub(r"[│\s]+", " ", capsys.readouterr().out)
            assert re.search(r"semantic\.encoder NAME .*default: contrast", shown)


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["Contrast"], "is no name for a plug-in"),
        (["fprf-"], "is no name for a plug-in"),
        (["loss", "--kind", "loss"], "is no name for a plug-in"),
        (["vgg19"], "is installed already"),
        (["contrast", "--output", "full"], "is there already"),
        (["contrast", "--kind", "verb"], "encoder or stylizer or parser"),
    ],
)
def test_mistakes_are_told(
    args: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("")
    assert main(["plugins", "new", *args]) == 2
    assert said in capsys.readouterr().err
    assert [path.name for path in tmp_path.rglob("*")] == ["full", "letter.txt"]
