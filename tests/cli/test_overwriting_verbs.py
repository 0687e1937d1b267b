"""Nothing is lost: no verb overwrites what it reads or what others have made; paths as users write them."""

import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from splat_ball import ball
from tiny_world import World

import fprf
from fprf.cli import main as cli
from fprf.errors import UsageError
from fprf.io.images import write_image
from fprf.splats.files import read_capture, write_gaussians
from fprf.style.config import StyleConfig

SMALL = ["--semantic.encoder", "bundled-semantic", "--regions", "3", "--views", "3", "--size", "64", "48"]


def photo(path: Path, colour: tuple[int, int, int]) -> Path:
    noise = np.random.default_rng(sum(colour)).integers(-30, 30, (48, 64, 3))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, np.clip(np.array(colour) + noise, 0, 255).astype(np.uint8))
    return path


@pytest.fixture
def yard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in: yard.ply, and photographs of one name in two folders."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_gaussians(tmp_path / "yard.ply", ball(150))
    photo(tmp_path / "summer" / "IMG_1.jpg", (60, 140, 60))
    photo(tmp_path / "winter" / "IMG_1.jpg", (190, 200, 230))
    return tmp_path


def restyle(*words: str) -> int:
    return cli.main(["restyle", *words, *SMALL])


def test_restyle_replaces_what_it_made_and_nothing_else(
    yard: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (yard / "yard.ply").read_bytes()
    (yard / "link.ply").symlink_to("yard.ply")
    os.link("yard.ply", "hard.ply")
    summer = ["--references", "summer/IMG_1.jpg"]
    photograph = (yard / "summer" / "IMG_1.jpg").read_bytes()
    for output in ("yard.ply", "link.ply", "hard.ply", "summer/../yard.ply", str(yard / "yard.ply")):
        assert restyle("yard.ply", *summer, "--output", output) == 2
        told = capsys.readouterr().err
        assert told.count("\n") == 1 and "--overwrite true" in told
    assert {path.read_bytes() for path in yard.glob("*.ply")} == {before}
    assert restyle("yard.ply", *summer, "--output", "new.ply") == 0
    first = (yard / "new.ply").read_bytes()
    assert restyle("yard.ply", *summer, "--output", "new.ply", "--strength", "0.5") == 0
    second = (yard / "new.ply").read_bytes()
    assert first != second, "of the same files it is replaced, whatever the other flags"
    assert restyle("yard.ply", "--references", "winter/IMG_1.jpg", "--output", "new.ply") == 2
    (yard / "page.html").write_text("mine")
    assert restyle("yard.ply", *summer, "--page", "page.html") == 2
    assert (yard / "page.html").read_text() == "mine" and (yard / "new.ply").read_bytes() == second
    assert restyle("new.ply", *summer, "--output", "link.ply", "--overwrite", "true") == 0
    assert (yard / "link.ply").is_symlink() and (yard / "yard.ply").read_bytes() != before
    assert (yard / "hard.ply").read_bytes() == before
    assert (yard / "summer" / "IMG_1.jpg").read_bytes() == photograph


def test_a_style_file_that_is_read_stays(yard: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert restyle("yard.ply", "--references", "summer/IMG_1.jpg", "--output", "a.ply") == 0
    saved = (yard / "a.style.json").read_bytes()
    again = ["yard.ply", "--style", "a.style.json", "--strength", "0.5", "--output", "a.spz"]
    for _ in range(2):
        assert restyle(*again) == 0
    assert (yard / "a.style.json").read_bytes() == saved
    assert json.loads((yard / "a-2.style.json").read_text())["style"]["strength"] == 0.5
    assert not (yard / "a-3.style.json").exists() and "a-2.style.json" in capsys.readouterr().err


def test_folders_wildcards_and_the_home_folder(
    yard: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("HOME", str(yard))
    (yard / "tiles").mkdir()
    for name in ("a.ply", "b.ply"):
        shutil.copy("yard.ply", yard / "tiles" / name)
    photos = ["--references", "*/IMG_?.jpg", "--weights", "1", "2"]
    for captures, out in (("tiles/*.ply", "one"), ("tiles", "two"), ("~/tiles/*.ply", "three")):
        assert restyle(captures, *photos, f"--output=~/{out}") == 0
        assert {path.name for path in (yard / out).glob("*.ply")} == {"a.ply", "b.ply"}
    assert not (yard / "~").exists()
    style = json.loads((yard / "one" / "a.style.json").read_text())["style"]
    assert [Path(path).parent.name for path in style["references"]] == ["summer", "winter"]
    capsys.readouterr()
    for words in (["tiles/*.spz"], ["empty"], ["yard.ply", "--style", "*.json"]):
        (yard / "empty").mkdir(exist_ok=True)
        assert restyle(*words, *photos, "--output", "four") == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert not (yard / "four").exists()


def test_a_folder_of_a_style_belongs_to_one(
    run: Path, yard: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["stylize", str(run), "--no-matches", "--clusters", "2"]

    def stylize(*more: str) -> int:
        return cli.main([*words, *more])

    styles = run / "styles"
    assert stylize("--references", "summer/IMG_1.jpg", "--views", "0000", "0001") == 0
    before = {path.name: path.read_bytes() for path in (styles / "IMG_1").glob("[!.]*")}
    assert stylize("--references", "winter/IMG_1.jpg", "--views", "0002") == 0
    assert f"this one goes to {styles / 'IMG_1-2'}" in capsys.readouterr().out
    assert (
        stylize("--style", str(styles / "IMG_1" / "style.json"), "--views", "0003", "--strength", "0.5") == 0
    )
    assert {path.name: path.read_bytes() for path in (styles / "IMG_1").glob("[!.]*")} == before
    found = {path.parent.name: path.name for path in styles.glob("*/*.png") if path.parent.name != "IMG_1"}
    assert found == {"IMG_1-2": "0002.png", "IMG_1-3": "0003.png"}
    # Again, of the same files: in its place, and never two styles in one folder.
    assert stylize("--references", "summer/IMG_1.jpg", "--views", "0002") == 0
    assert {path.name for path in (styles / "IMG_1").glob("*.png")} == {"0000.png", "0001.png", "0002.png"}
    assert stylize("--references", "summer/IMG_1.jpg", "--views", "0004", "--strength", "0.5") == 0
    assert {path.name for path in (styles / "IMG_1").glob("*.png")} == {"0004.png"}
    assert stylize("--references", "winter/IMG_1.jpg", "--output", str(styles / "IMG_1")) == 2
    assert {path.name for path in (styles / "IMG_1").glob("*.png")} == {"0004.png"}


def test_verbs_of_runs_ask_as_well(run: Path, yard: Path) -> None:
    summer, winter = (
        ["--references", f"{name}/IMG_1.jpg", "--clusters", "2"] for name in ("summer", "winter")
    )
    for words in (
        ["gallery", str(run), "--most", "1", "--output", "g.html"],
        ["render", str(run), "--path", "orbit", "--frames", "1", "--output", "f.gif"],
    ):
        path = yard / words[-1]
        path.write_text("mine")
        assert cli.main([*words, *summer]) == 2 and path.read_text() == "mine"
        assert cli.main([*words, *summer, "--overwrite", "true"]) == 0
        made = path.read_bytes()
        assert cli.main([*words, *winter]) == 2 and path.read_bytes() == made
        assert cli.main([*words, *summer]) == 0
    frames = yard / "frames"
    photo(frames / "00000.png", (1, 2, 3))
    mine = (frames / "00000.png").read_bytes()
    assert cli.main(["render", str(run), "--path", "orbit", "--frames", "2", "--output", "frames"]) == 2
    assert [path.read_bytes() for path in frames.iterdir()] == [mine]
    # The scene as it is stays the same file for all styles; files of one name and other photographs ask.
    export = ["export", str(run), "cameras", "--output", "e"]
    assert [cli.main([*export, *more]) for more in ([], summer, winter, ["--images"])] == [0, 0, 0, 0]
    (yard / "t.json").write_text("mine")
    assert cli.main(["export", str(run), "cameras", "--output", "t.json"]) == 2
    assert (yard / "t.json").read_text() == "mine"
    (run / "metrics.json").write_text("mine")
    assert cli.main(["eval", str(run)]) == 2 and (run / "metrics.json").read_text() == "mine"
    assert cli.main(["eval", str(run), "--overwrite", "true"]) == cli.main(["eval", str(run)]) == 0


def test_training_replaces_no_other_files(world: World, tmp_path: Path) -> None:
    (tmp_path / "scene.json").write_text("mine")
    words = ["train", "fprf-lite", "--data", str(world.town), "--output", str(tmp_path), "--steps", "1"]
    assert cli.main(words) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["scene.json"]
    assert (tmp_path / "scene.json").read_text() == "mine"


def test_python_saves_ask_and_take_paths_of_any_kind(run: Path, yard: Path) -> None:
    scene = fprf.load(str(run), device="cpu")
    for references in ("summer/IMG_1.jpg", Path("summer/IMG_1.jpg"), ["summer/IMG_1.jpg"]):
        styled = scene.stylize(references, clusters=2, keep="1", weights=(2,))
        assert styled.references == ("IMG_1.jpg",)
    photograph = (yard / "summer" / "IMG_1.jpg").read_bytes()
    with pytest.raises(UsageError, match="overwrite=True"):
        styled.render(0).save("summer/IMG_1.jpg")
    styled.save_style("s.json")
    again = scene.apply("s.json")
    with pytest.raises(UsageError):
        again.save_style("s.json")
    scan = fprf.read("yard.ply", views=3, up=(0, 0, 1))
    assert scan.look.up == (0.0, 0.0, 1.0)
    for output in ("yard.ply", yard / "yard.ply"):
        with pytest.raises(UsageError):
            scan.write(output)
    for output in ("x.spz", Path("x.spz")):
        scan.write(output)
    with pytest.raises(UsageError):
        fprf.read("x.spz").write("yard.ply")
    fprf.read("x.spz").write("yard.ply", overwrite=True)
    assert (yard / "summer" / "IMG_1.jpg").read_bytes() == photograph


def test_configs_take_values_as_python_writes_them() -> None:
    style = StyleConfig(
        references=["a.jpg", Path("b.jpg")], weights=np.array([1, 2]), keep="3", between="c.json"
    )  # type: ignore[arg-type]
    assert style.references == (Path("a.jpg"), Path("b.jpg")) and style.between == Path("c.json")
    assert style.weights == (1.0, 2.0) and style.keep == ("3",)
    assert StyleConfig(references="a.jpg") == StyleConfig(references=(Path("a.jpg"),))  # type: ignore[arg-type]


def test_a_capture_behind_a_byte_order_mark(yard: Path) -> None:
    plain = (yard / "yard.ply").read_bytes()
    (yard / "bom.ply").write_bytes(b"\xef\xbb\xbf" + plain)
    read = [read_capture(Path(name)).gaussians.harmonics for name in ("yard.ply", "bom.ply")]
    assert np.array_equal(*read)
    assert restyle("bom.ply", "--references", "summer/IMG_1.jpg", "--output", "new.ply") == 0
    assert len((yard / "new.ply").read_bytes()) == len(plain) + 3


@pytest.mark.skipif(os.name == "nt", reason="no colons in names there")
def test_films_with_a_colon_in_their_names(run: Path, yard: Path) -> None:
    assert cli.main(["render", str(run), "--path", "orbit", "--frames", "3", "--output", "10:30.mp4"]) == 0
    assert cv2.VideoCapture(str(yard / "10:30.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 3


def test_a_folder_of_videos_is_one_video_or_asks(yard: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (yard / "clips").mkdir()
    for name in ("a.mp4", "b.MP4"):
        (yard / "clips" / name).write_bytes(b"no video")
        assert cli.main(["process", "clips", "--output", "scene"]) == 2
        told = capsys.readouterr().err.splitlines()[-1]
        assert ("a scene is made of one" in told) == (name == "b.MP4") and "a.mp4" in told
