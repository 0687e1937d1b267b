from pathlib import Path
from unittest.mock import DEFAULT, Mock

import cv2
import numpy as np
import pytest
from tiny_world import World

from fprf.cli import main as cli
from fprf.io import images

CAPTURED = ["--path", "dataset", "--split", "test"]
ORBIT = ["--path", "orbit", "--frames"]


def pictures(folder: Path) -> dict[str, np.ndarray]:
    return {p.name: cv2.imread(str(p)) for p in sorted(folder.glob("*.png"))}


def render(run: Path, output: Path, *words: str) -> dict[str, np.ndarray]:
    assert cli.main(["render", str(run), *words, "--output", str(output)]) == 0
    return pictures(output)


def test_captured_views_keep_their_names_and_are_those_of_eval(run: Path, tmp_path: Path) -> None:
    frames = render(run, tmp_path / "frames", *CAPTURED)
    assert cli.main(["eval", str(run)]) == 0
    plain = pictures(run / "renders" / "test")
    assert frames.keys() == plain.keys() == {"0000.png", "0008.png"}
    assert all(np.array_equal(frames[name], plain[name]) for name in frames)


def test_a_film_is_a_file(run: Path, world: World, tmp_path: Path) -> None:
    render(run, tmp_path / "a.mp4", "--path", "spiral", "--frames", "2", "--references", str(world.references[0]))
    assert (tmp_path / "a.mp4").read_bytes()[4:8] == b"ftyp" and len(list(tmp_path.iterdir())) == 2


def test_several_looks_and_channels_lie_beside_each_other(run: Path, world: World, tmp_path: Path) -> None:
    dusk = f"dusk={world.references[0]}"
    styles = {
        "one": [dusk], "plain": [], "two": ["plain", dusk], "all": [dusk, "--show", "colour", "depth", "normals", "match"],
    }  # fmt: skip
    made = [render(run, tmp_path / name, *CAPTURED, "--styles", *words) for name, words in styles.items()]
    for one, plain, two, whole in zip(*(each.values() for each in made), strict=True):
        assert two.shape == (24, 66, 3) and whole.shape == (24, 134, 3)
        assert np.array_equal(two[:, :32], plain) and np.array_equal(two[:, 34:], one)
        assert np.array_equal(whole[:, :32], one)


def test_frames_that_are_there_are_not_made_again(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "frames"
    whole = render(run, out, *ORBIT, "4")
    stamps = {path.name: path.stat().st_mtime_ns for path in out.glob("*.png")}
    (out / "00002.png").unlink()
    capsys.readouterr()
    again = render(run, out, *ORBIT, "4")
    assert "3 of 4 frames are there already" in capsys.readouterr().out
    after = {path.name: path.stat().st_mtime_ns for path in out.glob("*.png")}
    assert [name for name in stamps if stamps[name] != after[name]] == ["00002.png"]
    assert all(np.array_equal(whole[name], picture) for name, picture in again.items())
    others = render(run, out, *ORBIT, "4", "--show", "depth")
    assert "are there already" not in capsys.readouterr().out, "other frames are other frames"
    assert not any(np.array_equal(whole[name], picture) for name, picture in others.items())


def test_an_interrupted_film_goes_on(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    film = tmp_path / "x.mp4"
    args = ["render", str(run), *ORBIT, "4", "--output", str(film)]
    write = Mock(wraps=images.write_image, side_effect=[DEFAULT, DEFAULT, KeyboardInterrupt])
    monkeypatch.setattr(images, "write_image", write)
    assert cli.main(args) == 130 and not film.exists()
    write.side_effect = None
    assert cli.main(args) == 0 and film.is_file()
    assert [call.args[0].name for call in write.call_args_list] == [f"0000{k}.png" for k in (0, 1, 2, 2, 3)]
    assert not (tmp_path / "x.frames").exists()
