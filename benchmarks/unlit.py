"""Towns that were captured in the sun, whose light is taken away, against their own tracer's clouds.

    python -m benchmarks unlit [--towns 3] [--first 0] [--steps 6000] [--views 8] [--output JSON]

Each town is trained in the palette `day`; the truth are its held-out views in the palette `overcast`. Judged is all but
the sky, as it is and after the best factor a channel in linear light over all views: as captured, with `--unlit true`,
and with `--unlit true --light overcast`. The sun is the one that the search finds.
"""

import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fprf.checks import at_least
from fprf.cli.parsing import load_method, parse
from fprf.errors import UsageError
from fprf.light.config import SunConfig
from fprf.splats.find_light import find_illumination
from fprf.splats.pinholes import covering
from fprf.splats.relighting import relit_harmonics
from fprf.splats.scene import SplatScene
from fprf.training.driver import train
from fprf.training.loading import open_run

from .common import report
from .sun import drawn_views, pixels, psnr, with_best_gain
from .town.layout import build_town
from .town.palettes import palette
from .town.render import geometry, is_test, render, sun_direction, walk
from .town.surface import SKY
from .town.write import write_town

_SIZE = (320, 240)
_PICTURES = 60
"""Views of a town."""


@dataclass(frozen=True, kw_only=True)
class UnlitConfig:
    """Towns in the sun, unlit."""

    towns: int = 3
    """Towns that are trained, and thrown away."""
    first: int = 0
    """Seed of the first town; each of the others has the next."""
    steps: int = 6000
    """Steps that each is trained."""
    views: int = 8
    """Held-out views of each, at most."""
    output: Path | None = None
    """JSON file for the figures; none = only the table."""

    def __post_init__(self) -> None:
        at_least("towns", self.towns, 1)
        at_least("steps", self.steps, 1)
        at_least("views", self.views, 1)


def main(argv: list[str]) -> int:
    """`python -m benchmarks unlit`."""
    config = parse(UnlitConfig(), argv, prog="python -m benchmarks unlit", description=__doc__ or "")
    rows = []
    for seed in range(config.first, config.first + config.towns):
        with tempfile.TemporaryDirectory(prefix="fprf-unlit-") as made:
            rows.append(_row(config, seed, Path(made)))
        print(rows[-1], flush=True)
    mean: dict[str, dict[str, float]] = {}
    for name in ("captured", "unlit", "unlit, clouds"):
        mean[name] = {}
        for kind in ("plain", "gain"):
            mean[name][kind] = float(np.mean([row[name][kind] for row in rows]))
    nearer = {kind: mean["unlit, clouds"][kind] - mean["captured"][kind] for kind in ("plain", "gain")}
    print({"mean": mean, "nearer": nearer})
    report(config.output, {"towns": rows, "mean": mean, "nearer": nearer})
    return 0


def _row(config: UnlitConfig, seed: int, folder: Path) -> dict[str, Any]:
    """PSNR in dB of a town's held-out views, and degrees between the sun that was found and the true one."""
    width, height = _SIZE
    write_town(folder / "town", seed=seed, palette="day", views=_PICTURES, width=width, height=height)
    method, name = load_method("fprf-splats")
    method = replace(method, data=folder / "town", output=folder / "run", steps=config.steps)
    scene = open_run(train(method, name), device="cpu").scene
    if not isinstance(scene, SplatScene):
        raise UsageError("fprf-splats makes no Gaussians")
    poses = walk(seed=seed, views=_PICTURES, width=width, height=height)
    shown = torch.tensor([k for k in range(_PICTURES) if not is_test(k)])
    known = find_illumination(
        scene.gaussians, scene.views.select(shown), antialiased=scene.antialiased, near=scene.near
    )
    held_out = [k for k in range(_PICTURES) if is_test(k)][: config.views]
    town = build_town(seed)
    truth = torch.stack([pixels(render(town, poses[k], palette("overcast")).rgb) for k in held_out])
    things = torch.stack([torch.from_numpy(geometry(town, poses[k])[1].ravel() != SKY) for k in held_out])
    cameras = [covering(scene.views, k, scene.near) for k in held_out]
    row: dict[str, Any] = {"seed": seed, "degrees_off": None}
    if known.captured_sun is not None:
        found = known.sun_direction(known.captured_sun.azimuth, known.captured_sun.elevation)
        cosine = float(found @ torch.from_numpy(sun_direction(palette("day"))).float())
        row["degrees_off"] = round(math.degrees(math.acos(min(1.0, cosine))), 1)
    lights = {
        "captured": None,
        "unlit": SunConfig(unlit=True),
        "unlit, clouds": SunConfig(unlit=True, light="overcast"),
    }
    for name, light in lights.items():
        harmonics = scene.gaussians.harmonics
        if light is not None:
            harmonics = relit_harmonics(harmonics, known.gain(light))
        pictures = drawn_views(scene, harmonics, cameras)
        row[name] = {
            "plain": psnr(pictures, truth, things),
            "gain": psnr(with_best_gain(pictures, truth, things), truth, things),
        }
    return row
