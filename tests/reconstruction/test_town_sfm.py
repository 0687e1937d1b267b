"""A phone-like folder, the town's views as JPEG without poses, through COLMAP itself and back to the truth."""

import json
import shlex
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
from alignment import align, misses

from fprf.cli import main as cli
from fprf.datamanagers.parsers.config import parse_scene
from fprf.io.video import write_video
from fprf.town.write import write_town
from fprf.training.run import Run


def test_the_measure_is_blind_to_similarities_and_to_nothing_else() -> None:
    drawn = np.random.default_rng(0)
    turns = np.stack([cv2.Rodrigues(v)[0] for v in drawn.normal(size=(9, 3))])
    truth = np.concatenate([turns, drawn.normal(size=(9, 3, 1))], 2)
    turn, scale, offset = cv2.Rodrigues(np.array([0.3, -1.0, 2.0]))[0], 3.5, np.array([1.0, 2.0, -3.0])
    moved = np.concatenate([turn @ turns, (scale * truth[:, :, 3] @ turn.T + offset)[:, :, None]], 2)
    found = align(moved[:, :, 3], truth[:, :, 3])
    assert found[0] == pytest.approx(1 / scale) and np.allclose(found[1], turn.T)
    assert misses(moved, truth).position < 1e-12 and misses(moved, truth).degrees < 1e-4
    extent = np.linalg.norm(np.ptp(truth[:, :, 3], axis=0))
    shaken = moved.copy()
    shaken[4, 0, 3] += 0.1 * scale * extent
    assert 0.05 < misses(shaken, truth).position <= 0.1
    shaken[2, :, :3] = shaken[2, :, :3] @ cv2.Rodrigues(np.array([0.0, 0.1, 0.0]))[0]
    assert misses(shaken, truth).degrees > 4


def photographed(town: Path, folder: Path) -> None:
    """The town's views as a phone would leave them."""
    folder.mkdir()
    for k, path in enumerate(sorted((town / "images").glob("*.png"))):
        cv2.imwrite(str(folder / f"{k:04d}.jpg"), cv2.imread(str(path)), [cv2.IMWRITE_JPEG_QUALITY, 92])


@pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is not installed (extra sfm)")
def test_a_few_small_photographs_find_their_poses(tmp_path: Path) -> None:
    """COLMAP itself, in processes of its own; the long test below asks for more."""
    town, scene = tmp_path / "town", tmp_path / "scene"
    write_town(town, seed=0, palette="day", views=16, width=320, height=240)
    photographed(town, tmp_path / "phone")
    assert cli.main(["process", str(tmp_path / "phone"), "--output", str(scene)]) == 0
    assert "pycolmap" not in sys.modules
    found, truth = parse_scene(scene, 1, None), parse_scene(town, 1, None)
    views = [int(path.stem.removeprefix("frame_")) for path in found.paths]
    miss = misses(found.cameras.pose.numpy(), truth.cameras.pose[views].numpy())
    assert len(views) >= 12 and miss.position < 0.03 and miss.degrees < 4


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is not installed (extra sfm)")
@pytest.mark.parametrize("kind", ["photographs", "video"])
def test_poses_of_the_town_are_within_a_percent_of_the_truth(tmp_path: Path, kind: str) -> None:
    town = tmp_path / "town"
    write_town(town, seed=0, palette="day", views=40, width=640, height=480)
    if kind == "photographs":
        source = tmp_path / "phone"
        photographed(town, source)
        numbers = range(40)
    else:  # each view twice, the second time as a shaking hand takes it
        source = tmp_path / "clip.mp4"
        views = [cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB) for path in sorted((town / "images").glob("*.png"))]
        pairs = [frame for view in views for frame in (view, cv2.blur(view, (15, 1)))]
        write_video(source, pairs, 12)
        numbers = range(0, 80, 2)
    assert cli.main(["process", str(source), "--output", str(tmp_path / "scene"), "--frames", "40"]) == 0
    found, truth = parse_scene(tmp_path / "scene", 1, None), parse_scene(town, 1, None)
    stems = {int(path.stem.removeprefix("frame_")): view for view, path in enumerate(found.paths)}
    assert len(stems) >= 38 and stems.keys() <= set(numbers), "the sharp ones, and nearly all of them"
    each = 1 if kind == "photographs" else 2
    true = truth.cameras.pose[[number // each for number in stems]].numpy()
    miss = misses(found.cameras.pose[list(stems.values())].numpy(), true)
    print(kind, len(stems), miss)
    assert miss.position < 0.01 and miss.degrees < 0.5
    focal = float(found.cameras.focal[0, 0] / truth.cameras.focal[0, 0])
    assert focal == pytest.approx(1, abs=0.01)
    shutil.rmtree(tmp_path / "scene" / "sfm")
    assert len(parse_scene(tmp_path / "scene", 1, None).paths) == len(stems), "what is only needed to go on may go"


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is not installed (extra sfm)")
def test_the_printed_commands_lead_from_photographs_to_a_style(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As `process` prints them, with fewer steps and a photograph in place of PHOTO.jpg."""
    monkeypatch.chdir(tmp_path)
    write_town(tmp_path / "town", seed=0, palette="day", views=16, width=960, height=720)
    photographed(tmp_path / "town", tmp_path / "phone")
    shutil.copy(next((tmp_path / "phone").iterdir()), "PHOTO.jpg")
    assert cli.main(["process", "phone", "--output", "my_scene"]) == 0
    train, stylize = (shlex.split(line)[1:] for line in capsys.readouterr().out.splitlines()[-2:])
    train[train.index("--minutes") + 1] = "25"
    assert cli.main([*train, "--steps", "800"]) == 0 and cli.main(stylize) == 0
    run = Run(Path(stylize[1]))
    assert cli.main(["eval", stylize[1]]) == 0
    assert run.load_known().cameras.size[0].tolist() == [480, 360]
    assert json.loads((run.root / "metrics.json").read_text())["psnr"] > 17
    assert list(run.root.glob("styles/PHOTO/*.png"))
