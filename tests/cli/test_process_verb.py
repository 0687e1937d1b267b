"""`fprf process` over a fake pycolmap (tests/reconstruction/fake) that records its calls; test_colmap has the
real one.
"""

import json
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fprf.cli import main as cli
from fprf.cli.parsing import load_method, parse
from fprf.cli.train import DEFAULT_METHOD
from fprf.datamanagers.images import load_mask
from fprf.datamanagers.parsers.config import parse_scene
from fprf.io.folder_lock import LOCK, lock_folder
from fprf.io.video import write_video
from fprf.training.driver import default_output

FAKE = Path(__file__).parents[1] / "reconstruction" / "fake"


@pytest.fixture
def photos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(str(FAKE))
    monkeypatch.setenv(
        "PYTHONPATH", os.pathsep.join([str(FAKE), *filter(None, [os.environ.get("PYTHONPATH")])])
    )
    (tmp_path / "in").mkdir()
    for k in range(5):
        add(tmp_path / "in", k)
    return tmp_path / "in"


def add(folder: Path, k: int) -> None:
    pixels = np.random.default_rng(k).integers(0, 256, (16, 24, 3), dtype=np.uint8)
    assert cv2.imwrite(str(folder / f"{k}.png"), pixels)


def process(photos: Path, *words: str, plan: dict[str, Any] | None = None) -> int:
    work = photos.parent / "scene" / "sfm"
    work.mkdir(parents=True, exist_ok=True)
    (work / "fake.json").write_text(json.dumps(plan or {}))
    return cli.main(["process", str(photos), "--output", str(work.parent), *words])


def calls(photos: Path) -> list[str]:
    file = photos.parent / "scene" / "sfm" / "calls.txt"
    told = file.read_text().splitlines() if file.is_file() else []
    file.write_text("")
    return told


def report(photos: Path) -> dict[str, Any]:
    return json.loads((photos.parent / "scene" / "process.json").read_text())


def test_images_become_a_scene(photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert process(photos) == 0
    scene = parse_scene(photos.parent / "scene", 1, None)
    assert [path.name for path in scene.paths] == [f"{k}.png" for k in range(5)]
    assert scene.cameras.pose[:, 0, 3].tolist() == [1, 2, 3, 4, 5]
    assert calls(photos) == [
        "features SIMPLE_RADIAL 1600 0.png 1.png 2.png 3.png 4.png",
        "matches 10",
        "mapping",
    ]
    out = capsys.readouterr().out
    assert "5 of 5 images have a pose; 50 points, 0.50 pixels off; exhaustive matching" in out
    train, stylize = (shlex.split(line)[1:] for line in out.splitlines()[-2:])
    assert train == ["train", "--data", str(photos.parent / "scene"), "--minutes", "3"]
    config = parse(load_method(DEFAULT_METHOD)[0], train[1:], prog="fprf train", description="")
    assert stylize[:2] == ["stylize", str(default_output(config, DEFAULT_METHOD))]
    assert stylize[2:] == ["--references", "PHOTO.jpg"]
    assert report(photos)["images"] == {"given": 5, "used": 5, "posed": 5}


def test_what_is_done_is_not_done_again(photos: Path) -> None:
    assert process(photos) == 0
    before = {p: p.stat().st_mtime_ns for p in (photos.parent / "scene" / "sparse" / "0").iterdir()}
    calls(photos)
    assert process(photos) == 0
    assert calls(photos) == [] and before == {p: p.stat().st_mtime_ns for p in before}
    add(photos, 5)
    assert process(photos) == 0
    assert calls(photos) == ["features SIMPLE_RADIAL 1600 5.png", "matches 15", "mapping"], (
        "the others keep theirs"
    )
    assert process(photos, "--matching", "sequential", "--overlap", "1") == 0
    assert calls(photos) == ["matches 9", "mapping"]
    assert process(photos, "--matching", "sequential", "--overlap", "1", "--lens", "opencv") == 0
    assert calls(photos)[0].startswith("features OPENCV 1600 0.png 1.png")


def test_copies_and_derived_pictures_are_left_out_and_named(
    photos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for k in range(5):
        source = photos / f"{k}.png"
        shutil.copy(source, photos / f"{k} (1).png")
        for inner in ("@eaDir", "images_2", "depth"):
            (photos / inner).mkdir(exist_ok=True)
            pixels = cv2.resize(cv2.imread(str(source)), (12, 8), interpolation=cv2.INTER_AREA)
            assert cv2.imwrite(str(photos / inner / f"{k}.png"), pixels)
    assert cv2.imwrite(str(photos / "3 copy.bmp"), cv2.imread(str(photos / "3.png")))
    assert process(photos) == 0
    scene = parse_scene(photos.parent / "scene", 1, None)
    assert [path.name for path in scene.paths] == [f"{k}.png" for k in range(5)]
    assert sorted(path.name for path in (photos.parent / "scene/images").iterdir()) == [
        f"{k}.png" for k in range(5)
    ]
    said = [line for line in capsys.readouterr().err.splitlines() if "left out" in line]
    assert len(said) == 4
    for line, counted, example in zip(
        said, (5, 5, 5, 6), ("@eaDir/0.png", "depth/0.png", "images_2/0.png", "0 (1).png"), strict=True
    ):
        assert f"left out: {counted} " in line and example in line
    assert process(photos) == 0 and report(photos)["images"] == {"given": 5, "used": 5, "posed": 5}


def test_nothing_but_thumbnails_is_told(photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photos.rename(photos.parent / "thumbs")
    photos.mkdir()
    (photos.parent / "thumbs").rename(photos / "thumbs")
    assert process(photos) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert "left out: 5 thumbnails, like thumbs/0.png" in error


@pytest.mark.parametrize("step", ["features", "matches", "mapping"])
def test_a_step_that_breaks_off_goes_on_where_it_stood(
    photos: Path, step: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert process(photos, plan={"fail": step}) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("error: ") and "log.txt" in error
    assert f"COLMAP's {step} ended with 9: it broke while {step}" in error
    calls(photos)
    assert process(photos) == 0
    rest = ["features SIMPLE_RADIAL 1600 2.png 3.png 4.png", "matches 10", "mapping"]
    assert calls(photos) == rest[["features", "matches", "mapping"].index(step) :]
    assert report(photos)["images"]["posed"] == 5


def test_dropped_images_are_told_with_their_reasons(photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for k in range(5, 11):
        add(photos, k)
    (photos / "empty.jpg").write_bytes(b"")
    plan = {"bare": ["1.png"], "lonely": ["2.png"], "apart": ["3.png", "5.png"], "unposed": ["6.png"]}
    assert process(photos, plan=plan) == 0
    told = report(photos)
    lost = {"empty.jpg": "choosing", "1.png": "features", "2.png": "matching"}
    lost |= dict.fromkeys(("3.png", "5.png", "6.png"), "mapping")
    assert {row["image"]: row["step"] for row in told["dropped"]} == lost
    assert told["images"] == {"given": 12, "used": 11, "posed": 6} and told["parts"] == [6, 2]
    out = capsys.readouterr().out
    assert "6 of 12 images have a pose" in out and "no other image" in out and "process.json" in out


def test_similar_matching_reads_the_features(photos: Path) -> None:
    for k in range(5, 30):
        add(photos, k)
    assert process(photos, "--matching", "similar", "--neighbours", "3") == 0
    matched = next(int(line.split()[1]) for line in calls(photos) if line.startswith("matches"))
    assert 30 * 3 / 2 <= matched < 30 * 29 / 2


def test_images_without_a_pose_are_matched_with_all_others(photos: Path) -> None:
    """33 images are too many to match all pairs at first; 1.png fits only 20.png."""
    for k in range(5, 33):
        add(photos, k)
    plan = {"needs": {"1.png": "20.png"}}
    assert process(photos, "--matching", "similar", "--neighbours", "1", plan=plan) == 0
    assert report(photos)["images"]["posed"] == 32
    calls(photos)
    assert process(photos, "--neighbours", "1", plan=plan) == 0
    mapping, rest, again = calls(photos)
    assert mapping == again == "mapping"
    assert 20 <= int(rest.removeprefix("matches ")) <= 31, "those of 1.png that were not tried"
    assert report(photos)["images"]["posed"] == 33 and report(photos)["dropped"] == []
    assert process(photos, "--neighbours", "1", plan=plan) == 0 and calls(photos) == []


def test_all_pairs_are_matched_where_no_two_of_the_first_fit(photos: Path) -> None:
    for k in range(5, 33):
        add(photos, k)
    # Nothing fits before images are matched with one half of the row away.
    needs = {f"{k}.png": f"{(k + 16) % 33}.png" for k in range(33)}
    assert process(photos, "--neighbours", "1", plan={"needs": needs}) == 0
    assert report(photos)["images"]["posed"] == 33


def test_photographs_from_nearly_one_place_find_their_poses_too(photos: Path) -> None:
    """No first pair has the angle that COLMAP asks for (4 degrees at its least): smaller ones are tried."""
    assert process(photos, plan={"angle": 1.0}) == 0
    assert calls(photos)[-2:] == ["mapping", "mapping"] and report(photos)["images"]["posed"] == 5


def test_nothing_fits_together_and_what_the_decoder_lost_is_told(
    photos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (photos / "empty [1].jpg").write_bytes(b"")
    assert process(photos, plan={"nothing": True}) == 2
    told = capsys.readouterr().err
    assert "no two of the other images fit together" in told
    assert "could not be decoded: empty [1].jpg (the file is empty)" in told
    assert report(photos)["images"]["posed"] == 0, "the report is written all the same"


def test_a_missing_or_an_old_pycolmap_is_refused(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "pycolmap.py").write_text("def set_random_seed(seed): pass\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert process(photos) == 2
    assert "pycolmap 4 or newer is needed" in capsys.readouterr().err
    monkeypatch.setattr("fprf.reconstruction.process.find_spec", lambda name: None)
    assert process(photos) == 2
    assert "pip install 'pycolmap" in capsys.readouterr().err


def test_the_worker_never_meets_opencv(photos: Path) -> None:
    code = "import sys, fprf.reconstruction.worker; print({'cv2', 'numpy', 'torch', 'PIL', 'pycolmap'} & {*sys.modules})"
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True
    )
    assert ended.stdout.strip() == "set()"
    sources = [
        path
        for path in Path(cli.__file__).parents[1].rglob("*.py")
        if "import pycolmap" in path.read_text("utf-8")
    ]
    assert [path.name for path in sources] == ["worker.py"]


def test_a_second_process_in_one_folder_is_refused_and_leaves_it_as_it_was(
    photos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = photos.parent / "scene"
    with lock_folder(scene, "is finding poses here"):
        before = sorted(path.name for path in scene.rglob("*"))
        assert cli.main(["process", str(photos), "--output", str(scene)]) == 2
        error = capsys.readouterr().err.splitlines()
        assert len(error) == 1 and f"process {os.getpid()}" in error[0]
        assert sorted(path.name for path in scene.rglob("*")) == before
    assert process(photos) == 0 and report(photos)["images"]["posed"] == 5
    assert not (scene / LOCK).exists()


def test_masks_reach_colmap_and_the_scene(photos: Path) -> None:
    (photos.parent / "masks").mkdir()
    for k in range(5):
        pixels = np.zeros((16, 24), np.uint8)
        pixels[:, : 10 + k] = 255
        assert cv2.imwrite(str(photos.parent / "masks" / f"{k}.png"), pixels)
    assert process(photos, "--masks", str(photos.parent / "masks")) == 0
    scene = parse_scene(photos.parent / "scene", 1, None)
    assert [load_mask(path).sum() for path in scene.masks if path] == [16 * (10 + k) for k in range(5)]
    job = json.loads((photos.parent / "scene" / "sfm" / "features.job.json").read_text())
    assert Path(job["masks"]) == photos.parent / "scene" / "masks"
    calls(photos)
    assert process(photos) == 0
    assert calls(photos)[0].startswith("features"), "without masks features are others"
    assert not any(parse_scene(photos.parent / "scene", 1, None).masks)


def test_what_was_read_of_a_video_is_said_and_written_down(
    photos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clip = photos.parent / "clip.mp4"
    write_video(clip, [cv2.imread(str(photos / f"{k % 5}.png")) for k in range(9)], 9, h264=False)
    assert process(clip, "--blurred", "0") == 0
    told = report(clip)["notes"]
    assert told[0] == "clip.mp4: all of its 9 frames were read"
    assert told[0] in capsys.readouterr().err
    assert process(clip, "--blurred", "0") == 0 and report(clip)["notes"] == told
