"""Each row of a table that trains changes what it says, and nothing else."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_world import World

from fprf.config import TrainConfig
from fprf.evidence.config import PaperConfig
from fprf.evidence.paper import TRAINED, paper, short_training
from fprf.evidence.scene_decoder import SceneDecoderConfig
from fprf.evidence.scores import Row
from fprf.methods import fprf_lite
from fprf.plugins.codec import to_json

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


def test_the_first_row_is_the_method_as_it_is() -> None:
    for rows in TRAINED.values():
        change = next(iter(rows.values()))
        assert change(fprf_lite()) == fprf_lite()


def test_a_scene_decoder_is_trained_and_a_frozen_one_is_not(world: World, tmp_path: Path) -> None:
    config = replace(world.config, steps=3, output=None)
    quiet = lambda done, total, what: None  # noqa: E731
    frozen = short_training(config, tmp_path / "a", quiet)
    again = short_training(config, tmp_path / "b", quiet)
    own = short_training(TRAINED["ablation"]["without pre-trained decoder"](config), tmp_path / "c", quiet)
    models = [each.trained.model.decoder.state_dict() for each in (frozen, again)]
    assert all(torch.equal(models[0][name], models[1][name]) for name in models[0])
    shipped = config.content.decoder.build(
        encoder=frozen.encoders.content.identity, channels=frozen.encoders.content.channels, seed=config.seed + 3
    )
    assert all(torch.equal(a, b) for a, b in zip(shipped.state_dict().values(), models[0].values(), strict=True))
    start = SceneDecoderConfig().build(
        encoder=own.encoders.content.identity, channels=own.encoders.content.channels, seed=config.seed + 3
    )
    moved = zip(start.state_dict().values(), own.trained.model.decoder.state_dict().values(), strict=True)
    assert any(not torch.equal(a, b) for a, b in moved)
    assert not any(parameter.requires_grad for parameter in own.trained.model.parameters())
    assert own.seconds > 0 and len(own.encoders.scene.share) >= 1


def test_rows_are_means_over_trainings(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[TrainConfig] = []

    def table(config: PaperConfig, base: TrainConfig, *rest: Any) -> dict[str, Row]:
        seen.append(base)
        return {"a": {"psnr": 20.0 + base.seed, "match_inside": None if base.seed else 0.5}}

    monkeypatch.setattr("fprf.evidence.paper._table", table)
    config = PaperConfig(trainings=(0, 1, 5), steps=7, downscale=2, data=Path("fox"), device="cpu")
    document = paper(config, replace(fprf_lite(), minutes=3.0), "fprf-lite", lambda done, total, what: None)
    assert document["rows"] == {"a": {"psnr": 22.0, "match_inside": 0.5}}
    assert [base.seed for base in seen] == [0, 1, 5]
    assert {(base.steps, base.minutes, base.downscale, base.data) for base in seen} == {(7, None, 2, Path("fox"))}
    assert document["settings"]["trainings"] == [0, 1, 5] and document["settings"]["steps"] == 7
