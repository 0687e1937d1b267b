"""Checks of ranges, the sentences of errors, and that every config refuses what lies outside of its ranges by
name.
"""

import copy
import math
import pickle
from collections.abc import Callable
from math import inf, nan
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.restyle import RestyleConfig
from fprf.blocks.config import AdaptiveConfig, BisectConfig, GridConfig
from fprf.checks import at_least, between, positive
from fprf.config import (
    LossConfig,
    OptimizerConfig,
    RenderConfig,
    SemanticConfig,
    StatisticsConfig,
    TrainConfig,
)
from fprf.errors import CheckpointError, ConfigError, FprfError
from fprf.fields.config import PlanesConfig, SemanticPlanesConfig
from fprf.plugins.encoders.config import ConcatConfig, DinoConfig, Dinov2Config, RandomConfig, Vgg19Config
from fprf.plugins.executors.config import RayConfig
from fprf.plugins.samplers.config import ProposalConfig, UniformConfig
from fprf.plugins.stylizers.config import LocalAdainConfig, RegionOtConfig, RegionToneConfig
from fprf.pretraining.config import PretrainDecoderConfig
from fprf.style.config import NO_MASK, StyleConfig
from fprf.training.quality import QualityConfig
from tools.distil.config import DistilConfig

PLANES: dict[str, list[Any]] = {"resolutions": [(), (64, 1)], "channels": [0], "hidden": [0], "layers": [-1]}
OUTSIDE: dict[type, dict[str, list[Any]]] = {
    TrainConfig: {
        "downscale": [0],
        "steps": [-1],
        "seed": [2**31],
        "minutes": [0.0, inf],
        "checkpoint_minutes": [0.0],
    },
    SemanticConfig: {"dim": [0], "samples": [0]},
    LossConfig: {
        "rgb": [-1.0],
        "interlevel": [nan],
        "penalty_every": [0],
        "penalties": [(("a", -1.0),), (("variation", 1.0),)],
    },
    OptimizerConfig: {"rate": [0.0], "final": [1.5], "beta2": [-0.1], "eps": [0.0]},
    RenderConfig: {
        "budget": [0.6],
        "train_budget": [-0.1],
        "chunk": [0],
        "background": [(0.0, 1.5, 0.0), (0.0, nan, 0.0)],
    },
    StatisticsConfig: {"rays": [3], "regions": [0]},
    QualityConfig: {"max_memory": [0.0], "resolution": [0.0, 1.5]},
    PlanesConfig: PLANES | {"degree": [0, 5]},
    SemanticPlanesConfig: PLANES,
    GridConfig: {"cells": [(0, 1)], "size": [0.0], "margin": [0.0, 0.6]},
    BisectConfig: {"count": [0], "margin": [0.0, 0.6]},
    AdaptiveConfig: {"rays": [0], "smallest": [-1.0], "margin": [0.0]},
    UniformConfig: {"samples": [0, -3]},
    ProposalConfig: {
        "final": [0],
        "channels": [0],
        "padding": [0.0, 1.5],
        "anneal_slope": [0.0, nan],
        "anneal_steps": [-1],
        "update_every": [0],
        "warm_up": [-1],
        "samples": [(1, 8), ()],
        "resolutions": [(1, 8)],
    },
    RandomConfig: {"channels": [0], "stride": [0], "seed": [-1]},
    Vgg19Config: {"layer": ["relu0_1", "relu2_3", "relu2_1 ", "relu3_5", "fc7"]},
    DinoConfig: {"layer": [0], "stride": [0]},
    Dinov2Config: {"layer": [0], "stride": [0]},
    ConcatConfig: {"weights": [(0.0,), (1.0, -1.0), (inf,)]},
    LocalAdainConfig: {"temperature": [0.0, nan, inf]},
    RegionOtConfig: {"temperature": [-1.0], "gain": [0.99]},
    RegionToneConfig: {"temperature": [-1.0], "gain": [0.99]},
    RayConfig: {"workers": [0], "processors": [0.0], "retries": [-1], "gpus": [-1.0]},
    DistilConfig: {name: [0] for name in ("minutes", "steps", "batch", "rate", "crops")}
    | {"seed": [-1], "photos": [1], "size": [8]},
    PretrainDecoderConfig: {name: [-1] for name in ("noise", "style", "content")}
    | {"crops": [1], "pairs": [0]},
    StyleConfig: {
        "strength": [1.1],
        "at": [nan],
        "clusters": [0],
        "weights": [(0.0,)],
        "keep_below": [1.5],
        "region_strength": [("3=2",)],
        "pin": [("3",), ("box:1,2=0",)],
        "sun": [(0.0, 0.0), (400.0, 30.0), (0.0, 91.0), "noon"],
        "sun_elevation": [0.0, 91.0],
        "sun_over_sky": [(-1.0, 1.0, 1.0), (1.0, 51.0, 1.0)],
        "sun_strength": [1.5, -0.1],
        "sun_size": [6.0],
        "sun_colour": ["red"],
        "sky_colour": ["800K"],
    },
    RestyleConfig: {"frames": [7], "seeds": [(1, 2)], "blend": [1.1], "palettes": [()], "longest": [8]},
}
ROWS = [
    (kind, name, value)
    for kind, fields in OUTSIDE.items()
    for name, values in fields.items()
    for value in values
]


@pytest.mark.parametrize(("kind", "name", "value"), ROWS)
def test_a_value_outside_of_its_range_is_refused_by_name(kind: type, name: str, value: Any) -> None:
    with pytest.raises(ConfigError) as refused:
        kind(**{name: value})
    assert name in str(refused.value)


def test_fields_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(ConfigError):
        LossConfig(rgb=0.0, content=0.0, semantic=0.0)
    with pytest.raises(ConfigError):
        StyleConfig(references=(Path("a"), Path("b")), masks=(NO_MASK,))


number = st.one_of(st.integers(), st.floats(allow_nan=False, allow_infinity=False))


def passes(check: Callable[[], None]) -> bool:
    try:
        check()
    except ConfigError:
        return False
    return True


@given(number, number, number)
def test_what_passes(value: float, low: float, high: float) -> None:
    assert passes(lambda: positive("x", value)) == (value > 0)
    assert passes(lambda: at_least("x", value, low)) == (value >= low)
    assert passes(lambda: between("x", value, low, high)) == (low <= value <= high)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_a_number_never_passes(value: float) -> None:
    for check in (
        lambda: positive("x", value),
        lambda: at_least("x", value, -1e308),
        lambda: between("x", value, 0, 1e308),
    ):
        assert not passes(check)


@given(st.text())
def test_a_text_is_one_printable_line(text: str) -> None:
    said = str(FprfError(text))
    assert said.isprintable() and (said == text or not text.isprintable())


def test_line_breaks_and_escapes_of_a_terminal_are_spelled_out() -> None:
    assert str(CheckpointError("a\nb\x1b[2J\udcff")) == "a\\nb\\x1b[2J\\udcff"
    assert str(CheckpointError("süß 街道 1 °")) == "süß 街道 1 °"


def test_an_error_survives_the_way_between_processes() -> None:
    error = CheckpointError("a\nb")
    for other in (pickle.loads(pickle.dumps(error)), copy.copy(error)):
        assert type(other) is CheckpointError and str(other) == "a\\nb"
