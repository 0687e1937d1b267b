from dataclasses import dataclass
from typing import Any, ClassVar

import pytest
from fake_packages import ENCODER, Packages
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.config import TrainConfig
from fprf.errors import PluginError, UsageError
from fprf.methods import fprf, fprf_lite
from fprf.plugins.config import PluginConfig
from fprf.plugins.encoders.config import BundledSemanticConfig, RandomConfig
from fprf.plugins.samplers.config import ProposalConfig, UniformConfig
from fprf.plugins.slots import replace, resolve, slots, take_flag


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
        "semantic.encoder", "semantic.field", "blocks", "executor", "loss.extra",
    }  # fmt: skip
    assert list(found).index("datamanager") < list(found).index("datamanager.parser")
    assert found["semantic.encoder"].optional and not found["content.encoder"].optional
    assert found["datamanager.parser"].value is None


def test_replace_changes_one_place() -> None:
    config = fprf()
    changed = replace(config, "semantic.encoder", None)
    assert changed.semantic.encoder is None and config.semantic.encoder is not None
    assert replace(changed, "semantic.encoder", config.semantic.encoder) == config


@pytest.mark.parametrize("flag", ["--semantic.encoder", "--checkpoint-minutes", "--checkpoint_minutes"])
def test_take_flag_both_forms_the_last_wins(flag: str) -> None:
    name = flag[2:].replace("-", "_")
    assert take_flag(["a", flag, "x", "b"], name) == ("x", ["a", "b"])
    assert take_flag([f"{flag}=x", "--other", flag, "y"], name) == ("y", ["--other"])
    assert take_flag(["--other", "z"], name) == (None, ["--other", "z"])


@pytest.mark.parametrize("args", [["--sampler"], ["--sampler", "--steps"], ["--sampler="]])
def test_a_flag_without_a_name_is_a_mistake(args: list[str]) -> None:
    with pytest.raises(UsageError, match="--sampler: needs the name of a plug-in"):
        take_flag(args, "sampler")


@settings(max_examples=40, deadline=None)
@given(st.lists(st.sampled_from(["--steps", "5", "--sampler.samples", "--samples", "uniform", "-1"]), max_size=6), st.data())
def test_taking_a_flag_leaves_the_rest_in_order(rest: list[str], data: Any) -> None:
    at = data.draw(st.integers(0, len(rest)))
    args = [*rest[:at], "--sampler", "uniform", *rest[at:]]
    assert take_flag(args, "sampler") == ("uniform", rest)


def test_resolving_in_any_order_keeps_the_field_flags() -> None:
    args = ["--semantic.encoder.channels", "4", "--sampler=uniform", "--semantic.encoder", "random"]
    config, rest = resolve(fprf(), args)
    assert config.semantic.encoder == RandomConfig() and config.sampler == UniformConfig()
    assert rest == ["--semantic.encoder.channels", "4"]


def test_naming_what_is_there_keeps_the_methods_values() -> None:
    lite = fprf_lite()
    config, _ = resolve(lite, ["--sampler", "proposal"])
    assert config.sampler == lite.sampler != ProposalConfig()


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


def test_a_config_without_defaults_is_the_strangers_fault(packages: Packages) -> None:
    source = ENCODER.format(name="Needy").replace("tile: int = 224", "tile: int")
    packages.install("acme-needy", {"fprf.encoders": {"needy": "acme_needy:NeedyConfig"}}, code={"acme_needy": source})
    with pytest.raises(PluginError, match=r"'needy' \(acme_needy.*acme-needy 1\) has no defaults"):
        resolve(fprf(), ["--semantic.encoder", "needy"])


def test_types_that_cannot_be_resolved_are_named(packages: Packages) -> None:
    source = "from __future__ import annotations\n" + ENCODER.format(name="Lost").replace("tile: int", "tile: Nowhere")
    packages.install("acme-lost", {"fprf.encoders": {"lost": "acme_lost:LostConfig"}}, code={"acme_lost": source})
    with pytest.raises(PluginError, match=r"acme_lost:LostConfig: its field types cannot be resolved"):
        resolve(fprf(), ["--semantic.encoder", "lost"])


def test_a_broken_stranger_hurts_only_who_names_it(packages: Packages) -> None:
    packages.install("acme-bad", {"fprf.encoders": {"bad": "acme_bad2:Bad"}}, code={"acme_bad2": "1 / 0"})
    config, _ = resolve(TrainConfig(), ["--semantic.encoder", "bundled-semantic"])
    assert config.semantic.encoder == BundledSemanticConfig()
    with pytest.raises(PluginError, match="ZeroDivisionError"):
        resolve(TrainConfig(), ["--semantic.encoder", "bad"])
