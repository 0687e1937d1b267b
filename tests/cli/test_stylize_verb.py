import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from safetensors.torch import load_file
from tiny_world import World

from fprf.cli import main as cli
from fprf.style.dictionary import load_dictionary
from fprf.training import tensorfiles

MADE = {"dictionary_seconds", "seconds_per_view", "match_seconds_per_view", "codes", "matches"}


def stylize(run: Path, world: World, output: Path, *words: str) -> dict[str, Any]:
    """Restyle the held-out views with both references; the style file that is written."""
    references = ["--references", *map(str, world.references)]
    assert cli.main(["stylize", str(run), "--split", "test", *references, "--output", str(output), *words]) == 0
    return json.loads((output / "style.json").read_text())


def test_folders_stand_for_their_photographs_and_views_are_the_covered_ones(
    run: Path, world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos, out = tmp_path / "photos", tmp_path / "s"
    photos.mkdir()
    for path in world.references:
        shutil.copy(path, photos)
    (photos / "broken.jpg").write_bytes(b"not a photograph")
    args = ["stylize", str(run), "--references", str(photos), "--weights", "2", "--no-matches", "--output", str(out)]
    assert cli.main(args) == 0
    assert "broken.jpg: no PNG, JPEG" in capsys.readouterr().err
    style = json.loads((out / "style.json").read_text())["style"]
    assert [Path(path).name for path in style["references"]] == ["dusk.png", "snow.png"] and style["weights"] == [2, 2]
    known = world.load().known
    assert {p.stem for p in out.glob("*.png")} == {known.names[view] for view in known.split("covered")}
    assert len(known.split("covered")) == 8
    assert cli.main([*args, "--masks", str(world.references[0])]) == 2
    assert "is for one photograph" in capsys.readouterr().err


def test_style_json_and_the_dictionary(run: Path, world: World, tmp_path: Path) -> None:
    found = stylize(run, world, tmp_path / "s", "--clusters", "3", "--strength", "0.5")
    dictionary = load_dictionary(tmp_path / "s" / "dictionary.safetensors")
    style, made = found["style"], found["made"]
    assert style["references"] == [str(p) for p in world.references] and style["strength"] == 0.5 and style["clusters"] == 3
    assert made.keys() == MADE and made["codes"] == len(dictionary.keys) <= 6
    assert set(dictionary.names) == {"dusk.png", "snow.png"} and made["matches"].keys() == {"0000", "0008"}
    for summary in made["matches"].values():
        assert {row["name"] for row in summary["references"]} == {"dusk.png", "snow.png"}
        assert sum(row["share"] for row in summary["references"]) == pytest.approx(1, abs=0.02)
        assert summary.keys() > {"score", "entropy_bits", "kept_share", "codes", "regions"}


def test_a_style_file_is_the_same_style_again_and_flags_come_over_it(run: Path, world: World, tmp_path: Path) -> None:
    wishes = ["--clusters", "3", "--pin", "0002:15,20=snow", "--keep", "1", "--luminance", "0.5", "--stylizer", "region-ot"]
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


def test_a_style_of_another_scene_finds_its_regions_by_their_keys(run: Path, world: World, tmp_path: Path) -> None:
    """The same scene with its regions in another order stands for another scene: numbers differ, semantics don't."""
    stylize(run, world, tmp_path / "a", "--keep", "0", "--no-matches")
    other = shutil.copytree(run, tmp_path / "other")
    tensors = load_file(other / "style.safetensors")
    turned = {k: v.flip(0) if k in ("keys", "region_mean", "region_covariance", "share") else v for k, v in tensors.items()}
    tensorfiles.save(other / "style.safetensors", turned, sealed=True)
    file = ["--style", str(tmp_path / "a" / "style.json"), "--no-matches"]
    assert cli.main(["stylize", str(other), *file, "--output", str(tmp_path / "b")]) == 0
    a, b = (cv2.imread(str(tmp_path / folder / "0000.png")).astype(int) for folder in "ab")
    assert np.abs(a - b).max() <= 1
    stylize(other, world, tmp_path / "wrong", "--keep", "0", "--no-matches")
    assert np.abs(a - cv2.imread(str(tmp_path / "wrong" / "0000.png"))).max() > 1


def test_explain_lists_regions_and_renders_nothing(run: Path, world: World, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--explain", "--clusters", "3", "--keep", "1"]
    assert cli.main(["stylize", str(run), "--references", *map(str, world.references), *words]) == 0
    folder, out = run / "styles" / "dusk+snow", capsys.readouterr().out
    assert {p.name for p in folder.iterdir()} == {"explain.json", "explain.png", "dictionary.safetensors", "style.json"}
    listed = json.loads((folder / "explain.json").read_text())
    assert out.splitlines()[0].split() == ["region", "share", "seen", "best", "at", "strength", "sure", "entropy", "takes"]
    assert len(listed["regions"]) == 4 and [line.split()[0] for line in out.splitlines()[1:5]] == list("0123")
    assert " kept " in out.splitlines()[2] and "(score " in out.splitlines()[1]
    assert sorted(listed["references"]) == ["dusk.png", "snow.png"]
    assert cv2.imread(str(folder / "explain.png")).shape[1] > 4 * 240


def test_match_maps_alone(run: Path, world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--match-only", "--views", "0003", "0001", "--pixels", "--clusters", "2"]
    made = stylize(run, world, tmp_path / "m", *words)["made"]
    kinds = ("match.png", "score.png", "confidence.png", "entropy.png", "match.npz")
    expected = {f"{view}-{kind}" for view in ("0001", "0003") for kind in kinds}
    assert {p.name for p in (tmp_path / "m").iterdir()} == expected | {"dictionary.safetensors", "style.json"}
    assert made.keys() == MADE - {"seconds_per_view"} and made["matches"].keys() == {"0003", "0001"}
    assert "2 match maps in" in capsys.readouterr().out
    with np.load(tmp_path / "m" / "0003-match.npz") as file:
        assert file["reference"].shape == (24, 32)
    stylize(run, world, tmp_path / "both", "--match-only", "--explain")
    assert {"explain.json", "0000-score.png"} < {p.name for p in (tmp_path / "both").iterdir()}
