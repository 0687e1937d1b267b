"""`python -m benchmarks peer` on frames that another system might have written."""

import json
from pathlib import Path
from typing import Any

import pytest
from tiny_world import World

from benchmarks.__main__ import main
from benchmarks.town.write import write_town


def peer(world: World, frames: Path, output: Path, *more: str) -> dict[str, Any]:
    cameras = str(world.town / "transforms.json")
    args = ["peer", str(frames), "--cameras", cameras, "--device", "cpu", "--output", str(output), *more]
    assert main(args) == 0
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
    assert document["truth"] == {"psnr": 99.0, "cc_psnr": 99.0, "ssim": 1.0, "lpips": 0.0, "delta_e": 0.0}
    assert document["published"]["short"]["pairs"] > 0 and document["published"]["long"]["rmse"] > 0
    assert document["steadiness"]["sharpness"] > 0.5
    assert document["style"]["style_distance"] > 0 and 0 < document["style"]["structure"] < 1
    assert page.read_text() in capsys.readouterr().out
