"""How arguments are parsed and how a verb ends; `fprf plugins`, and verbs that packages add."""

import io
import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import Mock, call

import pytest
from fake_packages import ENCODER, Packages
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.checks import at_least
from fprf.cli import main as cli
from fprf.cli.config import CommandConfig
from fprf.cli.parsing import load_method, parse
from fprf.cli.plugins import faults, run
from fprf.cli.train import methods
from fprf.config import TrainConfig
from fprf.config_files import load_config, save_config
from fprf.errors import DataError, FprfError, PluginError, UsageError
from fprf.methods import fprf, fprf_lite
from fprf.plugins.encoders.config import BundledSemanticConfig, Vgg19Config
from fprf.plugins.samplers.config import UniformConfig
from fprf.plugins.slots import replace


@dataclass(frozen=True, kw_only=True)
class Inner:
    deep_value: float = 1.0
    """Deep."""


@dataclass(frozen=True, kw_only=True)
class Verb:
    """A verb."""

    run: Path = Path()
    """The run."""
    references: tuple[Path, ...] = ()
    """Photographs."""
    strength: float | None = None
    """How much."""
    quiet: bool = False
    """Say nothing."""
    size: tuple[int, int] = (3, 4)
    """Two numbers."""
    inner: Inner = field(default_factory=Inner)

    def __post_init__(self) -> None:
        at_least("size", min(self.size), 1)


def verb(*args: str) -> Verb:
    return parse(Verb(), args, prog="fprf verb", description="Do it.", positional=("run",))


def train(*args: str) -> TrainConfig:
    return parse(fprf_lite(), args, prog="fprf train fprf-lite", description="Train.")


@pytest.mark.parametrize(
    ("args", "wanted"),
    [
        ("r", {}),
        ("r --references a b", {"references": (Path("a"), Path("b"))}),
        ("--quiet r", {"quiet": True}),
        ("r --quiet", {"quiet": True}),
        ("r --no-quiet", {}),
        ("--strength none r", {}),
        ("--strength=0.5 r --inner.deep_value -2", {"strength": 0.5, "inner": Inner(deep_value=-2)}),
        ("--inner.deep-value=3 --size 5 6 r", {"size": (5, 6), "inner": Inner(deep_value=3)}),
    ],
)
def test_flags_stand_anywhere(args: str, wanted: dict[str, Any]) -> None:
    found = verb(*args.split())
    assert found == Verb(run=Path("r"), **wanted) and type(found) is Verb


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("", "RUN is missing"),
        ("r --strenght 1", "did you mean --strength?"),
        ("r --strength much", "--strength much"),
        ("r --strength", "--strength: needs a value"),
        ("r --size 1", "2 values"),
        ("r extra", "'extra'"),
        ("r --size 1 0", "--size: 0 must be at least 1"),
        ("train --sampler uniform --sampler.final 3", "sampler is uniform"),
        ("train --semantic.encoder none --semantic.encoder.layer 3", "semantic.encoder is none"),
        ("train --content.encoder vgg19 --content.encoder.layer conv9", "--content.encoder.layer: 'conv9'"),
        ("train --sampler uniform --sampler.samples 0", "--sampler.samples: 0"),
        ("train --executor.what 3", "executor is serial"),
    ],
)
def test_a_mistake_is_one_line(words: str, told: str, capsys: pytest.CaptureFixture[str]) -> None:
    first, *rest = words.split(" ")
    with pytest.raises(FprfError) as caught:
        train(*rest) if first == "train" else verb(*words.split())
    assert told in str(caught.value) and "\n" not in str(caught.value) and capsys.readouterr() == ("", "")


def test_slots_and_fields_in_any_order() -> None:
    words = "--sampler.samples=7 --steps 5 --content.encoder vgg19 --sampler uniform --content.encoder.no-normalise"
    config = train(*words.split())
    assert config.sampler == UniformConfig(samples=7) and config.steps == 5
    assert config.content.encoder == Vgg19Config(normalise=False)
    assert config.content.field == fprf_lite().content.field


def test_help_shows_fields_and_slots_and_imports_no_torch(capsys: pytest.CaptureFixture[str]) -> None:
    before = os.environ.get("COLUMNS")
    with pytest.raises(SystemExit) as caught:
        train("--sampler", "uniform", "--help")
    assert caught.value.code == 0 and os.environ.get("COLUMNS") == before
    text = capsys.readouterr().out
    plain = " ".join(text.split())
    assert "--sampler.samples INT" in plain and "--sampler.final" not in plain
    assert "One of proposal, uniform." in plain and "(default: uniform)" in plain
    assert "One of planes. (default: planes)" in plain, "a field of another kind is not offered"
    assert max(map(len, text.splitlines())) <= 100


def test_methods_by_name_and_by_file(tmp_path: Path) -> None:
    assert load_method("fprf") == (fprf(), "fprf")
    save_config(tmp_path / "config.json", fprf_lite(), "fprf-lite")
    assert load_method(str(tmp_path / "config.json")) == (fprf_lite(), "fprf-lite")
    with pytest.raises(UsageError, match=r"is a folder, not a method.*config\.json"):
        load_method(str(tmp_path))
    with pytest.raises(PluginError, match="did you mean 'fprf-lite'"):
        load_method("fprf-litee")
    listed = methods()
    assert listed["fprf"].startswith("The paper's sizes") and {"fprf", "fprf-lite"} <= listed.keys()


def test_a_config_with_a_missing_plugin_needs_another_choice(tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    save_config(path, fprf_lite(), "fprf-lite")
    whole = json.loads(path.read_text())
    whole["config"]["semantic"]["encoder"] = {"type": "gone", "tile": 3}
    path.write_text(json.dumps(whole))
    config, _ = load_config(path)
    with pytest.raises(
        PluginError, match=r"semantic\.encoder: .*no plug-in 'gone'.*--semantic\.encoder NAME"
    ):
        parse(config, [], prog="x", description="")
    chosen = parse(config, ["--semantic.encoder", "bundled-semantic"], prog="x", description="")
    assert chosen == replace(fprf_lite(), "semantic.encoder", BundledSemanticConfig())


@settings(max_examples=12)
@given(st.lists(st.text(max_size=8), max_size=5))
def test_no_arguments_whatever_break_the_parser(args: list[str]) -> None:
    try:
        found = verb(*args)
    except FprfError as error:
        assert str(error)
    except SystemExit as end:
        assert end.code == 0 and any(arg in ("-h", "--help") for arg in args)
    else:
        assert isinstance(found, Verb)


def _verb(monkeypatch: pytest.MonkeyPatch, run: Callable[[list[str]], int]) -> None:
    monkeypatch.setattr("fprf.cli.doctor.run", run)
    monkeypatch.delenv("FPRF_DEBUG", raising=False)


def test_help_lists_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    for name, verb in cli.VERBS.items():
        assert any(line.split()[:1] == [name] and verb.summary in line for line in text.splitlines())
    assert max(map(len, text.splitlines())) <= 110
    assert "\x1b" not in text, "no colours into a pipe"


def test_arguments_and_exit_code_pass_through(monkeypatch: pytest.MonkeyPatch) -> None:
    run = Mock(return_value=7)
    _verb(monkeypatch, run)
    assert cli.main(["doctor", "a", "--b"]) == 7
    assert cli.main(["doctor", "a", "--debug"]) == 7
    assert run.call_args_list == [call(["a", "--b"]), call(["a"])]


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (DataError("x.jpg: broken; remove it"), 2, "error: x.jpg: broken; remove it\n"),
        (MemoryError(), 2, None),
        (KeyboardInterrupt(), 130, "interrupted\n"),
        (SystemExit(None), 0, ""),
        (SystemExit(5), 5, ""),
        (SystemExit("text"), 1, None),
    ],
)
def test_how_a_verb_ends(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    error: BaseException,
    code: int,
    said: str | None,
) -> None:
    _verb(monkeypatch, Mock(side_effect=error))
    assert cli.main(["doctor"]) == code
    out, err = capsys.readouterr()
    assert out == "" and (said is None or err == said) and err.count("\n") <= 1


def test_our_fault_is_1_and_short_or_with_debug_whole(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _verb(monkeypatch, lambda args: 1 // 0)
    monkeypatch.setattr(os.path, "relpath", Mock(side_effect=ValueError("path is on another drive")))
    assert cli.main(["doctor"]) == 1
    text = capsys.readouterr().err
    assert text.startswith("internal error: ZeroDivisionError: ") and "test_command_line.py:" in text
    assert "Traceback" not in text and "--debug" in text
    assert cli.main(["doctor", "--debug"]) == 1
    assert "Traceback (most recent call last)" in capsys.readouterr().err
    monkeypatch.setenv("FPRF_DEBUG", "1")
    assert cli.main(["doctor"]) == 1
    assert "Traceback (most recent call last)" in capsys.readouterr().err


def test_a_pipe_without_the_letters_of_a_name_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    _verb(monkeypatch, lambda args: print("写真") or 0)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", pipe := io.TextIOWrapper(io.BytesIO(), "cp1252"))
        assert cli.main(["doctor"]) == 0
    assert pipe.buffer.getvalue().strip() == rb"\u5199\u771f"


def test_a_reader_that_leaves_is_met_with_silence() -> None:
    read, write = os.pipe()
    os.close(read)
    ended = subprocess.run(
        [sys.executable, "-m", "fprf", "--help"],
        stdout=write,
        stderr=subprocess.PIPE,
        timeout=60,
        check=False,
    )
    os.close(write)
    assert (ended.returncode, ended.stderr) == (141, b"")


def test_built_ins_are_listed_and_load(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "140")
    assert run([]) == 0
    text = capsys.readouterr().out
    assert "vgg19" in text and "fprf.plugins.encoders.config:Vgg19Config" in text and "state" not in text
    assert run(["--check"]) == 0
    assert "broken" not in capsys.readouterr().out


MINE = ENCODER.format(name="N") + "\nthing = NConfig"


@pytest.mark.parametrize(
    ("group", "name", "source", "shown"),
    [
        ("fprf.encoders", "x", "import not_there", "ModuleNotFoundError"),
        (
            "fprf.encoders",
            "x",
            "from fprf.blocks.config import SingleConfig as thing",
            "is SingleConfig, not a EncoderConfig",
        ),
        ("fprf.encoders", "none", MINE, "can never be chosen"),
        ("fprf.encoders", "x", MINE.replace("int = 224", "int"), "no defaults"),
        ("fprf.encoders", "vgg19", MINE, "several packages provide 'vgg19'"),
        (
            "fprf.commands",
            "train",
            "from fprf.cli.config import CommandConfig as thing",
            "is never called: fprf has a verb",
        ),
        ("fprf.methods", "x", "def thing(): return None", "gives NoneType, not a RunConfig"),
    ],
)
def test_what_is_broken_is_told_and_nothing_else(
    packages: Packages, capsys: pytest.CaptureFixture[str], group: str, name: str, source: str, shown: str
) -> None:
    packages.install("acme", {group: {name: "acme_check:thing"}}, code={"acme_check": source})
    assert {row.name for row, _ in faults()} == {name}
    assert run(["--check"]) == 1
    assert shown in " ".join(capsys.readouterr().out.split())
    assert run([]) == 0, "listing loads nothing"


COUNT = '''
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar
from fprf.cli.config import CommandConfig
from fprf.errors import DataError
from fprf.plugins.samplers.config import SamplerConfig, UniformConfig

@dataclass(frozen=True, kw_only=True)
class CountConfig(CommandConfig):
    """Count the files of a folder."""

    positional: ClassVar[tuple[str, ...]] = ("folder",)
    folder: Path = Path()
    step: int = 1
    sampler: SamplerConfig = UniformConfig()

    def run(self) -> int:
        if not self.folder.is_dir():
            raise DataError(f"{self.folder}: no such folder")
        print(len(list(self.folder.iterdir())) * self.step, type(self.sampler).__name__)
        return 3
'''


@pytest.fixture
def counting(packages: Packages) -> Packages:
    point = {CommandConfig.group: {"count": "acme_count:CountConfig"}}
    packages.install("acme-count", point, code={"acme_count": COUNT}, version="0.2")
    return packages


def test_it_is_parsed_and_called_like_a_built_in_one(
    counting: Packages, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = counting.root / "some"
    folder.mkdir()
    (folder / "a").touch()
    assert cli.main(["count", "--step", "4", str(folder), "--sampler", "proposal"]) == 3
    assert capsys.readouterr().out == "4 ProposalConfig\n"
    assert cli.main(["count", str(folder / "b")]) == 2
    assert capsys.readouterr().err == f"error: {folder / 'b'}: no such folder\n"
    assert (
        cli.main(["count", str(folder), "--stp", "2"]) == 2
        and "did you mean --step?" in capsys.readouterr().err
    )
    assert cli.main(["count", "--help"]) == 0
    shown = capsys.readouterr().out
    assert "usage: fprf count" in shown and "Count the files of a folder." in shown and "--step INT" in shown
    assert cli.main(["cuont"]) == 2 and "did you mean 'count'?" in capsys.readouterr().err


def test_a_broken_verb_harms_only_its_callers(counting: Packages, capsys: pytest.CaptureFixture[str]) -> None:
    counting.install("acme-bad", {CommandConfig.group: {"bad": "acme_bad5:C"}}, code={"acme_bad5": "1 / 0"})
    for k in (1, 2):
        counting.install(f"acme-twice-{k}", {CommandConfig.group: {"twice": "acme_count:CountConfig"}})
    counting.install("acme-train", {CommandConfig.group: {"plugins": "acme_bad5:C"}})
    assert cli.main(["--help"]) == 0
    assert "of acme-twice-1 1 and acme-twice-2 1" in capsys.readouterr().out
    assert cli.main(["bad"]) == 2
    assert (
        "'bad' (acme_bad5:C from acme-bad 1) failed to import: ZeroDivisionError" in capsys.readouterr().err
    )
    assert cli.main(["twice"]) == 2 and "several packages provide 'twice'" in capsys.readouterr().err
    assert cli.main(["plugins", "--help"]) == 0, "ours wins"
