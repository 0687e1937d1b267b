"""`fprf bench peer` on frames that another system might have written."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from tiny_world import World

from fprf.cli import main as cli
from fprf.town.write import write_town


def peer(world: World, frames: Path, output: Path, *more: str) -> dict[str, Any]:
    cameras = str(world.town / "transforms.json")
    args = ["bench", "peer", str(frames), "--cameras", cameras, "--device", "cpu", "--output", str(output), *more]
    assert cli.main(args) == 0
    document: dict[str, Any] = json.loads(output.read_text())
    return document


@pytest.fixture(scope="module")
def night(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("night") / "town"
    write_town(folder, seed=0, palette="night", views=10, width=32, height=24)
    return folder


def test_all_that_can_be_known(world: World, night: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The town at night as a peer's restyling of the town by day: exact, and nothing is missing."""
    images, page = str(world.town / "images"), tmp_path / "page.md"
    document = peer(
        world, night / "images", tmp_path / "a.json", "--plain", images, "--depth", str(world.town / "depth"),
        "--truth", str(night / "images"), "--references", str(world.references[0]), "--page", str(page),
    )  # fmt: skip
    assert document["frames"] == 10 and document["size"] == [32, 24] and document["missing"] == {}
    assert document["truth"] == {"psnr": 99.0, "ssim": 1.0, "delta_e": 0.0}
    assert document["published"]["short"]["pairs"] > 0 and document["published"]["long"]["rmse"] > 0
    assert document["steadiness"]["sharpness"] > 0.5
    assert document["style"]["style_distance"] > 0 and 0 < document["style"]["structure"] < 1
    assert page.read_text() in capsys.readouterr().out


def test_unchanged_frames_are_as_steady_as_they_were(world: World, tmp_path: Path) -> None:
    images = world.town / "images"
    document = peer(
        world, images, tmp_path / "a.json", "--plain", str(images), "--depth", str(world.town / "depth"),
        "--references", str(world.references[0]),
    )  # fmt: skip
    assert document["steadiness"]["score"] == 0 and document["steadiness"]["sharpness"] == 1
    assert document["style"]["style_distance"] == pytest.approx(1) and document["style"]["structure"] == pytest.approx(1)
    assert document["missing"] == {"truth": "--truth"}


def test_what_is_missing_is_named(world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = peer(world, world.town / "images", tmp_path / "a.json")
    assert set(document["missing"]) == {"steadiness", "published", "truth", "style"}
    assert document["steadiness"] is document["published"] is document["truth"] is document["style"] is None
    assert "steadiness: not known without --depth or --run" in capsys.readouterr().out


def test_a_run_gives_what_the_peer_did_not_write(world: World, tmp_path: Path) -> None:
    document = peer(world, world.town / "images", tmp_path / "a.json", "--run", str(world.run))
    assert document["published"]["short"]["pairs"] > 0 and "steadiness" not in document["missing"]


def test_mistakes_are_one_line(world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cameras = ["--cameras", str(world.town / "transforms.json"), "--device", "cpu"]
    assert cli.main(["bench", "peer", str(tmp_path), *cameras]) == 2
    assert "no pictures" in capsys.readouterr().err
    other = tmp_path / "other"
    other.mkdir()
    for path in (world.town / "images").iterdir():
        shutil.copy(world.references[0], other / path.name)
    assert cli.main(["bench", "peer", str(world.town / "images"), *cameras, "--plain", str(other)]) == 2
    assert "the stylised frame 32x24; both must agree" in capsys.readouterr().err
