"""`fprf demo`: a garden from photographs to a page that shows it restyled. No network, no data."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING

from ..checks import at_least, positive
from ..progress import Display
from ..style.config import StyleConfig
from ..style.files import StyleFile
from .parsing import parse
from .showcase import photographs_of, restyled, write_shown

if TYPE_CHECKING:
    from ..interfaces import Scene
    from ..io.images import Picture
    from ..rendering.cameras import Cameras

TITLE = "One garden, photographed once"
LEAD = (
    "Trained on a CPU from 25 photographs. Each look is then taken from one picture, without training, and is the same "
    "from every viewpoint."
)
LOOKS = ("winter", "night", "sunset", "autumn")
"""References, in the order in which they are shown."""
CREDITS = (
    "Photographs of the garden: The SfM Tool Authors (sfmtool/sfmtool, test-data), Apache-2.0; reduced and re-encoded.",
    "Autumn and sunset: Aitzol Berasategi, CC BY 4.0; reduced. Winter and night: pictures of fprf's own towns.",
)
_NICE = 10
"""Added to the niceness of the process that compiles beside training."""
FADE = 5
"""Frames in which the film goes over to the next style."""


@dataclass(frozen=True, kw_only=True)
class DemoConfig:
    """A garden in Seattle: train, measure, restyle, film, and one page that shows it."""

    output: Path = Path("demo")
    """Folder for everything that the demo makes."""
    minutes: float = 1.2
    """Training time."""
    frames: int = 60
    """Frames of the film, about."""
    downscale: int = 1
    """The photographs, 356x634, are reduced by this factor."""

    megabytes: float = 4.0
    """Size of the page, at most; Gaussians that show least are left out of it."""

    def __post_init__(self) -> None:
        positive("minutes", self.minutes)
        positive("megabytes", self.megabytes)
        at_least("frames", self.frames, 2)
        at_least("downscale", self.downscale, 1)


def run(args: list[str]) -> int:
    """Train the garden, or resume, then measure, restyle, film, export and write the page."""
    config = parse(DemoConfig(), args, prog="fprf demo", description="Train, restyle and show a garden that ships with fprf.")
    start = time.perf_counter()
    from ..io.atomic import write_json
    from ..io.video import write_video
    from ..methods import fprf_splats
    from ..rendering.paths import make_path
    from ..splats.files import write_gaussians
    from ..splats.loading import open_gaussians
    from ..training.driver import train
    from ..training.quality import QualityConfig
    from ..training.run import Run
    from .eval import EvalConfig, evaluate

    garden = Path(str(files("fprf") / "garden"))
    output = config.output / "run"
    training = replace(fprf_splats(), data=garden, downscale=config.downscale, output=output, minutes=config.minutes)
    with compiling():  # waited for at the end
        root = train(training, "fprf-splats")
        metrics = evaluate(EvalConfig(run=root, images=False))
    opened = open_gaussians(Run(root), training, "cpu", QualityConfig())
    scene, views = opened.scene, opened.known.test
    references = {name: garden / "references" / f"{name}.jpg" for name in LOOKS}
    with Display() as display:
        chosen = [(name, (path,)) for name, path in references.items()] + [("all together", tuple(references.values()))]
        begun = time.perf_counter()
        scene.measured()
        looked = time.perf_counter() - begun
        styles = restyled(scene, [(n, StyleFile(StyleConfig(references=p))) for n, p in chosen], views, display)
        looks = [scene.restyled(style.styled.restyle) for style in styles]
        for style, look in zip(styles, looks, strict=True):
            # For viewers that do not compensate opacities; these depend on no colour, so that the views are looked at once.
            plain = scene.seen.plain(look.shown)
            write_gaussians(config.output / f"{style.name.replace(' ', '-')}.ply", plain, origin=scene.origin)
        # From one held-out view to the next, where other views surround the camera.
        tour = make_path(opened.known.cameras, views, "interpolate", config.frames, scene.origin)
        frames = list(fading([scene, *looks[: len(references)]], tour, display))
    film = config.output / "film.mp4"
    if write_video(film, frames, fps=12) == "mp4v":  # browsers do not play that
        film = film.with_suffix(".webp")
        write_video(film, frames, fps=12)
    metrics |= {
        "looked_seconds": looked,
        "new_style_seconds": fmean(style.metrics["new_style_seconds"] for style in styles[: len(references)]),
        "restyled_seconds_per_view": fmean(style.metrics["each_view_seconds"] for style in styles),
        "total_seconds": time.perf_counter() - start,
    }
    write_json(config.output / "metrics.json", metrics)
    width, height = (int(v) for v in scene.cameras.size[0])
    page = config.output / "garden.html"
    write_shown(
        page,
        scene,
        title=TITLE,
        lead=LEAD,
        facts={
            "Photographs": len(scene.names),
            "Size": f"{width} × {height}",
            "3D Gaussians": len(scene.gaussians),
            "Trained for": f"{opened.seconds:.0f} s",
            "Unseen views": f"{metrics['psnr']:.1f} dB",
            "A new style": f"{metrics['new_style_seconds']:.1f} s",
        },
        views=views,
        originals=[scene.render(scene.cameras, view) for view in views],
        photographs=photographs_of(opened.run, opened.known, views),
        shown=styles,
        references=references,
        metrics={name: value for name, value in metrics.items() if name != "per_view"},
        film=film,
        credits=CREDITS,
        megabytes=config.megabytes,
    )
    print(
        f"PSNR {metrics['psnr']:.2f} dB, SSIM {metrics['ssim']:.3f}; a new style in {metrics['new_style_seconds']:.2f} s "
        f"and {metrics['restyled_seconds_per_view']:.2f} s a view; all in {metrics['total_seconds']:.0f} s\n"
        f"open {page}; {config.output}/*.ply open in any viewer of Gaussians"
    )
    return 0


@contextlib.contextmanager
def compiling() -> Iterator[None]:
    """Compile what restyling needs in a process of low priority, where that was not done before: it takes 12 s of a core.

    At the end it is waited for.
    """
    from ..ops import mixture_kernels

    if any(Path(str(mixture_kernels.scaled.stats.cache_path)).glob("mixture_kernels.scaled*.nbi")):
        yield
        return
    quiet = subprocess.DEVNULL
    with subprocess.Popen([sys.executable, "-m", __name__], stdin=quiet, stdout=quiet, stderr=quiet):
        yield


def _compile() -> None:
    import torch

    from ..ops.mixture import scaled

    if hasattr(os, "nice"):
        os.nice(_NICE)
    point = torch.zeros(1, 3)
    with torch.inference_mode():
        scaled(point, torch.ones(1, 1), point, point, centre=point[0])


def fading(looks: "Sequence[Scene]", cameras: "Cameras", display: Display) -> "Iterator[Picture]":
    """Frames of a flight: every look for an equal share of them, each fading into the next.

    Pictures fade, as their colours would: what is drawn is linear in these.
    """
    from ..io.images import to_uint8

    share = len(cameras) / len(looks)
    for frame in range(len(cameras)):
        display.count(frame, len(cameras), "rendering")
        place = min(int(frame / share), len(looks) - 1)
        into = (frame - (place + 1) * share) / FADE + 1
        rgb = looks[place].render(cameras, frame).rgb
        if into > 0 and place + 1 < len(looks):
            rgb = rgb.lerp(looks[place + 1].render(cameras, frame).rgb, into)
        yield to_uint8(rgb)
    display.count(len(cameras), len(cameras), "rendering")


if __name__ == "__main__":
    _compile()
