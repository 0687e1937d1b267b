"""Schemas of files: what fprf writes fits them, mistakes do not, and files may name them."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
from tiny_world import World

from fprf.cli.config_schema import schema
from fprf.cli.main import main
from fprf.config_files import load_config, method_config, save_config
from fprf.plugins.registry import installed
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile, read_keyframes, read_style, write_style

jsonschema = pytest.importorskip(
    "jsonschema", reason="the extra `cluster` is not installed: its ray brings it"
)


def fits(content: Any, form: dict[str, Any]) -> bool:
    jsonschema.Draft202012Validator.check_schema(form)
    return bool(jsonschema.Draft202012Validator(form).is_valid(content))


@pytest.mark.parametrize("method", ["fprf", "fprf-lite", "fprf-splats"])
def test_configs(method: str, tmp_path: Path) -> None:
    assert method in installed("fprf.methods")
    form = schema("config", method)
    file = tmp_path / "config.json"
    save_config(file, dataclasses.replace(method_config(method), data=tmp_path), method)
    whole = json.loads(file.read_text())
    assert fits(whole, form)
    whole["$schema"] = "config.schema.json"
    file.write_text(json.dumps(whole))
    assert fits(whole, form) and load_config(file)[1] == method
    for field, wrong in (("steps", "many"), ("stepz", 3), ("semantic", {"encoder": {"type": "nonsense"}})):
        assert not fits({**whole, "config": {**whole["config"], field: wrong}}, form)


def test_styles(world: World, tmp_path: Path) -> None:
    form = schema("style")
    file = tmp_path / "style.json"
    style = StyleConfig(references=world.references, weights=(1, 2), pin=("0=dusk.png",), keep_below=0.5)
    write_style(file, StyleFile(style, {"roofs": (0.5, 1.0)}, "an encoder"), {"seconds": 1})
    whole = json.loads(file.read_text())
    assert fits(whole, form)
    file.write_text(json.dumps({"$schema": "style.schema.json", **whole}))
    assert read_style(file).style == style
    for field in dataclasses.fields(StyleConfig):
        about = form["$defs"]["StyleConfig"]["properties"][field.name]
        assert len(about["description"]) > 10, field.name
    assert not fits({**whole, "style": {**whole["style"], "bald": 1.0}}, form)


def test_keyframes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config-schema", "keyframes"]) == 0
    form = json.loads(capsys.readouterr().out)
    whole = {
        "$schema": "x",
        "format": 1,
        "keyframes": [{"frame": 0, "style": None}, {"frame": 9, "style": "a.json"}],
    }
    (tmp_path / "keys.json").write_text(json.dumps(whole))
    assert fits(whole, form) and len(read_keyframes(tmp_path / "keys.json")) == 2
    assert not fits({**whole, "keyframes": [{"frame": "first", "style": None}]}, form)
