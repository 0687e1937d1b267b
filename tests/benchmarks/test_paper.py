"""`python -m benchmarks paper` on the tiny town, and what each row of a table that trains changes."""

import json
import shutil
from pathlib import Path

from tiny_world import World

from benchmarks.__main__ import main

SMALL = ["--steps", "2", "--views", "1", "--palettes", "night", "--device", "cpu"]


def test_other_scenes_are_restyled_by_photographs(world: World, tmp_path: Path) -> None:
    """A saved config is the method; the scene is the town's pictures without what is known about them."""
    scene = shutil.copytree(world.town, tmp_path / "scene", ignore=shutil.ignore_patterns("truth*", "town*"))
    command = f"paper --table guided-filter --data {scene} --method {world.run / 'config.json'} --device cpu --steps 2"
    references = ["--views", "2", "--references", *map(str, world.references)]
    assert main([*command.split(), *references, "--output", str(tmp_path / "a.json")]) == 0
    document = json.loads((tmp_path / "a.json").read_text())
    assert document["settings"]["method"] == "fprf-lite"
    for row in document["rows"].values():
        assert "styled_psnr" not in row
        for name in ("", "paper_"):
            assert 0 < row[f"{name}style_distance"] != 1 and -1 <= row[f"{name}structure"] < 1
