"""The plan of a training: size of the photographs and number of Gaussians, from minutes, machine and
photographs.
"""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import fprf.splats.plan as module
from fprf.cli.main import main
from fprf.splats.config import GaussiansConfig

CONFIG = GaussiansConfig(k1=0.0)


@pytest.fixture(autouse=True)
def steady(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine as fast as the one of the constants."""
    monkeypatch.setattr(module, "machine_speed", lambda: 1.0)


def planned(
    config: GaussiansConfig, width: int = 2832, height: int = 2128, views: int = 30
) -> GaussiansConfig:
    size = torch.tensor([[width, height]] * views)
    scene = SimpleNamespace(cameras=SimpleNamespace(size=size), train=torch.arange(views))
    return module.plan(config, scene, torch.device("cpu"))  # type: ignore[arg-type]


@given(
    st.floats(0.2, 60), st.floats(1.1, 8), st.integers(300, 6000), st.integers(300, 6000), st.integers(1, 600)
)
def test_more_time_never_plans_less(minutes: float, more: float, width: int, height: int, views: int) -> None:
    short, long = (
        planned(replace(CONFIG, minutes=each), width, height, views) for each in (minutes, more * minutes)
    )
    assert short.downscale is not None and long.downscale is not None
    assert long.downscale <= short.downscale and long.most >= short.most
    for each in (short, long):
        assert round(max(width, height) / (each.downscale or 1), 6) <= CONFIG.longest
        assert each.most * CONFIG.pixels_per_gaussian <= max(
            views * width * height / (each.downscale or 1) ** 2, 20
        )


@pytest.mark.parametrize(("minutes", "size"), [(0.5, 3), (1, 1.77), (3, 1.77), (10, 1.77)])
def test_a_dozen_large_photographs(minutes: float, size: float) -> None:
    """A minute is enough for 1600 pixels, half a minute is not."""
    assert planned(replace(CONFIG, minutes=minutes), views=11).downscale == size


def test_what_is_given_stays() -> None:
    given = replace(CONFIG, minutes=1, downscale=7, cap=12_345, passes=9, steps=77)
    assert planned(given) == given
    long = replace(CONFIG, minutes=60)
    assert planned(replace(long, steps=10_000)).most_steps == 10_000 < planned(long).most_steps
    assert planned(replace(CONFIG, minutes=60, longest=800)).downscale == 3.54
    without = planned(replace(CONFIG, steps=100))
    assert without.downscale == 1.77 and without.most == 60_000 and without.limited(30) == 100


def test_views_are_judged_at_the_size_of_the_photographs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whatever size they were trained at; `--size` says another."""
    run = tmp_path / "run"
    assert main(["train", "--data", "garden", "--downscale", "4", "--steps", "30", "--output", str(run)]) == 0
    found = {}
    for flags in ((), ("--size", "158")):
        assert main(["eval", str(run), "--images", "false", *flags]) == 0
        found[flags] = json.loads((run / "metrics.json").read_text())
    assert [found[flags]["size"] for flags in found] == ["356x634", "89x158"]
    assert all(each["trained_size"] == "89x158" for each in found.values())
    assert found[()]["psnr"] != found["--size", "158"]["psnr"]
    assert "plan: 21 views at 89x158 (1/4" in capsys.readouterr().err
