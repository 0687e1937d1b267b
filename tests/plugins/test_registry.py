"""Plug-ins by name, and the slots that flags fill with them."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest
from fake_packages import ENCODER, Packages, packages_in
from hypothesis import given
from hypothesis import strategies as st

from fprf.errors import FprfError, PluginError, UsageError
from fprf.methods import fprf
from fprf.plugins import registry
from fprf.plugins.config import PluginConfig
from fprf.plugins.encoders.config import EncoderConfig, RandomConfig, Vgg19Config
from fprf.plugins.samplers.config import UniformConfig
from fprf.plugins.slots import resolve, slots

GROUP = "fprf.encoders"


def test_built_ins_are_listed_by_name_and_found_by_class() -> None:
    assert list(registry.installed(GROUP)) == sorted(registry.installed(GROUP))
    assert registry.load(GROUP, "vgg19", EncoderConfig) is Vgg19Config
    assert registry.name_of(GROUP, RandomConfig) == "random"
    assert registry.entry(GROUP, "vgg19").package.startswith("fprf ")
    assert GROUP in registry.groups() and all(group.startswith("fprf.") for group in registry.groups())
    assert not registry.installed("fprf.no-such-group")


def test_a_strangers_plugin_is_listed_without_being_imported(packages: Packages) -> None:
    packages.install(
        "acme-clip", {GROUP: {"acme": "acme_a:ClipConfig"}}, code={"acme_a": ENCODER.format(name="Clip")}
    )
    assert "acme" in registry.installed(GROUP)
    assert "acme_a" not in sys.modules
    found = registry.load(GROUP, "acme", EncoderConfig)
    assert found.__name__ == "ClipConfig"
    assert registry.entry(GROUP, "acme").origin == "acme_a:ClipConfig from acme-clip 1"


@pytest.mark.parametrize(
    ("source", "shown"),
    [
        ("import not_there_at_all", "ModuleNotFoundError: No module named 'not_there_at_all'"),
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("class Odd(BaseException): ...\nraise Odd('odd')", "Odd: odd"),
        ("def f(:", "SyntaxError"),
        ("def f(): f()\nf()", "RecursionError"),
        ("raise Warning('as an error')", "Warning: as an error"),
        ("x = 1", "AttributeError"),
    ],
)
def test_a_broken_import_names_the_package_and_the_cause(packages: Packages, source: str, shown: str) -> None:
    packages.install("acme-bad", {GROUP: {"bad": "acme_bad:BadConfig"}}, code={"acme_bad": source})
    assert "bad" in registry.installed(GROUP)
    with pytest.raises(
        PluginError, match=r"'bad' \(acme_bad:BadConfig from acme-bad 1\) failed to import"
    ) as caught:
        registry.load(GROUP, "bad", EncoderConfig)
    assert shown in str(caught.value)


def test_damaged_metadata_hurts_nobody_else(packages: Packages) -> None:
    packages.raw("acme-damaged", "[fprf.encoders]\nno equals sign here\n")
    packages.raw("acme-foreign", "[console_scripts]\nno equals sign here\n")
    assert "vgg19" in registry.installed(GROUP)
    assert [str(packages.root) in each for each in registry.unreadable()] == [True]
    # An installation that was cut off leaves no name.
    packages.raw("acme-nameless", "[fprf.encoders]\nnameless = acme:Config\n")
    (packages.root / "acme_nameless-1.dist-info" / "METADATA").unlink()
    assert "vgg19" in registry.installed(GROUP) and len(registry.unreadable()) == 2


def test_of_several_copies_the_first_counts(packages: Packages, tmp_path: Path) -> None:
    packages.raw("acme-copied", "[fprf.encoders]\nolder = acme:Config\n")
    assert "older" in registry.installed(GROUP)
    with packages_in(tmp_path / "nearer") as nearer:
        nearer.raw("Acme_Copied", "", version="2")
        assert "older" not in registry.installed(GROUP)


@given(st.text(max_size=20).filter(lambda name: name not in registry.installed(GROUP)))
def test_any_unknown_name_is_one_plugin_error(name: str) -> None:
    with pytest.raises(PluginError):
        registry.load(GROUP, name, EncoderConfig)


def test_an_interrupt_while_importing_is_an_interrupt(packages: Packages) -> None:
    packages.install(
        "acme-slow", {GROUP: {"slow": "acme_slow:S"}}, code={"acme_slow": "raise KeyboardInterrupt"}
    )
    with pytest.raises(KeyboardInterrupt):
        registry.load(GROUP, "slow", EncoderConfig)


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


SHAPES = {"fprf.shapes": {"round": "test_registry:RoundConfig", "group": "test_registry:GroupConfig"}}


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
    assert resolve(fprf(), ["--sampler", "proposal", "--sampler=uniform"])[0].sampler == UniformConfig(), (
        "the last one counts"
    )


def test_none_empties_an_optional_slot_only() -> None:
    config, _ = resolve(fprf(), ["--semantic.encoder", "none"])
    assert config.semantic.encoder is None
    with pytest.raises(UsageError, match=r"--content\.encoder: cannot be none; allowed are"):
        resolve(fprf(), ["--content.encoder", "none"])


def test_a_chosen_plugin_brings_slots_of_its_own(packages: Packages) -> None:
    packages.install("shapes", SHAPES)
    config, rest = resolve(
        Tree(), ["--shape.inner.inner", "round", "--shape.inner", "group", "--shape", "group"]
    )
    assert config.shape == GroupConfig(inner=GroupConfig(inner=RoundConfig())) and not rest
    assert resolve(Tree(), ["--other", "round"])[0].other == RoundConfig()


def test_errors_say_which_slot() -> None:
    with pytest.raises(
        PluginError, match=r"^--sampler: fprf.samplers: no plug-in 'unifrom'.*did you mean 'uniform'"
    ):
        resolve(fprf(), ["--sampler", "unifrom"])
    with pytest.raises(PluginError, match=r"^--content.field: .*not a ContentFieldConfig"):
        resolve(fprf(), ["--content.field", "semantic-planes"])


@pytest.mark.parametrize("name", ["semantic-planes", "semantic-plains", "none"])
def test_a_refusal_offers_no_plugin_of_another_kind(name: str) -> None:
    with pytest.raises(FprfError, match=r"(?<!-)\bplanes\b") as caught:
        resolve(fprf(), ["--content.field", name])
    assert "semantic-planes" not in str(caught.value).replace(f"'{name}'", "")


def test_types_that_cannot_be_resolved_are_named(packages: Packages) -> None:
    source = "from __future__ import annotations\n" + ENCODER.format(name="Lost").replace(
        "tile: int", "tile: Nowhere"
    )
    packages.install(
        "acme-lost", {"fprf.encoders": {"lost": "acme_lost:LostConfig"}}, code={"acme_lost": source}
    )
    with pytest.raises(PluginError, match=r"acme_lost:LostConfig: its field types cannot be resolved"):
        resolve(fprf(), ["--semantic.encoder", "lost"])
