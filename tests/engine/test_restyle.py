from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_world import World

from fprf.engine.restyle import restyle
from fprf.errors import DataError, UsageError, WeightsError
from fprf.plugins.stylizers.config import AdainConfig, RegionOtConfig
from fprf.types import Want


def test_a_dictionary_of_both_references(world: World) -> None:
    styled = restyle(world.load(), world.references, RegionOtConfig(), clusters=3)
    dictionary, facts = styled.dictionary, world.prepared.facts
    assert set(dictionary.names) == {"dusk.png", "snow.png"} and set(dictionary.reference.tolist()) == {0, 1}
    assert dictionary.mean.shape[1] == facts.channels and dictionary.keys.shape[1] == facts.dim
    assert 2 <= len(dictionary.keys) <= 6
    assert styled.restyle.strength == 1 and Want.SEMANTIC in styled.restyle.stylizer.needs


def test_the_order_of_references_does_not_matter(world: World) -> None:
    trained, (a, b) = world.load(), world.references
    one = restyle(trained, [a, b], RegionOtConfig(), weights=(2.0, 1.0)).dictionary
    two = restyle(trained, [b, a], RegionOtConfig(), weights=(1.0, 2.0)).dictionary
    assert one.names == two.names
    for x, y in zip(one, two, strict=True):
        assert torch.equal(x, y) if isinstance(x, torch.Tensor) else x == y


def test_weights_and_blend_count(world: World) -> None:
    trained = world.load()
    even = restyle(trained, world.references, AdainConfig()).dictionary
    heavy = restyle(trained, world.references, AdainConfig(), weights=(9.0, 1.0)).dictionary
    whole = restyle(trained, world.references, AdainConfig(), blend=1.0).dictionary
    assert not torch.equal(even.weight, heavy.weight) and not torch.equal(even.mean, whole.mean)
    for of in whole.reference.unique():
        codes = whole.mean[whole.reference == of]
        assert torch.allclose(codes, codes[:1].expand_as(codes), atol=1e-5), "all of its reference's overall style"


def test_mistakes(world: World, tmp_path: Path) -> None:
    trained = world.load()
    with pytest.raises(UsageError, match="--references: at least one photograph"):
        restyle(trained, [], RegionOtConfig())
    with pytest.raises(UsageError, match="--weights: 3 weights for 2 references"):
        restyle(trained, world.references, RegionOtConfig(), weights=(1.0, 2.0, 3.0))
    with pytest.raises(DataError, match=r"absent\.jpg"):
        restyle(trained, [tmp_path / "absent.jpg"], RegionOtConfig())
    (tmp_path / "text.jpg").write_text("no picture")
    with pytest.raises(DataError, match=r"text\.jpg"):
        restyle(trained, [tmp_path / "text.jpg"], RegionOtConfig())


@pytest.mark.parametrize("which", ["content", "semantic"])
def test_other_encoders_than_the_scenes_are_refused(world: World, which: str) -> None:
    trained = world.load()
    changed = {f"{which}_encoder": f"bundled-{which}:000000000000"}
    facts = replace(trained.known.facts, **changed)  # type: ignore[arg-type]
    with pytest.raises(WeightsError, match=f"{which} encoder: the scene was trained with bundled-{which}:000000000000"):
        restyle(trained._replace(known=replace(trained.known, facts=facts)), world.references, RegionOtConfig())
