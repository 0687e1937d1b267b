"""`python -m benchmarks paper` on the tiny town, and what each row of a table that trains changes."""

import json
import shutil
from pathlib import Path
from typing import Any

import torch
from tiny_world import World

from benchmarks.__main__ import main
from benchmarks.paper import SceneDecoderConfig
from fprf.plugins.encoders.config import BundledContentConfig

SMALL = ["--steps", "2", "--views", "1", "--palettes", "night", "--device", "cpu"]


def table(world: World, name: str, output: Path, *more: str) -> dict[str, Any]:
    scene = ["--data", str(world.town), "--method", str(world.run / "config.json")]
    assert main(["paper", "--table", name, *scene, *SMALL, "--output", str(output), *more]) == 0
    document: dict[str, Any] = json.loads(output.read_text())
    assert document["table"] == name
    return document


def test_statistics_of_views_differ_from_the_scenes(world: World, tmp_path: Path) -> None:
    rows = table(world, "statistics", tmp_path / "a.json", "--run", str(world.run))["rows"]
    for name in ("adain", "local-adain", "region-tone"):
        shared, alone = rows[f"{name}, of the scene"], rows[f"{name}, of each view"]
        assert shared["styled_psnr"] != alone["styled_psnr"]
        assert shared["consistency"] is not None and alone["consistency"] is not None


def test_a_decoder_of_the_scene_starts_grey_and_learns() -> None:
    encoder = BundledContentConfig().build()
    decoder = SceneDecoderConfig().build(encoder=encoder.identity, channels=encoder.channels, seed=3)
    again = SceneDecoderConfig().build(encoder=encoder.identity, channels=encoder.channels, seed=3)
    content = torch.randn(50, encoder.channels)
    assert torch.equal(decoder(content), torch.full((50, 3), 0.5)) and decoder.frozen_colour(content) is None
    assert all(torch.equal(a, b) for a, b in zip(decoder.parameters(), again.parameters(), strict=True))
    target = content[:, :3].sigmoid()
    optimizer = torch.optim.Adam(decoder.parameters(), lr=1e-2)
    for _ in range(150):
        optimizer.zero_grad()
        loss = (decoder(content) - target).square().mean()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    assert float(loss.detach()) < 0.005
    assert torch.equal(decoder.restyled(content, content, 1.0), decoder(content))


def test_a_finished_run_is_not_trained_again(world: World, tmp_path: Path) -> None:
    document = table(world, "multi-reference", tmp_path / "a.json", "--run", str(world.run))
    assert document["settings"]["steps"] == 15
    rows = document["rows"]
    assert list(rows)[:2] == ["adain, one", "local-adain, one"] and len(rows) == 6
    assert "match_inside" not in rows["adain, one"] and rows["region-tone, three"]["match_inside"] is not None


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


DECODER, CONTENT, GUIDE = "content.decoder.type", "loss.content", "datamanager.guided.radius"
