import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from fake_packages import packages_in
from tiny_world import World

from fprf.cli.doctor import machine, method_needs, run, run_folder
from fprf.cli.doctor_scene import scene_folder
from fprf.cli.findings import Finding
from fprf.methods import fprf_lite
from fprf.plugins.codec import save_config

LAST = fprf_lite().steps


def _by_name(findings: Iterator[Finding]) -> dict[str, Finding]:
    return {finding.what: finding for finding in findings}


@pytest.fixture
def trained(tmp_path: Path) -> Path:
    folder = tmp_path / "a run"
    folder.mkdir()
    save_config(folder / "config.json", fprf_lite(), "fprf-lite")
    for step in (100, LAST, LAST + 1000):
        (folder / "checkpoints" / f"step-{step:07d}").mkdir(parents=True)
    for step in (100, LAST):
        (folder / "checkpoints" / f"step-{step:07d}" / "manifest.json").write_text("{}")
    for name in ("scene.json", "style.safetensors", "metrics.json"):
        (folder / name).write_bytes(b"x" * 1000)
    return folder


def test_an_unfinished_run_says_how_to_go_on(trained: Path) -> None:
    (trained / "checkpoints" / f"step-{LAST:07d}" / "manifest.json").unlink()
    (trained / "style.safetensors").unlink()
    found = _by_name(run_folder(trained))
    remedy = f"fprf train '{trained}/config.json' --output '{trained}'"
    assert found["checkpoints"] == Finding("checkpoints", f"step 100 of {LAST}", remedy, optional=True)
    assert found["style.safetensors"].remedy == remedy and not found["style.safetensors"].optional
    (trained / "checkpoints" / "step-0000100" / "manifest.json").unlink()
    assert _by_name(run_folder(trained))["checkpoints"] == Finding("checkpoints", "none is complete", remedy)
    assert run([str(trained)]) == 1


def test_a_missing_plugin_of_a_run_is_named(trained: Path) -> None:
    whole = json.loads((trained / "config.json").read_text())
    whole["config"]["semantic"]["encoder"] = {"type": "gone"}
    whole["plugins"]["semantic.encoder"] = "gone acme-gone 0.3"
    (trained / "config.json").write_text(json.dumps(whole))
    finding = _by_name(run_folder(trained))["plug-ins"]
    assert finding.optional and "acme-gone 0.3" in finding.remedy and "--semantic.encoder NAME" in finding.remedy
    assert run([str(trained)]) == 0, "it renders without its encoder"


def test_scene_folders(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    found = _by_name(scene_folder(world.town))
    assert found["format"].found == "transforms" and found["views"].found == "10 of 32 x 24 pixels, pinhole lens"
    assert found["next"].found == f"fprf train --data {world.town}"
    assert run([str(world.town)]) == 0 and "32 x 24" in capsys.readouterr().out


METHOD = """
from dataclasses import replace
from fprf.methods import fprf
from fprf.plugins.encoders.config import DinoConfig
def m():
    return replace(fprf(), semantic=replace(fprf().semantic, encoder=DinoConfig()))
"""
"""A method with an encoder of the hub."""


def test_a_method_says_what_it_needs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert run(["fprf-lite"]) == run(["fprf"]) == 0, "what they need ships"
    with packages_in(tmp_path) as packages:
        packages.install("acme-m", {"fprf.methods": {"acme-m": "acme_methods:m"}}, code={"acme_methods": METHOD})
        assert run(["acme-m"]) == 1
        package, model = (finding for finding in method_needs("acme-m") if finding.what == "needs")
        assert "transformers" in package.found and package.remedy.startswith("pip install") and not package.optional
        assert model.remedy == "hf download facebook/dino-vits8" and model.optional, "it is downloaded where there is a network"
        snapshot = tmp_path / "models--facebook--dino-vits8" / "snapshots" / "1"
        snapshot.mkdir(parents=True)
        (snapshot / "config.json").touch()
        assert [finding for finding in method_needs("acme-m") if finding.what == "needs"] == [package]


def test_the_feature_cache_is_told_and_cleaned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    files = tmp_path / "fprf" / "features" / "content"
    files.mkdir(parents=True)
    (files / "a.safetensors").write_bytes(bytes(3 << 20))
    (tmp_path / "fprf" / "weights").mkdir()
    assert _by_name(machine())["features"].found.startswith("3 MiB of at most 2048")
    assert run(["--clean"]) == 0 and "3 MiB deleted" in capsys.readouterr().out
    assert not files.exists() and (tmp_path / "fprf" / "weights").is_dir()
