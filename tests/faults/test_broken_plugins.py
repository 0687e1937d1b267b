"""Faults 9, 10 and 11: packages that misbehave, installed all at once; everybody else is unaffected."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from fake_packages import packages_in
from tiny_world import World
from torch import Tensor

from fprf.errors import PluginError
from fprf.interfaces import Stylizer
from fprf.plugins.stylizers.config import StylizerConfig
from fprf.style.scene_style import own_style
from fprf.testing import cases
from fprf.testing.outputs import check_parts, check_stylizer
from fprf.training.model import build_model
from fprf.types import FieldSample, Want

CONFIG = '''
from dataclasses import dataclass
from fprf.plugins.encoders.config import EncoderConfig

@dataclass(frozen=True, kw_only=True)
class C(EncoderConfig):
    """A stranger's encoder."""

    def build(self):
        {build}
'''
BROKEN = {
    "exits": "import sys; sys.exit(3)",
    "dies": "import os; os._exit(4)",
    "prints": "print('hello from a plug-in')\n" + CONFIG.format(build="raise NotImplementedError"),
    "slow": "import time; time.sleep(30)",
    "syntax": "def f(:",
    "no-attribute": "x = 1",
    "warns": "import warnings; warnings.warn('old'); raise Warning('as an error')",
    "recursive": "def f(): f()\nf()",
    "unbuilt": CONFIG.format(build="return None"),
}


def run(folder: Path, *args: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    words = [sys.executable, "-m", "fprf", *args]
    return subprocess.run(words, env=environment, capture_output=True, text=True, timeout=240)


@pytest.mark.fault
def test_the_verbs_of_a_user_with_all_of_them_installed(world: World, tmp_path: Path) -> None:
    """And the two that no process survives, or waits for, only when they are asked for."""
    with packages_in(tmp_path) as packages:
        for name, source in BROKEN.items():
            module = f"broken_{name.replace('-', '_')}"
            packages.install(f"acme-{name}", {"fprf.encoders": {name: f"{module}:C"}}, code={module: source})
        for k in (1, 2):
            packages.install(f"acme-clash-{k}", {"fprf.encoders": {"clash": f"broken_unbuilt:C{k}"}})
    checked = run(tmp_path, "plugins")
    assert checked.returncode == 0
    shown = run(tmp_path, "train", "fprf-lite", "--help")
    assert shown.returncode == 0 and "--content.encoder" in shown.stdout
    photo = str(world.references[0])
    styled = run(
        tmp_path, "stylize", str(world.run), "--references", photo, "--output", str(tmp_path / "styled")
    )
    assert styled.returncode == 0, styled.stderr
    assert run(tmp_path, "train", "fprf-lite", "--content.encoder", "dies").returncode == 4


def density(change: Callable[[Tensor, Tensor], object]) -> Callable[[FieldSample, Tensor], FieldSample]:
    """Another density of the same points."""
    return lambda found, points: found._replace(density=change(found.density, points))


def broken(*_: object) -> object:
    raise ZeroDivisionError("two\nlines")


BREACHES: list[tuple[str, str, Callable[[Any, Any], Any], str]] = [
    (
        "field",
        "density",
        density(lambda d, _: d[:, None]),
        r"expected float32 \[5\] on cpu, found float32 \[5 1\] on cpu",
    ),
    ("field", "density", density(lambda d, _: d.double()), r"found float64 \[5\]"),
    ("field", "density", density(lambda d, _: d.to("meta")), "on meta"),
    (
        "field",
        "density",
        density(lambda d, _: d * torch.nan),
        "expected finite numbers, found 5 of 5 that are not",
    ),
    ("field", "density", density(lambda d, _: d - 1e3), r"expected numbers in \[0, inf\], found -"),
    ("field", "density", density(lambda d, _: d.tolist()), "found list"),
    ("field", "density", density(lambda _, points: points.mul_(2)[:, 0]), "an input that is left alone"),
    ("field", "density", broken, "expected an answer, found ZeroDivisionError: two;"),
    ("field", "content", lambda found, _: found[:, 1:], r"expected float32 \[5 \d+\] on cpu"),
    ("decoder", "forward", lambda found, _: found + 5, r"colours: expected numbers in \[0, 1\]"),
    (
        "semantic",
        "forward",
        lambda found, _: found[:3],
        r"expected float32 \[5 8\] on cpu, found float32 \[3 8\]",
    ),
    ("sampler", "forward", lambda found, _: found._replace(t=found.t.flip(1)), "not decreasing along a ray"),
]
"""A part, its method, what comes instead of what it returned for its first argument, and what is told."""


@pytest.mark.parametrize(("part", "method", "change", "told"), BREACHES)
def test_a_part_that_breaks_its_contract_is_named(
    world: World,
    monkeypatch: pytest.MonkeyPatch,
    part: str,
    method: str,
    change: Callable[[Any, Any], Any],
    told: str,
) -> None:
    facts = world.prepared.facts
    parts = build_model(world.config, facts).parts
    check_parts(world.config, parts, facts.of_field.channels, facts.of_field.dim)
    module = getattr(parts, part)
    real = getattr(module, method)
    monkeypatch.setattr(
        module, method, lambda first, *rest, **named: change(real(first, *rest, **named), first)
    )
    group = {"field": "fields", "semantic": "fields"}.get(part, f"{part}s")
    with pytest.raises(
        PluginError, match=rf"fprf\.{group}: '.*' \(fprf\..*from fprf .*\): .*{told}"
    ) as caught:
        check_parts(world.config, parts, facts.of_field.channels, facts.of_field.dim)
    assert "\n" not in str(caught.value)


@dataclass(frozen=True, kw_only=True)
class MineConfig(StylizerConfig):
    """A stranger's, without an entry point."""


class Mine(Stylizer):
    def __init__(self, wrong: str) -> None:
        super().__init__()
        self.wrong = wrong

    @property
    def needs(self) -> Want:
        return Want.COLOUR if self.wrong == "needs" else Want.CONTENT

    def forward(self, content: Tensor, semantic: Tensor | None) -> Tensor:
        if self.wrong == "writes":
            content += 1
        return content / 0 if self.wrong == "inf" else content

    def match(self, semantic: Tensor) -> Tensor:
        return torch.ones(len(semantic), 1 if self.wrong == "codes" else 4) / (
            1 if self.wrong == "sum" else 4
        )


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ("needs", "needs: expected Want.CONTENT"),
        ("writes", "features: expected an input that is left alone"),
        ("inf", "features: expected finite numbers"),
        ("codes", r"matches: expected float32 \[5 4\] on cpu, found float32 \[5 1\]"),
        ("sum", "matches: expected rows that sum to 1, found a sum of 4"),
    ],
)
def test_a_stylizer_that_breaks_its_contract_is_named(wrong: str, told: str) -> None:
    scene = cases.scene(4, 8, 4)
    codes = own_style(scene)
    check_stylizer(MineConfig(), Mine(""), codes, scene)
    with pytest.raises(PluginError, match=r"test_broken_plugins:MineConfig: " + told):
        check_stylizer(MineConfig(), Mine(wrong), codes, scene)
