"""Photographs to styles of a run: every field of a style changes what is rendered, mistakes are told."""

from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tiny_world import World
from two_sided import region_adain

from fprf.errors import ConfigError
from fprf.plugins.stylizers.config import AdainConfig
from fprf.style.config import NO_MASK, StyleConfig
from fprf.style.dictionary import Encoders
from fprf.style.files import StyleFile, write_style
from fprf.style.restyle import apply_style
from fprf.training.loading import Trained
from fprf.training.views import render_view

SECOND: dict[str, object] = {
    "weights": (5.0, 1.0),
    "clusters": 1,
    "blend": 0.9,
    "strength": 0.5,
    "luminance": 1.0,
    "bold": 1.0,
    "pin": ("0=1",),
    "forbid": ("0=0",),
    "keep": ("0",),
    "region_strength": ("0=0.5",),
    "keep_below": 0.99,
    "stylizer": region_adain(),
}
"""Those of `references`, `masks`, `between` and `at` need files: see below."""


class Bench:
    """A run in memory, and pictures of its first view."""

    def __init__(self, world: World) -> None:
        self.trained: Trained = world.load()
        self.encoders: Encoders = self.trained.encoders()
        self.base = StyleConfig(references=world.references, clusters=3)
        self.plain = self.show(None)
        self.first = self.show(self.base)

    def show(self, style: StyleConfig | None) -> torch.Tensor:
        known, config = self.trained.known, self.trained.config.render
        look = None if style is None else apply_style(self.trained, StyleFile(style), self.encoders).restyle
        return render_view(self.trained.model, known.facts, known.cameras, 0, config, look).rgb


@pytest.fixture(scope="module")
def bench(_world: World) -> Bench:
    return Bench(_world)


def test_every_field_has_a_second_value() -> None:
    assert {field.name for field in fields(StyleConfig)} == {*SECOND, "references", "masks", "between", "at"}


@pytest.mark.parametrize("name", SECOND)
def test_a_second_value_changes_the_picture(bench: Bench, name: str) -> None:
    second = bench.show(replace(bench.base, **{name: SECOND[name]}))  # type: ignore[arg-type]
    assert bool(second.isfinite().all()) and float((second - bench.first).abs().max()) > 1e-4


def test_references_and_masks_change_the_picture(bench: Bench, tmp_path: Path) -> None:
    mask = np.zeros((40, 56), np.uint8)
    mask[20:] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    assert not torch.allclose(bench.show(replace(bench.base, references=bench.base.references[:1])), bench.first, atol=1e-4)
    masked = bench.show(replace(bench.base, masks=(tmp_path / "mask.png", NO_MASK)))
    assert not torch.allclose(masked, bench.first, atol=1e-4)
    assert torch.equal(bench.show(replace(bench.base, masks=(NO_MASK, NO_MASK))), bench.first)


def test_between_two_styles(bench: Bench, tmp_path: Path) -> None:
    other = replace(bench.base, references=bench.base.references[:1], stylizer=AdainConfig(), luminance=0.5)
    write_style(tmp_path / "other.json", StyleFile(other))
    mixes = [bench.show(replace(bench.base, between=tmp_path / "other.json", at=at)) for at in (0.0, 0.3, 0.7, 1.0)]
    end = bench.show(other)
    assert torch.equal(mixes[0], bench.first) and torch.equal(mixes[3], end)
    away = [float((mix - bench.first).abs().mean()) for mix in mixes]
    assert away == sorted(away) and away[1] > 0
    assert float((mixes[2] - end).abs().mean()) < float((mixes[1] - end).abs().mean())


def test_styles_that_lead_back_to_themselves_are_refused(bench: Bench, tmp_path: Path) -> None:
    a, b = tmp_path / "a.json", tmp_path / "b.json"
    b.write_text("{}")
    for path, towards in ((a, b), (b, a)):
        write_style(path, StyleFile(replace(bench.base, between=towards)))
    with pytest.raises(ConfigError, match=r"a\.json: lies between styles that lead back to it"):
        bench.show(replace(bench.base, between=a))


def test_the_order_of_references_does_not_matter_to_wishes(bench: Bench) -> None:
    a, b = bench.base.references
    one = replace(bench.base, pin=("0=snow.png",), forbid=("1=0",), weights=(2.0, 1.0))
    two = replace(bench.base, references=(b, a), pin=("0=0",), forbid=("1=dusk",), weights=(1.0, 2.0))
    assert torch.equal(bench.show(one), bench.show(two))
