"""Rows of the tables that compare styles of one training."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_world import World

from fprf.evidence.config import PaperConfig
from fprf.evidence.paper_styles import ONE_TRAINING, Bench, restyled, set_up, style_rows
from fprf.evidence.scores import Row
from fprf.plugins.stylizers.config import AdainConfig, LocalAdainConfig, RegionToneConfig

CONFIG = PaperConfig(table="multi-reference", views=2, palettes=("night",), device="cpu", codes=4)


def bench(world: World, folder: Path, config: PaperConfig = CONFIG, *, path: bool = False) -> Bench:
    trained = world.load()
    return set_up(trained, trained.encoders(), config, folder, path=path)


def untimed(row: Row) -> Row:
    return {key: value for key, value in row.items() if not key.endswith("seconds")}


def test_a_row_is_the_mean_over_palettes(world: World, tmp_path: Path) -> None:
    alone = [
        restyled(bench(world, tmp_path / light, replace(CONFIG, palettes=(light,))), LocalAdainConfig(), "one")
        for light in ("night", "winter")
    ]
    both = restyled(bench(world, tmp_path, replace(CONFIG, palettes=("night", "winter"))), LocalAdainConfig(), "one")
    for key, value in untimed(both).items():
        assert value == pytest.approx(sum(row[key] or 0.0 for row in alone) / 2, rel=1e-9)
    assert alone[0]["styled_psnr"] != alone[1]["styled_psnr"]


def test_the_same_twice_gives_the_same_row(world: World, tmp_path: Path) -> None:
    first, second = (restyled(bench(world, tmp_path / str(k)), RegionToneConfig()) for k in range(2))
    assert untimed(first) == untimed(second)
    assert first["style_seconds"] is not None and first["style_seconds"] > 0


def test_codes_and_blend_reach_the_dictionary(world: World, tmp_path: Path) -> None:
    usual = untimed(restyled(bench(world, tmp_path / "a"), RegionToneConfig(), "one"))
    for k, changed in enumerate((replace(CONFIG, codes=1), replace(CONFIG, blend=0.9))):
        assert untimed(restyled(bench(world, tmp_path / str(k), changed), RegionToneConfig(), "one")) != usual
    named = restyled(bench(world, tmp_path / "c", replace(CONFIG, codes=9)), RegionToneConfig(), "one", clusters=4)
    assert untimed(named) == usual, "a number that is given counts"


def test_there_is_a_path_only_where_it_is_asked_for(world: World, tmp_path: Path) -> None:
    without, near = bench(world, tmp_path), bench(world, tmp_path, path=True)
    far = bench(world, tmp_path, replace(CONFIG, table="large-scale"), path=True)
    assert len(without.stage.path) == 0 and len(near.stage.path) == len(far.stage.path) == 8
    steps = [float((each.stage.path.pose[1, :, 3] - each.stage.path.pose[0, :, 3]).norm()) for each in (near, far)]
    assert steps[1] == pytest.approx(4 * steps[0])
    assert "consistency" not in restyled(without, AdainConfig(), "one")
    assert restyled(near, AdainConfig(), "one")["consistency"] is not None


def test_global_styles_match_nothing(world: World, tmp_path: Path) -> None:
    here = bench(world, tmp_path)
    assert "match_inside" not in restyled(here, AdainConfig(), "one")
    row = restyled(here, LocalAdainConfig(), "one")
    for key in ("match", "match_inside", "match_border", "match_kind"):
        value = row[key]
        assert value is not None and 0 <= value <= 1


def test_time_begins_with_the_training(world: World, tmp_path: Path) -> None:
    rows = style_rows(bench(world, tmp_path, replace(CONFIG, table="time", views=1)))
    assert next(iter(rows)) == "training" and rows["training"] == {"train_seconds": world.load().seconds}
    assert len(rows) == 4 and all(row["view_seconds"] for name, row in rows.items() if name != "training")


def test_statistics_are_the_scenes_or_each_views(world: World, tmp_path: Path) -> None:
    rows = style_rows(bench(world, tmp_path, replace(CONFIG, table="statistics", views=1), path=True))
    shared, alone = rows["adain, of the scene"], rows["adain, of each view"]
    assert set(shared) == set(alone) and shared["structure"] != alone["structure"]


def test_every_table_of_one_training_is_a_choice(world: World) -> None:
    for name in ONE_TRAINING:
        assert PaperConfig(table=name).table == name  # type: ignore[arg-type]


def test_small_pictures_have_no_structure(world: World, tmp_path: Path) -> None:
    here = bench(world, tmp_path)
    known = replace(here.trained.known, cameras=here.trained.known.cameras.scaled(4.0))
    trained = replace(here.trained, known=known)
    row = restyled(set_up(trained, here.encoders, CONFIG, tmp_path), AdainConfig(), "one")
    assert "structure" not in row and torch.isfinite(torch.tensor(row["styled_psnr"]))
