"""Every built-in config survives the command line and JSON."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fprf import __version__
from fprf.cli.parsing import flags_of, load_method, parse
from fprf.cli.plugins import KINDS
from fprf.config_files import load_config, save_config
from fprf.fields.config import PlanesConfig
from fprf.methods import fprf
from fprf.plugins import registry
from fprf.plugins.codec import from_json, to_json
from fprf.plugins.encoders.config import SEMANTICS, Vgg19Config
from fprf.plugins.samplers.config import ProposalConfig
from fprf.plugins.slots import replace, slots
from fprf.testing import check_config

METHODS = [
    name
    for name in registry.installed("fprf.methods")
    if registry.entry("fprf.methods", name).package[:5] == "fprf "
]
PLUGINS = [(group, name) for group in KINDS for name in registry.installed(group)]


def spelled(value: Any) -> list[str]:
    if isinstance(value, tuple):
        return [word for each in value for word in spelled(each)]
    return ["none"] if value is None else [str(value)]


def command_line(config: Any) -> Iterator[str]:
    """The whole config as flags."""
    for slot in slots(config):
        yield f"--{slot.path}"
        yield "none" if slot.value is None else registry.name_of(slot.kind.group, type(slot.value))
    for text, flag in flags_of(config).items():
        value = config
        for part in flag.path.split("."):
            value = getattr(value, part)
        yield from (text, *spelled(value))


@pytest.mark.parametrize("name", METHODS)
def test_a_method_survives_json_and_the_command_line(name: str, tmp_path: Path) -> None:
    config, _ = load_method(name)
    assert from_json(json.loads(json.dumps(to_json(config))), type(config)) == config
    save_config(tmp_path / "config.json", config, name)
    assert load_config(tmp_path / "config.json") == (config, name)
    whole = json.loads((tmp_path / "config.json").read_text())
    assert whole["format"] == 1 and whole["fprf"] == __version__
    if "sampler" in whole["config"]:
        assert whole["plugins"]["sampler"] == f"proposal fprf {__version__}"
    assert [entry.name for entry in tmp_path.iterdir()] == ["config.json"]
    for start in METHODS:
        default, _ = load_method(start)
        if type(default) is not type(config):  # their flags differ
            continue
        assert parse(default, list(command_line(config)), prog="x", description="") == config


@pytest.mark.parametrize(("group", "name"), PLUGINS)
def test_a_plugin_config_keeps_to_the_contract(group: str, name: str) -> None:
    kind = registry.load_object(group, name)
    assert isinstance(kind, type) and issubclass(kind, KINDS[group])
    assert (kind.__doc__ or "").strip(), "the docstring is its help"
    check_config(kind())


@pytest.mark.parametrize(("group", "name"), PLUGINS)
def test_a_plugin_can_be_chosen_and_all_its_fields_set(group: str, name: str) -> None:
    default, _ = load_method("fprf-lite")
    chosen = registry.load_object(group, name)
    assert isinstance(chosen, type)
    places = [
        slot.path for slot in slots(default) if slot.kind.group == group and issubclass(chosen, slot.kind)
    ]
    if not places:
        pytest.skip(f"no slot of the knob tree takes {group}")
    config = replace(default, places[0], chosen())
    assert parse(default, list(command_line(config)), prog="x", description="") == config


def test_the_papers_method_has_the_papers_sizes() -> None:
    config = fprf()
    field = config.content.field
    sampler = config.sampler
    assert isinstance(field, PlanesConfig) and field.resolutions == (64, 128, 256, 512)
    assert isinstance(sampler, ProposalConfig) and (*sampler.samples, sampler.final) == (256, 128, 48)
    assert config.content.encoder == Vgg19Config(layer="relu2_1") and config.semantic.encoder == SEMANTICS
    assert config.render.train_budget == 0 and config.content.moves_density
