"""The example package, installed by pip into a folder of its own, as a stranger would install it."""

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from fake_packages import packages_in
from tiny_world import World, trained_for

from fprf.cli.parsing import load_method, parse
from fprf.cli.plugins import run as plugins
from fprf.plugins import registry
from fprf.plugins.codec import Missing
from fprf.plugins.encoders.config import EncoderConfig
from fprf.plugins.losses.config import LossTermConfig
from fprf.progress import Report
from fprf.testing import check_encoder, check_loss_term

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "plugin"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    source = tmp_path_factory.mktemp("source") / "plugin"
    target = tmp_path_factory.mktemp("site")
    shutil.copytree(EXAMPLE, source, ignore=shutil.ignore_patterns("build", "*.egg-info", "__pycache__"))
    command = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--no-deps",
        "--no-build-isolation",
        "--no-index",
        "--quiet",
    ]
    ended = subprocess.run(
        [*command, "--target", str(target), str(source)], capture_output=True, text=True, check=False
    )
    if ended.returncode and "No module named pip" in ended.stderr:
        pytest.skip("pip is not installed in this environment")
    assert ended.returncode == 0, ended.stderr
    return target


@pytest.fixture
def installed(site: Path) -> Iterator[Path]:
    with packages_in(site):
        yield site


def test_the_example_is_chosen_by_name_with_its_own_fields(installed: Path) -> None:
    args = ["--semantic.encoder.orientations", "6", "--steps", "9", "--semantic.encoder", "gabor"]
    config = parse(load_method("fprf-lite")[0], args, prog="x", description="")
    assert type(config.semantic.encoder).__name__ == "GaborConfig"
    assert config.semantic.encoder.orientations == 6 and config.steps == 9  # type: ignore[union-attr]
    longer = [*args, "--semantic.encoder.wavelengths", "4", "6.5"]
    encoder = parse(load_method("fprf-lite")[0], longer, prog="x", description="").semantic.encoder
    assert encoder is not None and encoder.build().channels == 6 * 2 + 3


def test_the_example_keeps_to_the_contract(installed: Path) -> None:
    check_encoder(registry.make("fprf.encoders", "gabor", EncoderConfig))
    check_loss_term(registry.make("fprf.losses", "opacity", LossTermConfig))


def test_its_method_and_its_listing(installed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config, name = load_method("fprf-gabor")
    assert name == "fprf-gabor" and type(config.semantic.encoder).__name__ == "GaborConfig"
    assert plugins(["--check"]) == 0
    text = capsys.readouterr().out
    assert "gabor" in text and "fprf-gabor 0.3.0" in text and "broken" not in text


def test_its_loss_trains(site: Path, world: World, tmp_path: Path) -> None:
    args = ["--loss.extra", "opacity", "--loss.extra.weight", "0.5", "--steps", "2"]
    seen: list[Report] = []
    with packages_in(site):
        config = parse(world.config, args, prog="x", description="")
        run = trained_for(world, tmp_path / "run", config, report=seen.append)
        run.save_config(config, "fprf-lite")
        assert run.load_config()[0].loss.extra == config.loss.extra
    assert 0 < seen[-1].losses["extra"] < 1
    assert isinstance(run.load_config()[0].loss.extra, Missing), "where it is not installed"


def test_choosing_it_imports_no_torch(site: Path) -> None:
    code = (
        "import sys; from fprf.cli.main import main\n"
        "code = main(['train', 'fprf-lite', '--semantic.encoder', 'gabor', '--help'])\n"
        "print(code, 'torch' in sys.modules, file=sys.stderr)"
    )
    script = f"import sys; sys.path.insert(0, {str(site)!r})\n{code}"
    ended = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False
    )
    assert "--semantic.encoder.orientations INT" in ended.stdout
    assert ended.stderr.strip() == "0 False"
