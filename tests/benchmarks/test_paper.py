"""`python -m benchmarks paper` on the tiny town, and what each row of a table that trains changes."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_world import World

from benchmarks.__main__ import main
from benchmarks.paper import TRAINED, SceneDecoderConfig
from fprf.config import TrainConfig
from fprf.methods import fprf_lite
from fprf.plugins.codec import to_json
from fprf.plugins.encoders.config import BundledContentConfig

SMALL = ["--steps", "2", "--views", "1", "--palettes", "night", "--device", "cpu"]


def table(world: World, name: str, output: Path, *more: str) -> dict[str, Any]:
    scene = ["--data", str(world.town), "--method", str(world.run / "config.json")]
    assert main(["paper", "--table", name, *scene, *SMALL, "--output", str(output), *more]) == 0
    document: dict[str, Any] = json.loads(output.read_text())
    assert document["table"] == name
    return document


def test_rows_are_trainings_with_one_thing_changed(world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "page.md"
    rows = table(world, "ablation", tmp_path / "a.json", "--page", str(page))["rows"]
    assert list(rows) == list(TRAINED["ablation"])
    for row in rows.values():
        assert (
            row["psnr"] > 5
            and row["train_seconds"] > 0
            and row["styled_psnr"] > 3
            and row["paper_styled_psnr"] > 3
            and 0 <= row["match_border"] <= 1
        )
    assert rows["as it is"]["psnr"] != rows["without pre-trained decoder"]["psnr"]
    text = page.read_text()
    assert text.startswith("# Ablation") and "without either" in text and text in capsys.readouterr().out


def test_clusters_share_one_training(world: World, tmp_path: Path) -> None:
    rows = table(world, "clusters", tmp_path / "a.json", "--clusters", "1", "3")["rows"]
    assert list(rows)[:2] == ["1 clusters", "3 clusters"] and len(rows) == 6
    assert all("psnr" not in row and row["style_seconds"] > 0 for row in rows.values())
    assert rows["1 clusters"]["styled_psnr"] != rows["3 clusters"]["styled_psnr"]
    cells, clusters = (rows[f"local-adain, {codes}"] for codes in ("every cell a code", "clusters"))
    assert cells["styled_psnr"] != clusters["styled_psnr"] and 0 < cells["match_inside"] <= 1


def test_statistics_of_views_differ_from_the_scenes(world: World, tmp_path: Path) -> None:
    rows = table(world, "statistics", tmp_path / "a.json", "--run", str(world.run))["rows"]
    for name in ("adain", "local-adain", "region-tone"):
        shared, alone = rows[f"{name}, of the scene"], rows[f"{name}, of each view"]
        assert shared["styled_psnr"] != alone["styled_psnr"]
        assert shared["consistency"] is not None and alone["consistency"] is not None


def test_far_views_are_compared_on_one_path(world: World, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    rows = table(world, "large-scale", tmp_path / "a.json", "--run", str(world.run), "--page", str(page))["rows"]
    assert list(rows) == ["no change", "2d, every picture alone", "adain", "local-adain", "region-tone", "region-ot"]
    assert rows["no change"]["consistency"] == 0 and rows["no change"]["structure"] == pytest.approx(1)
    assert all(row["consistency"] >= 0 and row["structure"] <= 1 for row in rows.values())
    assert page.read_text().startswith("# Large-scale") and "seven frames on" in page.read_text()


def test_tables_of_styles_need_a_town(shared: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = shared / "data/scenes/street_lund"
    if not scene.is_dir():
        pytest.skip("no such scene")
    args = ["paper", "--table", "clusters", "--data", str(scene), "--downscale", "16", *SMALL]
    assert main(args) == 2
    assert "judged by a town's truth" in capsys.readouterr().err


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
CHANGED = {
    ("reconstruction", "frozen decoder"): set(),
    ("reconstruction", "frozen and residual"): {DECODER},
    ("reconstruction", "decoder trained with the scene"): {DECODER},
    ("ablation", "as it is"): set(),
    ("ablation", "without content loss"): {CONTENT},
    ("ablation", "without pre-trained decoder"): {DECODER},
    ("ablation", "without either"): {DECODER, CONTENT},
    ("guided-filter", "with guided filter"): set(),
    ("guided-filter", "without"): {GUIDE},
}


def leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from leaves(inner, f"{name}.{key}" if name else key)
    else:
        yield name, value


def flat(config: TrainConfig) -> dict[str, Any]:
    """Every field by name; the decoder of tables is no plug-in and goes by its class."""
    kind = type(config.content.decoder).__name__
    if isinstance(config.content.decoder, SceneDecoderConfig):
        config = replace(config, content=replace(config.content, decoder=fprf_lite().content.decoder))
    return dict(leaves(to_json(config))) | {DECODER: kind}


@pytest.mark.parametrize(("table", "row"), [(table, row) for table, rows in TRAINED.items() for row in rows])
def test_a_row_changes_what_it_says(table: str, row: str) -> None:
    before, after = flat(fprf_lite()), flat(TRAINED[table][row](fprf_lite()))
    differs = {name for name in before.keys() | after.keys() if before.get(name) != after.get(name)}
    expected = CHANGED[(table, row)]
    assert {name for name in differs if not name.startswith("content.decoder.") or name == DECODER} == expected
    assert after[CONTENT] == (0.0 if CONTENT in expected else before[CONTENT])
