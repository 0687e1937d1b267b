from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_world import World

from fprf.cli import main as cli


def pictures(folder: Path) -> dict[str, np.ndarray]:
    return {p.name: cv2.imread(str(p)) for p in sorted(folder.glob("*.png"))}


def test_captured_views_keep_their_names_and_are_those_of_eval(run: Path, tmp_path: Path) -> None:
    args = ["render", str(run), "--path", "dataset", "--split", "test", "--output", str(tmp_path / "frames")]
    assert cli.main(args) == 0
    assert cli.main(["eval", str(run)]) == 0
    frames, plain = pictures(tmp_path / "frames"), pictures(run / "renders" / "test")
    assert frames.keys() == plain.keys() == {"0000.png", "0008.png"}
    assert all(np.array_equal(frames[name], plain[name]) for name in frames)


def test_a_gif_is_a_file_and_other_films_are_refused(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ["render", str(run), "--path", "spiral", "--frames", "2", "--output"]
    assert cli.main([*args, str(tmp_path / "a.gif")]) == 0
    assert (tmp_path / "a.gif").read_bytes().startswith(b"GIF89a") and len(list(tmp_path.iterdir())) == 2
    capsys.readouterr()
    assert cli.main([*args, str(tmp_path / "a.mov")]) == 2
    assert "films end in .mp4 .gif .webp .apng" in capsys.readouterr().err and not (tmp_path / "a.mov").exists()


def test_several_looks_and_channels_lie_beside_each_other(run: Path, world: World, tmp_path: Path) -> None:
    common = ["render", str(run), "--path", "dataset", "--split", "test", "--output"]
    dusk = f"dusk={world.references[0]}"
    assert cli.main([*common, str(tmp_path / "one"), "--styles", dusk]) == 0
    assert cli.main([*common, str(tmp_path / "plain")]) == 0
    assert cli.main([*common, str(tmp_path / "two"), "--styles", "plain", dusk]) == 0
    assert cli.main([*common, str(tmp_path / "all"), "--styles", dusk, "--show", "colour", "depth", "normals", "match"]) == 0
    assert cli.main([*common, str(tmp_path / "wipe"), "--styles", "plain", dusk, "--layout", "wipe"]) == 0
    one, plain, two, whole, wipe = (pictures(tmp_path / name) for name in ("one", "plain", "two", "all", "wipe"))
    for name in one:
        assert two[name].shape == (24, 66, 3) and whole[name].shape == (24, 134, 3) and wipe[name].shape == (24, 32, 3)
        assert np.array_equal(two[name][:, :32], plain[name]) and np.array_equal(two[name][:, 34:], one[name])
        assert np.array_equal(whole[name][:, :32], one[name])
        assert np.array_equal(wipe[name][:, :7], plain[name][:, :7]) and np.array_equal(wipe[name][:, -7:], one[name][:, -7:])


def test_frames_that_are_there_are_not_made_again(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "frames"
    common = ["render", str(run), "--path", "orbit", "--frames", "4", "--output", str(out)]
    assert cli.main(common) == 0
    whole = pictures(out)
    stamps = {path.name: path.stat().st_mtime_ns for path in out.glob("*.png")}
    (out / "00002.png").unlink()
    capsys.readouterr()
    assert cli.main(common) == 0
    assert "3 of 4 frames are there already" in capsys.readouterr().out
    after = {path.name: path.stat().st_mtime_ns for path in out.glob("*.png")}
    assert [name for name in stamps if stamps[name] != after[name]] == ["00002.png"]
    assert all(np.array_equal(whole[name], picture) for name, picture in pictures(out).items())
    assert cli.main([*common, "--show", "depth"]) == 0
    assert "are there already" not in capsys.readouterr().out, "other frames are other frames"
    assert not any(np.array_equal(whole[name], picture) for name, picture in pictures(out).items())


def test_an_interrupted_film_goes_on(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import fprf.io.images as images

    written, write = [], images.write_image

    def interrupted(path: Path, picture: np.ndarray) -> None:
        if len(written) == 2:
            raise KeyboardInterrupt
        written.append(path.name)
        write(path, picture)

    film = tmp_path / "x.mp4"
    args = ["render", str(run), "--path", "orbit", "--frames", "4", "--output", str(film)]
    monkeypatch.setattr(images, "write_image", interrupted)
    assert cli.main(args) == 130 and not film.exists()
    monkeypatch.setattr(images, "write_image", lambda path, picture: (written.append(path.name), write(path, picture)))
    assert cli.main(args) == 0 and film.is_file()
    assert written == ["00000.png", "00001.png", "00002.png", "00003.png"] and not (tmp_path / "x.frames").exists()


def test_exr_holds_everything_as_numbers(run: Path, world: World, tmp_path: Path) -> None:
    common = ["render", str(run), "--path", "dataset", "--split", "test", "--format", "exr", "--output"]
    assert cli.main([*common, str(tmp_path / "exr"), "--styles", "plain", f"dusk={world.references[0]}"]) == 0
    names = [path.name for path in sorted((tmp_path / "exr").glob("*.exr"))]
    assert names == ["0000.exr", "0008.exr"]
    head = (tmp_path / "exr" / "0000.exr").read_bytes()[:900]
    listed = [b"A", b"N.X", b"N.Y", b"N.Z", b"Z", b"dusk.B", b"dusk.G", b"dusk.R", b"plain.B", b"plain.G", b"plain.R"]
    assert [head.index(name + b"\0\2\0\0\0") for name in listed] == sorted(head.index(name + b"\0\2\0\0\0") for name in listed)


def test_panoramas_for_one_eye_and_two(run: Path, tmp_path: Path) -> None:
    common = ["render", str(run), "--path", "orbit", "--frames", "1", "--across", "32", "--output"]
    assert cli.main([*common, str(tmp_path / "mono"), "--lens", "panorama"]) == 0
    assert cli.main([*common, str(tmp_path / "stereo"), "--lens", "stereo"]) == 0
    assert cli.main([*common, str(tmp_path / "same"), "--lens", "stereo", "--eyes", "1e-9"]) == 0
    (mono,), (stereo,), (same,) = (pictures(tmp_path / name).values() for name in ("mono", "stereo", "same"))
    assert mono.shape == (16, 32, 3) and stereo.shape == same.shape == (32, 32, 3)
    assert np.abs(same[:16].astype(int) - mono).max() <= 1 and np.abs(same[16:].astype(int) - mono).max() <= 1
    assert not np.array_equal(stereo[:16], stereo[16:])
