import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.checks import at_least
from fprf.cli.parsing import load_method, parse
from fprf.cli.train import methods
from fprf.config import TrainConfig
from fprf.errors import FprfError, PluginError, UsageError
from fprf.methods import fprf, fprf_lite, load_config, save_config
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
    with pytest.raises(PluginError, match=r"semantic\.encoder: .*no plug-in 'gone'.*--semantic\.encoder NAME"):
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
