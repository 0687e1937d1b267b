import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_world import World

from fprf import cli
from fprf.style.dictionary import load_dictionary

KEYS = {"references", "strength", "dictionary_seconds", "seconds_per_view", "codes", "matches"}


@pytest.fixture
def run(world: World, tmp_path: Path) -> Path:
    shutil.copytree(world.run, tmp_path / "run")
    return tmp_path / "run"


def stylize(run: Path, world: World, *args: str) -> int:
    return cli.main(["stylize", str(run), "--references", *map(str, world.references), *args])


def test_pictures_pair_up_by_stem(run: Path, world: World, capsys: pytest.CaptureFixture[str]) -> None:
    assert stylize(run, world) == 0
    folder = run / "styles" / "dusk+snow"
    names = {p.name for p in folder.iterdir()}
    assert names == {
        "0000.png", "0008.png", "0000-match.png", "0008-match.png", "dictionary.safetensors", "style.json"
    }  # fmt: skip
    stems = {p.stem for p in (world.town / "images").iterdir()}
    assert {name.removesuffix(".png") for name in names if name.endswith(".png") and "match" not in name} <= stems
    assert all(cv2.imread(str(folder / name)).shape == (24, 32, 3) for name in ("0000.png", "0008.png"))
    assert capsys.readouterr().out.startswith(f"2 views in {folder}  (style ")


def test_style_json_and_the_dictionary(run: Path, world: World, tmp_path: Path) -> None:
    assert stylize(run, world, "--output", str(tmp_path / "s"), "--clusters", "3", "--strength", "0.5") == 0
    found = json.loads((tmp_path / "s" / "style.json").read_text())
    dictionary = load_dictionary(tmp_path / "s" / "dictionary.safetensors")
    assert found.keys() >= KEYS and found["references"] == ["dusk.png", "snow.png"] and found["strength"] == 0.5
    assert found["codes"] == len(dictionary.keys) <= 6 and set(dictionary.names) == {"dusk.png", "snow.png"}
    assert found["matches"].keys() == {"0000", "0008"}
    for summary in found["matches"].values():
        assert {row["name"] for row in summary["references"]} == {"dusk.png", "snow.png"}
        assert sum(row["share"] for row in summary["references"]) == pytest.approx(1, abs=0.02)


def test_strength_0_is_the_plain_render_to_the_byte(run: Path, world: World, tmp_path: Path) -> None:
    assert cli.main(["eval", str(run)]) == 0
    assert stylize(run, world, "--strength", "0", "--no-matches", "--output", str(tmp_path / "s")) == 0
    for stem in ("0000", "0008"):
        plain, styled = (cv2.imread(str(p / f"{stem}.png")) for p in (run / "renders" / "test", tmp_path / "s"))
        assert np.array_equal(plain, styled)
    assert {p.name for p in (tmp_path / "s").iterdir()} == {"0000.png", "0008.png", "dictionary.safetensors", "style.json"}


def test_all_splits_and_stylizers(run: Path, world: World, tmp_path: Path) -> None:
    seen = {}
    for name in ("identity", "adain", "local-adain", "region-adain", "region-ot"):
        out = tmp_path / name
        assert stylize(run, world, "--stylizer", name, "--clusters", "2", "--output", str(out), "--no-matches") == 0
        seen[name] = cv2.imread(str(out / "0000.png")).astype(int)
    names = list(seen)
    assert not any(np.array_equal(seen[a], seen[b]) for i, a in enumerate(names) for b in names[:i])
    assert stylize(run, world, "--split", "all", "--no-matches", "--output", str(tmp_path / "all")) == 0
    assert len(list((tmp_path / "all").glob("*.png"))) == 10


@pytest.mark.parametrize(
    ("args", "told"),
    [
        ([], "--references: at least one photograph is needed"),
        (["--references", "absent.jpg"], "absent.jpg: "),
        (["--references", "A", "B", "--weights", "1"], "--weights: 1 weights for 2 references"),
        (["--references", "A", "--weights", "0"], "--weights: 0.0 must be at least 1e-06"),
        (["--references", "A", "--strength", "2"], "--strength: 2.0 must lie in [0.0, 1.0]"),
        (["--references", "A", "--clusters", "0"], "--clusters: 0 must be at least 1"),
        (["--references", "A", "--stylizer", "region-to"], "did you mean 'region-ot'"),
        (["--references", "A", "--stylizer", "adain", "--stylizer.gain", "2"], "stylizer is adain"),
        (["--references"], "--references"),
    ],
)
def test_mistakes(run: Path, world: World, args: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    files = {"A": str(world.references[0]), "B": str(world.references[1])}
    assert cli.main(["stylize", str(run), *(files.get(arg, arg) for arg in args)]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("error: ") and err.count("\n") == 1 and told in err
    assert not (run / "styles").exists()


def test_a_scene_without_measured_style_says_what_to_do(run: Path, world: World, capsys: pytest.CaptureFixture[str]) -> None:
    (run / "style.safetensors").unlink()
    assert stylize(run, world) == 2
    assert "style.safetensors: not written yet; finish training with `fprf train" in capsys.readouterr().err


def test_default_names_are_bounded() -> None:
    from fprf.commands.stylize import _name

    few = (Path("a/autumn.jpg"), Path("night.png"))
    assert _name(few) == "autumn+night"
    many = tuple(Path(f"reference_with_a_long_name_{i}.jpg") for i in range(100))
    assert len(_name(many).encode()) < 100
