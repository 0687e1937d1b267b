"""A style file under the flags."""

from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from fprf.cli.style_flags import named_styles, read_flags
from fprf.errors import ConfigError, DataError, UsageError
from fprf.plugins.stylizers.config import LocalAdainConfig, RegionOtConfig
from fprf.style.config import PRESETS, StyleConfig, preset_flags, with_preset
from fprf.style.files import StyleFile, write_style


@dataclass(frozen=True, kw_only=True)
class Verb(StyleConfig):
    """A verb that restyles."""

    run: Path = Path()
    """Run folder."""
    style: Path | None = None
    """Style file."""
    frames: int = 3
    """Something of its own."""


def read(*args: str) -> tuple[Verb, StyleFile]:
    return read_flags(Verb(), args, prog="fprf verb", description="", positional=("run",))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "a.jpg").write_text("pixels")
    stylizer = LocalAdainConfig(temperature=0.2)
    style = StyleConfig(references=(tmp_path / "a.jpg",), stylizer=stylizer, pin=("sky=0",), weights=(2.0,))
    write_style(tmp_path / "style.json", StyleFile(style, {"sky": (1.0, 2.0)}, "encoder"))
    return tmp_path / "style.json"


def test_flags_of_many_values_may_be_repeated() -> None:
    words = """RUN --pin 3=a.jpg --references=a.jpg --pin 5=b.jpg 0:1,2=0 --frames 7 --references b.jpg
        --region_strength 1=0.5 --region-strength=2=0.5 --keep-below -0.5"""
    config, found = read(*words.split())
    assert config.frames == 7 and found.style.references == (Path("a.jpg"), Path("b.jpg"))
    assert found.style.pin == ("3=a.jpg", "5=b.jpg", "0:1,2=0") and found.style.keep_below == -0.5
    assert found.style.region_strength == ("1=0.5", "2=0.5")


@pytest.mark.parametrize("spelling", ["--style FILE", "--style=FILE"])
def test_a_file_gives_what_no_flag_gives(file: Path, spelling: str) -> None:
    words = spelling.replace("FILE", str(file)).split(" ")
    config, found = read("RUN", *words, "--stylizer.similarity", "dot", "--clusters", "4")
    assert config.style == file and config.stylizer == LocalAdainConfig(temperature=0.2, similarity="dot")
    assert found.style.pin == ("sky=0",) and found.style.clusters == 4 and found.regions == {"sky": (1.0, 2.0)}
    config, found = read("RUN", *words, "--stylizer", "region-ot", "--pin", "3=0")
    assert found.style.stylizer == RegionOtConfig() and found.style.pin == ("3=0",)


def test_photographs_of_the_file_are_checked_unless_named(file: Path) -> None:
    photo = file.parent / "a.jpg"
    photo.write_text("other pixels")
    with pytest.raises(DataError, match="has changed"):
        read("RUN", "--style", str(file))
    assert read("RUN", "--style", str(file), "--references", str(photo))[1].style.references == (photo,)


def test_what_does_not_fit_together_is_named(file: Path) -> None:
    for kind, told, words in (
        (ConfigError, "weights: 1 weights for 2 references", ["RUN", "--style", str(file), "--references", "x.jpg", "y.jpg"]),
        (ConfigError, r"none\.json: cannot be read", ["RUN", "--style", "none.json"]),
        (UsageError, "--style", ["RUN", "--style"]),
    ):
        with pytest.raises(kind, match=told):
            read(*words)


def test_a_preset_lies_over_the_file_and_below_the_flags(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config, found = read("--gentle", "RUN", "--references", "a.jpg", "--luminance", "0.9")
    assert config.luminance == found.style.luminance == 0.9 and found.style.references == (Path("a.jpg"),)
    gentle = with_preset(StyleConfig(references=(Path("a.jpg"),)), "gentle")
    assert found.style == replace(gentle, luminance=0.9)
    assert capsys.readouterr().out == f"--gentle: {preset_flags('gentle')}\n"
    config, _ = read("RUN", "--style", str(file), "--gentle")
    assert config.strength == PRESETS["gentle"]["strength"] and config.weights == (2.0,)


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_is_what_its_flags_say(name: str) -> None:
    assert read("RUN", f"--{name}")[1] == read("RUN", *preset_flags(name).split())[1]
    assert with_preset(StyleConfig(), name) != StyleConfig()


@pytest.mark.parametrize("text", ["dusk", "=a.jpg", "dusk=", "du sk=a.jpg", "../x=a.jpg"])
def test_other_forms_of_named_styles_are_refused(text: str) -> None:
    with pytest.raises(UsageError):
        named_styles([text], StyleFile(StyleConfig()))
