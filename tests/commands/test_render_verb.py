import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_world import World

from fprf import cli
from fprf.commands.progress import Display
from fprf.commands.render import RenderVerbConfig, camera_path, frames_of


@pytest.fixture
def run(world: World, tmp_path: Path) -> Path:
    shutil.copytree(world.run, tmp_path / "run")
    return tmp_path / "run"


def pictures(folder: Path) -> dict[str, np.ndarray]:
    return {p.name: cv2.imread(str(p)) for p in sorted(folder.glob("*.png"))}


def test_captured_views_keep_their_names_and_are_those_of_eval(run: Path, tmp_path: Path) -> None:
    args = ["render", str(run), "--path", "dataset", "--split", "test", "--output", str(tmp_path / "frames")]
    assert cli.main(args) == 0
    assert cli.main(["eval", str(run)]) == 0
    frames, plain = pictures(tmp_path / "frames"), pictures(run / "renders" / "test")
    assert frames.keys() == plain.keys() == {"0000.png", "0008.png"}
    assert all(np.array_equal(frames[name], plain[name]) for name in frames)


@pytest.mark.parametrize("path", ["spiral", "orbit", "interpolate"])
def test_paths_have_about_the_frames_asked_for(world: World, path: str) -> None:
    trained = world.load()
    cameras, names = camera_path(trained, RenderVerbConfig(path=path, frames=19))
    assert abs(len(cameras) - 19) <= 9 and len(names) == len(cameras)
    assert names == sorted(set(names))
    with Display(quiet=True) as display:
        first = next(iter(frames_of(trained, cameras, lambda _: None, display)))
    assert first.shape == (24, 32, 3) and first.dtype == np.uint8


def test_frames_in_a_folder_and_depth(run: Path, tmp_path: Path) -> None:
    common = ["render", str(run), "--path", "spiral", "--frames", "3"]
    assert cli.main([*common, "--output", str(tmp_path / "plain")]) == 0
    assert cli.main([*common, "--depth", "--output", str(tmp_path / "depth")]) == 0
    plain, depth = pictures(tmp_path / "plain"), pictures(tmp_path / "depth")
    assert list(plain) == list(depth) == ["00000.png", "00001.png", "00002.png"]
    assert not any(np.array_equal(plain[name], depth[name]) for name in plain)


def test_a_film(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film = tmp_path / "x.mp4"
    assert cli.main(["render", str(run), "--path", "orbit", "--frames", "4", "--output", str(film)]) == 0
    assert film.stat().st_size > 100 and capsys.readouterr().out.startswith(f"4 frames in {film} (")


def test_restyled_frames_differ_and_strength_0_does_not(run: Path, world: World, tmp_path: Path) -> None:
    common = ["render", str(run), "--path", "dataset", "--split", "test", "--output"]
    style = ["--references", str(world.references[0])]
    assert cli.main([*common, str(tmp_path / "plain")]) == 0
    assert cli.main([*common, str(tmp_path / "full"), *style]) == 0
    assert cli.main([*common, str(tmp_path / "none"), *style, "--strength", "0"]) == 0
    plain, full, none = (pictures(tmp_path / name) for name in ("plain", "full", "none"))
    assert all(np.array_equal(plain[name], none[name]) and not np.array_equal(plain[name], full[name]) for name in plain)


def test_a_camera_path_file(run: Path, tmp_path: Path) -> None:
    pose = [1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 2.0, 0, 0, 0, 1.0]
    path = tmp_path / "path.json"
    camera = {"camera_to_world": pose, "fov": 60.0, "aspect": 1.5}
    path.write_text(
        json.dumps({"camera_type": "perspective", "render_height": 10, "render_width": 15, "fps": 24, "seconds": 1,
                    "camera_path": [camera, camera]})
    )  # fmt: skip
    assert cli.main(["render", str(run), "--path", str(path), "--output", str(tmp_path / "frames")]) == 0
    assert [image.shape for image in pictures(tmp_path / "frames").values()] == [(10, 15, 3)] * 2


@pytest.mark.parametrize(
    ("args", "told"),
    [
        (["--path", "spirale"], "--path spirale: neither a file nor one of spiral, orbit, interpolate, dataset"),
        (["--frames", "0"], "--frames: 0 must be at least 1"),
        (["--fps", "0"], "--fps: 0.0 must be at least 1"),
        (["--references", "absent.png", "--path", "orbit"], "absent.png"),
    ],
)
def test_mistakes(run: Path, args: list[str], told: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert cli.main(["render", str(run), *args, "--output", str(tmp_path / "out")]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("error: ") and err.count("\n") == 1 and told in err
    assert not (tmp_path / "out").exists()
