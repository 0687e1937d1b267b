"""Faults 9, 10 and 11: a dozen packages that misbehave, installed all at once; everybody else is unaffected."""

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from fake_packages import Packages, packages_in
from tiny_world import World
from torch import Tensor, nn

from fprf.errors import PluginError
from fprf.interfaces import Stylizer
from fprf.plugins.stylizers.config import StylizerConfig
from fprf.rendering.plugin_checks import check_parts, check_stylizer
from fprf.style.scene import own_style
from fprf.testing import cases
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
    "raises": "raise RuntimeError('broken at import')",
    "exits": "import sys; sys.exit(3)",
    "dies": "import os; os._exit(4)",
    "prints": "print('hello from a plug-in')\n" + CONFIG.format(build="raise NotImplementedError"),
    "slow": "import time; time.sleep(30)",
    "syntax": "def f(:",
    "absent": "import a_package_that_is_not_there",
    "wrong-type": "C = 3",
    "no-attribute": "x = 1",
    "warns": "import warnings; warnings.warn('old'); raise Warning('as an error')",
    "recursive": "def f(): f()\nf()",
    "unbuilt": CONFIG.format(build="return None"),
}


def install(packages: Packages) -> None:
    """Each in a package of its own; two of one name."""
    for name, source in BROKEN.items():
        module = f"broken_{name.replace('-', '_')}"
        packages.install(f"acme-{name}", {"fprf.encoders": {name: f"{module}:C"}}, code={module: source})
    for k in (1, 2):
        packages.install(f"acme-clash-{k}", {"fprf.encoders": {"clash": f"broken_unbuilt:C{k}"}})


def run(folder: Path, *args: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    words = [sys.executable, "-m", "fprf", *args]
    return subprocess.run(words, env=environment, capture_output=True, text=True, timeout=240)


@pytest.mark.fault
def test_the_verbs_of_a_user_with_all_of_them_installed(world: World, tmp_path: Path) -> None:
    """And the two that no process survives, or waits for, only when they are asked for."""
    with packages_in(tmp_path) as packages:
        install(packages)
    checked = run(tmp_path, "plugins")
    assert checked.returncode == 0
    shown = run(tmp_path, "train", "fprf-lite", "--help")
    assert shown.returncode == 0 and "--content.encoder" in shown.stdout
    photo = str(world.references[0])
    styled = run(tmp_path, "stylize", str(world.run), "--references", photo, "--output", str(tmp_path / "styled"))
    assert styled.returncode == 0, styled.stderr
    assert run(tmp_path, "train", "fprf-lite", "--content.encoder", "dies").returncode == 4


class Field(nn.Module):
    """A content field with one thing wrong."""

    def __init__(self, inner: nn.Module, wrong: str) -> None:
        super().__init__()
        self.inner, self.wrong = inner, wrong

    def density(self, points: Tensor) -> FieldSample:
        if self.wrong == "writes":
            points.mul_(2)
        if self.wrong == "raises":
            raise ZeroDivisionError("two\nlines")
        found = self.inner.density(points)
        density = {
            "shape": found.density[:, None],
            "dtype": found.density.double(),
            "device": found.density.to("meta"),
            "nan": found.density * float("nan"),
            "below": found.density - 1e3,
            "type": found.density.tolist(),
        }.get(self.wrong, found.density)
        return FieldSample(density, found.latent)

    def content(self, latent: Tensor, view: Tensor) -> Tensor:
        found = self.inner.content(latent, view)
        return found[:, 1:] if self.wrong == "channels" else found


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ("shape", r"density: expected float32 \[5\] on cpu, found float32 \[5 1\] on cpu"),
        ("dtype", r"density: expected float32 \[5\] on cpu, found float64 \[5\]"),
        ("device", r"density: .*on meta"),
        ("nan", "density: expected finite numbers, found 5 of 5 that are not"),
        ("below", r"density: expected numbers in \[0, inf\], found -"),
        ("type", r"density: expected float32 \[5\] on cpu, found list"),
        ("writes", "density: expected an input that is left alone"),
        ("raises", r"density: expected an answer, found ZeroDivisionError: two;"),
        ("channels", r"content: expected float32 \[5 \d+\] on cpu"),
    ],
)
def test_a_field_that_breaks_its_contract_is_named(world: World, wrong: str, told: str) -> None:
    facts = world.prepared.facts
    parts = build_model(world.config, facts).parts
    check_parts(world.config, parts, facts.channels, facts.dim)
    with pytest.raises(PluginError, match=r"fprf\.fields: 'planes' \(fprf\..*from fprf .*\): " + told) as caught:
        check_parts(world.config, parts._replace(field=Field(parts.field, wrong)), facts.channels, facts.dim)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("part", ["decoder", "semantic", "sampler"])
def test_other_parts_that_break_it_are_named(world: World, part: str) -> None:
    facts = world.prepared.facts
    parts = build_model(world.config, facts).parts
    inner = getattr(parts, part)

    class Wrong(nn.Module):
        def forward(self, first: Tensor, **named: object) -> object:
            found = inner(first, **named)
            return found._replace(t=found.t.flip(1)) if part == "sampler" else found + 5

    broken = parts._replace(**{part: Wrong()})
    if part == "semantic":
        broken = parts._replace(semantic=Only(inner))
    with pytest.raises(PluginError, match={"decoder": "decoders", "semantic": "fields", "sampler": "samplers"}[part]):
        check_parts(world.config, broken, facts.channels, facts.dim)


class Only(nn.Module):
    def __init__(self, inner: nn.Module) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, points: Tensor) -> Tensor:
        return self.inner(points)[:3]


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
        return torch.ones(len(semantic), 1 if self.wrong == "codes" else 4) / (1 if self.wrong == "sum" else 4)


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
