import json
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from fake_packages import packages_in
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.checks import at_least
from fprf.cli.flags import flags_of, spell
from fprf.cli.parsing import load_method, methods, parse
from fprf.config import TrainConfig
from fprf.errors import FprfError, PluginError, UsageError
from fprf.methods import fprf, fprf_lite
from fprf.plugins.codec import load_config, save_config
from fprf.plugins.encoders.config import Vgg19Config
from fprf.plugins.samplers.config import UniformConfig


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


def test_no_arguments_give_the_default() -> None:
    assert train() == fprf_lite()


@pytest.mark.parametrize(
    ("args", "wanted"),
    [
        (["r"], Verb(run=Path("r"))),
        (["r", "--references", "a", "b"], Verb(run=Path("r"), references=(Path("a"), Path("b")))),
        (["--quiet", "r"], Verb(run=Path("r"), quiet=True)),
        (["r", "--quiet"], Verb(run=Path("r"), quiet=True)),
        (["r", "--no-quiet"], Verb(run=Path("r"))),
        (["--strength", "none", "r"], Verb(run=Path("r"))),
        (["--strength=0.5", "r", "--inner.deep_value", "-2"], Verb(run=Path("r"), strength=0.5, inner=Inner(deep_value=-2))),
        (["--inner.deep-value=3", "--size", "5", "6", "r"], Verb(run=Path("r"), size=(5, 6), inner=Inner(deep_value=3))),
    ],
)
def test_flags_stand_anywhere(args: list[str], wanted: Verb) -> None:
    found = verb(*args)
    assert found == wanted and type(found) is Verb


@pytest.mark.parametrize(
    ("args", "line"),
    [
        ([], "fprf verb: RUN is missing; `fprf verb --help` says what it takes"),
        (["r", "--strenght", "1"], "--strenght: no such flag; did you mean --strength?"),
        (["r", "--strength", "much"], "--strength much: it takes a number or none"),
        (["r", "--strength"], "--strength: needs a value: a number or none"),
        (["r", "--size", "1"], "--size 1: it takes 2 values (a whole number, a whole number)"),
        (["r", "extra"], "'extra': belongs to no flag; `fprf verb --help` lists the flags"),
        (["r", "--size", "1", "0"], "--size: 0 must be at least 1"),
    ],
)
def test_a_mistake_is_one_line(args: list[str], line: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(FprfError) as caught:
        verb(*args)
    assert str(caught.value) == line
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("args", "line"),
    [
        (["--sampler", "uniform", "--sampler.final", "3"], "--sampler.final: no such flag; sampler is uniform, which takes"),
        (["--semantic.encoder", "none", "--semantic.encoder.layer", "3"], "semantic.encoder is none; choose one with"),
        (["--content.encoder", "vgg19", "--content.encoder.layer", "conv9"], "--content.encoder.layer: 'conv9' is no layer"),
        (["--sampler", "uniform", "--sampler.samples", "0"], "--sampler.samples: 0 must be at least 1"),
        (["--render.budget", "nan"], "--render.budget: nan is not a finite number"),
        (["--executor.what", "3"], "executor is serial, which takes no flags"),
    ],
)
def test_a_mistake_below_a_slot_says_what_fills_it(args: list[str], line: str) -> None:
    with pytest.raises(FprfError) as caught:
        train(*args)
    assert line in str(caught.value) and "\n" not in str(caught.value)


def test_slots_and_fields_in_any_order() -> None:
    config = train("--sampler.samples=7", "--steps", "5", "--content.encoder", "vgg19", "--sampler", "uniform",
                   "--content.encoder.no-normalise")  # fmt: skip
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
    listed = dict(methods())
    assert listed["fprf"].startswith("The paper's sizes") and {"fprf", "fprf-lite"} <= listed.keys()


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("def m(): return 3", "gives int, not a RunConfig"),
        ("m = 4", "gives int, not a RunConfig"),
        ("def m(): return {}['x']", "failed: KeyError: 'x'"),
        ("from fprf.config import TrainConfig\ndef m(): return TrainConfig(steps=-1)", "steps: -1 must be at least 0"),
        ("import nothing_like_it", "failed to import"),
    ],
)
def test_a_strangers_broken_method(tmp_path: Path, source: str, message: str) -> None:
    with packages_in(tmp_path) as packages:
        packages.install("acme-m", {"fprf.methods": {"acme-m": "acme_methods:m"}}, code={"acme_methods": source})
        with pytest.raises(PluginError, match="'acme-m'") as caught:
            load_method("acme-m")
        assert message in str(caught.value)
        assert "acme-m" in dict(methods())
    assert "acme_methods" not in sys.modules


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
    assert chosen == fprf_lite()


@settings(max_examples=25, deadline=None)
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


@given(st.lists(st.sampled_from(["--quiet", "--strength", "none", "r", "--x", "1", "--no-quiet", "--size"]), max_size=7))
def test_spelling_is_idempotent(args: list[str]) -> None:
    flags = flags_of(Verb())
    once = spell(args, flags)
    assert spell(once, flags) == once
