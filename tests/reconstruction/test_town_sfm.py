"""A phone-like folder, the town's views as JPEG without poses, through COLMAP itself and back to the truth."""

import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

import cv2
import pytest
from alignment import misses

from fprf.cli import main as cli
from fprf.datamanagers.parsers.config import parse_scene
from fprf.io.video import write_video
from fprf.town.write import write_town


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
