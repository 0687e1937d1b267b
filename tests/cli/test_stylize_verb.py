"""`fprf stylize`, and a style file under the flags of any verb."""

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from safetensors import safe_open
from safetensors.torch import load_file
from tiny_world import World

from fprf.cli import main as cli
from fprf.cli.restyle_outputs import RestyleConfig
from fprf.cli.style_flags import read_flags
from fprf.errors import ConfigError, DataError, UsageError
from fprf.io import tensorfiles
from fprf.plugins.stylizers.config import LocalAdainConfig, RegionConfig, RegionOtConfig
from fprf.style.config import PRESETS, StyleConfig, preset_flags, with_preset
from fprf.style.files import StyleFile, write_style

MADE = {"dictionary_seconds", "seconds_per_view", "match_seconds_per_view", "codes", "matches"}


def stylize(run: Path, world: World, output: Path, *words: str) -> dict[str, Any]:
    """Restyle the held-out views with both references; the style file that is written."""
    references = ["--references", *map(str, world.references)]
    assert (
        cli.main(["stylize", str(run), "--split", "test", *references, "--output", str(output), *words]) == 0
    )
    return json.loads((output / "style.json").read_text())


def test_folders_stand_for_their_photographs_and_views_are_some(
    run: Path, world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = tmp_path / "photos"
    out = tmp_path / "s"
    photos.mkdir()
    for path in world.references:
        shutil.copy(path, photos)
    (photos / "broken.jpg").write_bytes(b"not a photograph")
    args = [
        "stylize",
        str(run),
        "--references",
        str(photos),
        "--weights",
        "2",
        "--no-matches",
        "--output",
        str(out),
    ]
    assert cli.main(args) == 0
    assert "broken.jpg: no PNG, JPEG" in capsys.readouterr().err
    style = json.loads((out / "style.json").read_text())["style"]
    assert [Path(path).name for path in style["references"]] == ["dusk.png", "snow.png"] and style[
        "weights"
    ] == [2, 2]
    known = world.load().known
    assert {p.stem for p in out.glob("*.png")} == {known.names[view] for view in known.split("some")}
    assert len(known.split("some")) == 8
    assert cli.main([*args, "--masks", str(world.references[0])]) == 2
    assert "is for one photograph" in capsys.readouterr().err


def test_style_json_and_the_dictionary(run: Path, world: World, tmp_path: Path) -> None:
    found = stylize(run, world, tmp_path / "s", "--clusters", "3", "--strength", "0.5")
    with safe_open(tmp_path / "s" / "dictionary.safetensors", "pt") as dictionary:
        codes = dictionary.get_slice("keys").get_shape()[0]
        names = json.loads(dictionary.metadata()["names"])
    style = found["style"]
    made = found["made"]
    assert (
        style["references"] == [str(p) for p in world.references]
        and style["strength"] == 0.5
        and style["clusters"] == 3
    )
    assert made.keys() == MADE and made["codes"] == codes <= 6
    assert set(names) == {"dusk.png", "snow.png"} and made["matches"].keys() == {"0000", "0008"}
    for summary in made["matches"].values():
        assert {row["name"] for row in summary["references"]} == {"dusk.png", "snow.png"}
        assert sum(row["share"] for row in summary["references"]) == pytest.approx(1, abs=0.02)
        assert summary.keys() > {"score", "entropy_bits", "kept_share", "codes", "regions"}


def test_a_style_file_is_the_same_style_again_and_flags_come_over_it(
    run: Path, world: World, tmp_path: Path
) -> None:
    wishes = [
        "--clusters",
        "3",
        "--pin",
        "0002:15,20=snow",
        "--keep",
        "1",
        "--luminance",
        "0.5",
        "--stylizer",
        "region-ot",
    ]
    first = stylize(run, world, tmp_path / "a", *wishes)
    file = ["--style", str(tmp_path / "a" / "style.json")]
    again = ["stylize", str(run), "--split", "test", *file, "--output"]
    assert cli.main([*again, str(tmp_path / "b")]) == 0
    assert cli.main([*again, str(tmp_path / "c"), "--strength", "0.5"]) == 0
    for name in ("0000.png", "0000-match.png", "0008.png"):
        a, b, c = (cv2.imread(str(tmp_path / folder / name)) for folder in "abc")
        assert np.array_equal(a, b) and np.array_equal(a, c) == ("match" in name)
    second, third = (json.loads((tmp_path / folder / "style.json").read_text()) for folder in "bc")
    assert first.pop("made") and second.pop("made") and first == second
    assert third["style"] == first["style"] | {"strength": 0.5}


def test_a_style_of_another_scene_finds_its_regions_by_their_keys(
    run: Path, world: World, tmp_path: Path
) -> None:
    """The same scene with its regions in another order stands for another scene: numbers differ, semantics
    don't.
    """
    stylize(run, world, tmp_path / "a", "--keep", "0", "--no-matches")
    other = shutil.copytree(run, tmp_path / "other")
    tensors = load_file(other / "style.safetensors")
    turned = {
        k: v.flip(0) if k in ("keys", "region_mean", "region_covariance", "share") else v
        for k, v in tensors.items()
    }
    tensorfiles.save(other / "style.safetensors", turned, sealed=True)
    file = ["--style", str(tmp_path / "a" / "style.json"), "--split", "test", "--no-matches"]
    assert cli.main(["stylize", str(other), *file, "--output", str(tmp_path / "b")]) == 0
    a, b = (cv2.imread(str(tmp_path / folder / "0000.png")).astype(int) for folder in "ab")
    assert np.abs(a - b).max() <= 1
    stylize(other, world, tmp_path / "wrong", "--keep", "0", "--no-matches")
    assert np.abs(a - cv2.imread(str(tmp_path / "wrong" / "0000.png"))).max() > 1


def test_explain_lists_regions_and_renders_nothing(
    run: Path, world: World, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--explain", "--clusters", "3", "--keep", "1"]
    assert cli.main(["stylize", str(run), "--references", *map(str, world.references), *words]) == 0
    folder = run / "styles" / "dusk+snow"
    out = capsys.readouterr().out
    assert {p.name for p in folder.glob("[!.]*")} == {
        "explain.json",
        "explain.png",
        "dictionary.safetensors",
        "style.json",
    }
    listed = json.loads((folder / "explain.json").read_text())
    assert out.splitlines()[0].split() == [
        "region",
        "share",
        "seen",
        "best",
        "at",
        "strength",
        "sure",
        "entropy",
        "takes",
    ]
    assert len(listed["regions"]) == 4 and [line.split()[0] for line in out.splitlines()[1:5]] == list("0123")
    assert " kept " in out.splitlines()[2] and "(score " in out.splitlines()[1]
    assert sorted(listed["references"]) == ["dusk.png", "snow.png"]
    assert cv2.imread(str(folder / "explain.png")).shape[1] > 4 * 240


def test_match_maps_alone(
    run: Path, world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--match-only", "--views", "0003", "0001", "--clusters", "2"]
    made = stylize(run, world, tmp_path / "m", *words)["made"]
    kinds = ("match.png", "score.png", "confidence.png", "entropy.png")
    expected = {f"{view}-{kind}" for view in ("0001", "0003") for kind in kinds}
    assert {p.name for p in (tmp_path / "m").glob("[!.]*")} == expected | {
        "dictionary.safetensors",
        "style.json",
    }
    assert made.keys() == MADE - {"seconds_per_view"} and made["matches"].keys() == {"0003", "0001"}
    assert "2 match maps in" in capsys.readouterr().out
    stylize(run, world, tmp_path / "both", "--match-only", "--explain")
    assert {"explain.json", "0000-score.png"} < {p.name for p in (tmp_path / "both").glob("[!.]*")}


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
    assert (
        found.style.pin == ("sky=0",) and found.style.clusters == 4 and found.regions == {"sky": (1.0, 2.0)}
    )
    config, found = read("RUN", *words, "--stylizer", "region-ot", "--pin", "3=0")
    assert found.style.stylizer == RegionOtConfig() and found.style.pin == ("3=0",)


def test_photographs_of_the_file_are_checked_unless_named(file: Path) -> None:
    photo = file.parent / "a.jpg"
    photo.write_text("other pixels")
    with pytest.raises(DataError, match="has changed"):
        read("RUN", "--style", str(file))
    with pytest.raises(DataError, match="has changed"):
        read("RUN", "--style", str(file), "--masks", "none")
    assert read("RUN", "--style", str(file), "--references", str(photo))[1].style.references == (photo,)


def test_what_does_not_fit_together_is_named(file: Path) -> None:
    for kind, told, words in (
        (
            ConfigError,
            "weights: 1 weights for 2 references",
            ["RUN", "--style", str(file), "--references", "x.jpg", "y.jpg"],
        ),
        (ConfigError, r"none\.json: cannot be read", ["RUN", "--style", "none.json"]),
        (UsageError, "--style", ["RUN", "--style"]),
    ):
        with pytest.raises(kind, match=told):
            read(*words)


def test_a_preset_lies_over_the_file_and_below_the_flags(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, found = read("--gentle", "RUN", "--references", "a.jpg", "--luminance", "0.9")
    assert config.luminance == found.style.luminance == 0.9 and found.style.references == (Path("a.jpg"),)
    gentle = with_preset(StyleConfig(references=(Path("a.jpg"),)), "gentle")
    assert found.style == replace(gentle, luminance=0.9)
    assert capsys.readouterr().out == f"--gentle: {preset_flags('gentle')}\n"
    for words in (["--gentle", "--stylizer", "region-ot"], ["--stylizer=region-ot", "--gentle"]):
        assert read("RUN", *words)[1].style.stylizer == RegionOtConfig(
            smoothness=PRESETS["gentle"]["stylizer.smoothness"]
        )
    config, _ = read("RUN", "--style", str(file), "--gentle")
    assert config.strength == PRESETS["gentle"]["strength"] and config.weights == (2.0,)


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_is_what_its_flags_say(name: str) -> None:
    assert read("RUN", f"--{name}")[1] == read("RUN", *preset_flags(name).split())[1]
    assert with_preset(StyleConfig(), name) != StyleConfig()


def test_captures_are_matched_uncentred_unless_somebody_says_otherwise(tmp_path: Path) -> None:
    path = tmp_path / "s.json"
    words = ["scan.ply", "--references", "a.jpg"]
    for flags, stylizer, wanted in (
        ("--stylizer region-ot", None, False),
        ("--stylizer region-ot --stylizer.centred true", None, True),
        (f"--style {path}", None, False),
        (f"--style {path}", {"type": "region-tone", "temperature": 0.2}, False),
        (f"--style {path}", {"type": "region-tone", "centred": True}, True),
        (f"--style {path} --stylizer region-ot", {"type": "adain"}, False),
    ):
        path.write_text(
            json.dumps({"format": 1, "style": {} if stylizer is None else {"stylizer": stylizer}})
        )
        args = [*words, *flags.split()]
        config, _ = read_flags(
            RestyleConfig(), args, prog="fprf restyle", description="", positional=("captures",)
        )
        assert isinstance(config.stylizer, RegionConfig) and config.stylizer.centred == wanted
