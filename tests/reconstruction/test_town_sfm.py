"""A phone-like folder, the town's views as JPEG without poses, through COLMAP itself and back to the truth."""

import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

import cv2
import pytest
from alignment import misses

from benchmarks.town.write import write_town
from fprf.cli import main as cli
from fprf.datamanagers.parsers.config import parse_scene
from fprf.io.video import write_video

pytestmark = pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is not installed (extra sfm)")


def process(town: Path, source: Path, *options: str) -> tuple[Path, dict[int, int]]:
    """The town's views through COLMAP, from photographs of a phone where `source` is a folder: the scene, and its view of
    each frame of the source.
    """
    views = [cv2.imread(str(path)) for path in sorted((town / "images").glob("*.png"))]
    if source.suffix:  # each view twice, the second time as a shaking hand takes it
        pairs = [cv2.cvtColor(frame, cv2.COLOR_BGR2RGB) for view in views for frame in (view, cv2.blur(view, (15, 1)))]
        write_video(source, pairs, 12)
    else:
        source.mkdir()
        for k, view in enumerate(views):
            assert cv2.imwrite(str(source / f"{k:04d}.jpg"), view, [cv2.IMWRITE_JPEG_QUALITY, 92])
    scene = town.with_name("scene")
    assert cli.main(["process", str(source), "--output", str(scene), *options]) == 0
    assert "pycolmap" not in sys.modules
    found = parse_scene(scene, 1, None)
    return scene, {int(path.stem.removeprefix("frame_")): view for view, path in enumerate(found.paths)}


def test_a_few_small_photographs_find_their_poses(tmp_path: Path) -> None:
    """COLMAP itself, in processes of its own; the long test below asks for more."""
    write_town(tmp_path / "town", seed=0, palette="day", views=16, width=320, height=240)
    scene, views = process(tmp_path / "town", tmp_path / "phone")
    found, truth = parse_scene(scene, 1, None), parse_scene(tmp_path / "town", 1, None)
    miss = misses(found.cameras.pose[list(views.values())].numpy(), truth.cameras.pose[list(views)].numpy())
    assert len(views) >= 12 and miss.position < 0.03 and miss.degrees < 4


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize(("source", "each"), [("phone", 1), ("clip.mp4", 2)])
def test_poses_of_the_town_are_within_a_percent_of_the_truth(tmp_path: Path, source: str, each: int) -> None:
    write_town(tmp_path / "town", seed=0, palette="day", views=40, width=640, height=480)
    scene, views = process(tmp_path / "town", tmp_path / source, "--frames", "40")
    assert len(views) >= 38 and not any(number % each for number in views), "the sharp ones, and nearly all of them"
    found, truth = parse_scene(scene, 1, None), parse_scene(tmp_path / "town", 1, None)
    true = truth.cameras.pose[[number // each for number in views]].numpy()
    miss = misses(found.cameras.pose[list(views.values())].numpy(), true)
    print(source, len(views), miss)
    assert miss.position < 0.01 and miss.degrees < 0.5
    assert float(found.cameras.focal[0, 0] / truth.cameras.focal[0, 0]) == pytest.approx(1, abs=0.01)
    shutil.rmtree(scene / "sfm")
    assert len(parse_scene(scene, 1, None).paths) == len(views), "what is only needed to go on may go"
