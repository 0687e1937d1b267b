"""A town that was captured under clouds, lit by suns, against what its own tracer shows of them.

    python -m benchmarks sun [--run RUN] [--steps 10000] [--suns 9] [--views 8] [--output JSON]

RUN are Gaussians of a town in the palette overcast; without one they are trained first, on 60 views of 320 x 240.

The light is given: sun and sky of the palette `day`, at nine places of the sun. Judged are held-out views, but for
the sky, each row after the best factor a channel in linear light over all views, as the first row has it alone.
Shadows are judged where the tracer says that a surface which is no foliage faces the sun.
"""

import math
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fprf.checks import at_least
from fprf.cli.parsing import load_method, parse
from fprf.errors import UsageError
from fprf.io.images import srgb_to_linear
from fprf.light.relight import Received, encoded, gains
from fprf.light.sky import Light
from fprf.ops.rasterise.rendering import Pinhole
from fprf.splats.drawing import draw
from fprf.splats.find_light import find_illumination
from fprf.splats.pinholes import covering
from fprf.splats.relighting import Illumination, relit_harmonics
from fprf.splats.scene import SplatScene
from fprf.training.driver import train
from fprf.training.loading import open_run

from .common import report
from .town.layout import Town, build_town
from .town.palettes import palette
from .town.render import (
    View,
    cast,
    directions,
    geometry,
    is_test,
    normals_at,
    render,
    shadowed,
    sun_direction,
    walk,
)
from .town.shapes import Material
from .town.surface import FOLIAGE, SKY
from .town.truth import town_settings
from .town.write import write_town

_SUNS = tuple((azimuth, elevation) for elevation in (15.0, 30.0, 50.0) for azimuth in (232.0, 60.0, 140.0))
"""Azimuth and elevation in degrees, as palettes have them."""
_MIN_FACING = 0.05
"""Cosine to the sun of surfaces on which shadows are judged."""


@dataclass(frozen=True, kw_only=True)
class SunBenchConfig:
    """A town under clouds, lit."""

    run: Path | None = None
    """Run of Gaussians of a town in the palette overcast; none = one that is trained, and thrown away."""
    steps: int = 10_000
    """Steps that it is trained."""
    pictures: int = 60
    """Views that it is trained on, less every eighth."""
    suns: int = 9
    """Suns of nine: three azimuths at 15 degrees, then at 30 and at 50."""
    views: int = 8
    """Held-out views, at most."""
    output: Path | None = None
    """JSON file for the figures; none = only the table."""

    def __post_init__(self) -> None:
        at_least("steps", self.steps, 1)
        at_least("pictures", self.pictures, 8)
        at_least("suns", self.suns, 1)
        at_least("views", self.views, 1)


class Judged(NamedTuple):
    """Held-out views, pixel after pixel."""

    cameras: Sequence[Pinhole]
    things: Annotated[Tensor, "V P"]
    """Pixels that are judged, bool."""


class _Truth(NamedTuple):
    """What the tracer knows of them."""

    solid: Annotated[Tensor, "V P"]
    """Those of things that are no foliage, bool."""
    points: Annotated[NDArray[np.float64], "V P 3"]
    normals: Annotated[NDArray[np.float32], "V P 3"]


def main(argv: list[str]) -> int:
    """`python -m benchmarks sun`."""
    config = parse(SunBenchConfig(), argv, prog="python -m benchmarks sun", description=__doc__ or "")
    with tempfile.TemporaryDirectory(prefix="fprf-sun-") as made:
        figures = _figures(config, config.run or _trained(config, Path(made)))
    report(config.output, figures)
    return 0


def _trained(config: SunBenchConfig, folder: Path) -> Path:
    """Gaussians of a town under clouds."""
    write_town(folder / "town", seed=0, palette="overcast", views=config.pictures, width=320, height=240)
    method, name = load_method("fprf-splats")
    method = replace(method, data=folder / "town", output=folder / "run", steps=config.steps)
    return train(method, name)


def _figures(config: SunBenchConfig, run: Path) -> dict[str, object]:
    """A row for each sun, and their mean."""
    loaded = open_run(run, device="cpu")
    scene = loaded.scene
    if not isinstance(scene, SplatScene):
        raise UsageError("--run: no run of Gaussians of a town; see python -m benchmarks sun --help")
    settings = town_settings(loaded.run.load_config()[0])
    town = build_town(settings.seed, settings.extra)
    poses = walk(seed=settings.seed, views=settings.views, width=settings.width, height=settings.height)
    begun = time.perf_counter()
    train = torch.tensor([k for k in range(settings.views) if not is_test(k)])
    known = find_illumination(
        scene.gaussians, scene.views.select(train), antialiased=scene.antialiased, near=scene.near
    )
    found = time.perf_counter() - begun
    held_out = [k for k in range(settings.views) if is_test(k)][: config.views]
    views = [poses[k] for k in held_out]
    things, known_truth = _traced(town, views)
    judged = Judged([covering(scene.views, k, scene.near) for k in held_out], things)
    rows = []
    for azimuth, elevation in _SUNS[: config.suns]:
        look = replace(palette("day"), azimuth=azimuth, elevation=elevation)
        truth = torch.stack([pixels(render(town, view, look).rgb) for view in views])
        sun = torch.from_numpy(sun_direction(look)).float()
        light = Light(
            torch.tensor(look.sun), torch.tensor(look.ambient), torch.ones(3), torch.ones(3), 1.0, elevation
        )
        row = light_rows(scene, known, judged, light, sun, truth)
        iou = _shadow_iou(scene, known.reach(sun), judged.cameras, known_truth, town, sun)
        rows.append({"azimuth": azimuth, "elevation": elevation} | row | {"iou": iou})
        print("  ".join(f"{name} {value:.2f}" for name, value in rows[-1].items()), flush=True)
    return {
        "gaussians": len(scene.gaussians),
        "views": len(views),
        "found_seconds": round(found, 2),
        "suns": rows,
        "mean": {name: float(np.mean([row[name] for row in rows])) for name in rows[0]},
    }


def _traced(town: Town, views: Sequence[View]) -> tuple[Annotated[Tensor, "V P"], _Truth]:
    """Pixels that show things, and what the tracer knows of all."""
    things = []
    solid = []
    points = []
    normals = []
    for view in views:
        ray = directions(view, 1)
        hits = cast(town, view, ray, 1)
        face = hits.face.ravel()
        there = np.where(np.isfinite(hits.distance.ravel()), hits.distance.ravel(), 0.0)
        at = view.pose[:, 3] + there[:, None] * np.stack(ray, -1).reshape(-1, 3)
        normal = np.zeros((len(face), 3), np.float32)
        normal[face >= 0] = normals_at(town, face[face >= 0], at[face >= 0])
        label = geometry(town, view)[1].ravel()
        things.append(torch.from_numpy(label != SKY))
        solid.append(torch.from_numpy((label != SKY) & (label != FOLIAGE)))
        points.append(at)
        normals.append(normal)
    return torch.stack(things), _Truth(torch.stack(solid), np.stack(points), np.stack(normals))


def pixels(picture: NDArray[np.uint8]) -> Annotated[Tensor, "P 3"]:
    return torch.from_numpy(picture).flatten(0, 1).float() / 255


def light_rows(
    scene: SplatScene,
    known: Illumination,
    judged: Judged,
    light: Light,
    sun: Annotated[Tensor, "3"],
    truth: Annotated[Tensor, "V P 3"],
) -> dict[str, float]:
    """PSNR of things by what is heeded of the light, and seconds that the sun takes."""
    begun = time.perf_counter()
    reach = known.reach(sun)
    seconds = time.perf_counter() - begun
    ones = torch.ones_like(reach)
    surfaces = known.surfaces
    gaussians = scene.gaussians
    received = {
        "cosine": Received(surfaces.normals, surfaces.sure, ones, ones),
        "shadows": Received(surfaces.normals, surfaces.sure, ones, reach),
        "all": Received(surfaces.normals, surfaces.sure, known.openness, reach),
    }
    shown = {"gain": drawn_views(scene, gaussians.harmonics, judged.cameras)}
    for name, each in received.items():
        gain = gains(each, light, sun, known.up, gaussians.colours, surfaces.weights)
        shown[name] = drawn_views(scene, relit_harmonics(gaussians.harmonics, gain), judged.cameras)
    found = {"plain": psnr(shown["gain"], truth, judged.things)}
    for name, pictures in shown.items():
        found[name] = psnr(with_best_gain(pictures, truth, judged.things), truth, judged.things)
    found["seconds"] = seconds
    return found


def drawn_views(
    scene: SplatScene, harmonics: Tensor, cameras: Sequence[Pinhole]
) -> Annotated[Tensor, "V P 3"]:
    lit = scene.gaussians.recoloured(harmonics)
    pictures = []
    for camera in cameras:
        pictures.append(draw(lit, camera, antialiased=scene.antialiased).image.flatten(0, 1).clamp(0, 1))
    return torch.stack(pictures)


def psnr(pictures: Tensor, truth: Tensor, where: Tensor) -> float:
    return -10 * math.log10(float((pictures - truth)[where].square().mean()))


def with_best_gain(pictures: Tensor, truth: Tensor, where: Tensor) -> Tensor:
    """Pictures after the factor of each channel's linear light that brings them nearest to the truth."""
    some = where.flatten().nonzero()[::9, 0]
    out = []
    for channel in range(3):
        light = srgb_to_linear(pictures[..., channel])
        asked = light.flatten()[some]
        wanted = truth[..., channel].flatten()[some]
        best = 0.0
        for step in (0.5, 0.1, 0.02):
            tried = [best + step * k for k in range(-6, 7)]
            errors = [
                float((encoded(asked * 2**each).clamp(0, 1) - wanted).square().mean()) for each in tried
            ]
            best = tried[int(np.argmin(errors))]
        out.append(encoded(light * 2**best).clamp(0, 1))
    return torch.stack(out, -1)


def _shadow_iou(
    scene: SplatScene, reach: Tensor, cameras: Sequence[Pinhole], truth: _Truth, town: Town, sun: Tensor
) -> float:
    """Intersection over union of the shadows that are cast on what faces the sun."""
    leafy = np.array([town.faces.material[k] == Material.FOLIAGE for k in town.first])
    both = 0
    either = 0
    for view, camera in enumerate(cameras):
        facing = truth.normals[view] @ sun.numpy() > _MIN_FACING
        at = np.flatnonzero(facing & truth.solid[view].numpy())
        solid, leaves = shadowed(town, truth.points[view][at], sun.double().numpy(), leafy)
        true = torch.from_numpy(solid | leaves)
        drawn = draw(scene.gaussians, camera, antialiased=scene.antialiased, features=reach[:, None])
        shown = (drawn.features[..., 0] / drawn.opacity.clamp_min(1e-4)).flatten()[torch.from_numpy(at)] < 0.5
        both += int((true & shown).sum())
        either += int((true | shown).sum())
    return both / max(1, either)
