from dataclasses import dataclass
from typing import ClassVar

import pytest
from fake_packages import ENCODER, Packages

from fprf.errors import FprfError, PluginError, UsageError
from fprf.methods import fprf
from fprf.plugins.config import PluginConfig
from fprf.plugins.encoders.config import RandomConfig
from fprf.plugins.samplers.config import UniformConfig
from fprf.plugins.slots import resolve, slots


@dataclass(frozen=True, kw_only=True)
class ShapeConfig(PluginConfig):
    group: ClassVar[str] = "fprf.shapes"


@dataclass(frozen=True, kw_only=True)
class RoundConfig(ShapeConfig):
    radius: float = 1.0


@dataclass(frozen=True, kw_only=True)
class GroupConfig(ShapeConfig):
    inner: ShapeConfig = RoundConfig()


@dataclass(frozen=True, kw_only=True)
class Tree:
    shape: ShapeConfig = RoundConfig()
    other: ShapeConfig | None = None
    count: int = 3


SHAPES = {"fprf.shapes": {"round": "test_slots:RoundConfig", "group": "test_slots:GroupConfig"}}


def test_all_slots_of_the_knob_tree_are_found_outer_first() -> None:
    found = {slot.path: slot for slot in slots(fprf())}
    assert set(found) == {
        "datamanager", "datamanager.parser", "sampler", "content.encoder", "content.field", "content.decoder",
        "semantic.encoder", "semantic.encoder.first", "semantic.encoder.second", "semantic.encoder.third", "semantic.field",
        "blocks", "executor", "loss.extra",
    }  # fmt: skip
    assert list(found).index("datamanager") < list(found).index("datamanager.parser")
    assert found["semantic.encoder"].optional and not found["content.encoder"].optional
    assert found["datamanager.parser"].value is None


@pytest.mark.parametrize("args", [["--sampler"], ["--sampler", "--steps"], ["--sampler="]])
def test_a_flag_without_a_name_is_a_mistake(args: list[str]) -> None:
    with pytest.raises(UsageError, match="--sampler: needs the name of a plug-in"):
        resolve(fprf(), args)


def test_resolving_in_any_order_keeps_the_field_flags() -> None:
    args = ["--semantic.encoder.channels", "4", "--sampler=uniform", "--semantic.encoder", "random"]
    config, rest = resolve(fprf(), args)
    assert config.semantic.encoder == RandomConfig() and config.sampler == UniformConfig()
    assert rest == ["--semantic.encoder.channels", "4"]
    assert resolve(fprf(), ["--sampler", "proposal", "--sampler=uniform"])[0].sampler == UniformConfig(), "the last one counts"


def test_none_empties_an_optional_slot_only() -> None:
    config, _ = resolve(fprf(), ["--semantic.encoder", "none"])
    assert config.semantic.encoder is None
    with pytest.raises(UsageError, match=r"--content\.encoder: cannot be none; allowed are"):
        resolve(fprf(), ["--content.encoder", "none"])


def test_a_chosen_plugin_brings_slots_of_its_own(packages: Packages) -> None:
    packages.install("shapes", SHAPES)
    config, rest = resolve(Tree(), ["--shape.inner.inner", "round", "--shape.inner", "group", "--shape", "group"])
    assert config.shape == GroupConfig(inner=GroupConfig(inner=RoundConfig())) and not rest
    assert resolve(Tree(), ["--other", "round"])[0].other == RoundConfig()


def test_errors_say_which_slot() -> None:
    with pytest.raises(PluginError, match=r"^--sampler: fprf.samplers: no plug-in 'unifrom'.*did you mean 'uniform'"):
        resolve(fprf(), ["--sampler", "unifrom"])
    with pytest.raises(PluginError, match=r"^--content.field: .*not a ContentFieldConfig"):
        resolve(fprf(), ["--content.field", "semantic-planes"])


@pytest.mark.parametrize("name", ["semantic-planes", "semantic-plains", "none"])
def test_a_refusal_offers_no_plugin_of_another_kind(name: str) -> None:
    with pytest.raises(FprfError, match=r"(?<!-)\bplanes\b") as caught:
        resolve(fprf(), ["--content.field", name])
    assert "semantic-planes" not in str(caught.value).replace(f"'{name}'", "")


def test_types_that_cannot_be_resolved_are_named(packages: Packages) -> None:
    source = "from __future__ import annotations\n" + ENCODER.format(name="Lost").replace("tile: int", "tile: Nowhere")
    packages.install("acme-lost", {"fprf.encoders": {"lost": "acme_lost:LostConfig"}}, code={"acme_lost": source})
    with pytest.raises(PluginError, match=r"acme_lost:LostConfig: its field types cannot be resolved"):
        resolve(fprf(), ["--semantic.encoder", "lost"])
