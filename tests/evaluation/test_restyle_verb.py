"""`fprf bench restyle` on the tiny town: whole, and twice the same."""

import json
from pathlib import Path
from typing import Any

import cv2
import pytest
from tiny_world import World

from fprf.cli import main as cli
from fprf.evaluation.restyle import BOUND, GOALS, MATCHED

SMALL = ["--palettes", "night", "--views", "1", "--longest", "24", "--clusters", "4", "--device", "cpu"]
METHODS = {
    "no change", "reinhard", "histogram", "2d", "adain", "local-adain", "region-adain", "region-ot", "nearest-code",
    "region-tone", MATCHED, BOUND,
}  # fmt: skip


def bench(world: World, output: Path, *more: str) -> dict[str, Any]:
    assert cli.main(["bench", "restyle", str(world.run), *SMALL, "--output", str(output), *more]) == 0
    document: dict[str, Any] = json.loads(output.read_text())
    return document


def timeless(value: Any) -> Any:
    """Without what a clock measured, and without the commit, which somebody may make between two runs."""
    if isinstance(value, dict):
        return {key: timeless(inner) for key, inner in value.items() if not key.endswith("seconds") and key != "provenance"}
    return value


def test_every_method_is_in_the_table_and_numbers_repeat(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page, sheet = tmp_path / "docs/page.md", tmp_path / "docs/sheets/all.png"
    document = bench(world, tmp_path / "a.json", "--page", str(page), "--sheet", str(sheet))
    assert set(document["means"]) == {"one", "three"}
    found = document["palettes"]["night"]["three"]
    assert set(found["rows"]) == METHODS and set(found["delta_e_by_class"]) == METHODS
    for name, row in found["rows"].items():
        assert 0 < row["psnr"] < 99 and -1 <= row["ssim"] <= 1 and row["delta_e"] > 0
        assert (row["match"] is not None) == (name in METHODS - {"no change", "reinhard", "histogram", "adain", MATCHED, BOUND})
        assert (row["consistency"] is None) == (name in (MATCHED, BOUND))
    assert found["rows"]["no change"]["consistency"] == 0
    assert document["recommended"] == "region-tone" and document["lpips"] is None and document["lpips_missing"]
    assert document["verdict"]["goals"] == dict(GOALS) and set(document["verdict"]["met"]) == set(GOALS)
    # A map that knows the truth is nearer to it than doing nothing, whatever the scene.
    assert found["rows"][BOUND]["psnr"] > found["rows"]["no change"]["psnr"]
    assert document["provenance"]["torch"] and document["settings"]["town_seed"] == 0
    text = page.read_text()
    assert "](sheets/all.png)" in text and all(name in text for name in METHODS)
    assert cv2.imread(str(sheet)) is not None
    assert "region-tone" in capsys.readouterr().out
    again = bench(world, tmp_path / "b.json")
    assert timeless(again) == timeless(document)


def test_mistakes_are_one_line(world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench", "restyle", str(world.run), *SMALL, "--seeds", "0", "1", "2"]) == 2
    assert "is the town of the run itself" in capsys.readouterr().err
    assert cli.main(["bench", "restyle", str(world.run), *SMALL, "--palettes", "noon"]) == 2
    assert "noon" in capsys.readouterr().err
    assert cli.main(["bench", "restyle", str(tmp_path / "nothing"), *SMALL]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert cli.main(["bench", "restyle", "--frames", "7"]) == 2
    assert "--frames" in capsys.readouterr().err
