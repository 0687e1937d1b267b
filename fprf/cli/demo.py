"""`fprf demo`: the embedded scene from nothing to a gallery. No network, no data."""

import time
from dataclasses import dataclass, replace
from pathlib import Path

from ..checks import at_least, positive
from ..style.config import StyleConfig
from ..style.files import StyleFile
from .parsing import parse
from .progress import Display
from .render import RenderVerbConfig, camera_path, frames_of
from .showcase import restyled, write_page
from .train import train_scene

__all__ = ["LOOKS", "DemoConfig", "run"]

LOOKS = {"autumn": (3, 9), "winter": (5, 14), "night": (2, 4)}
"""Palette of each reference, with the seed of the other town that it shows and the view of it."""
PLANES, VARIATION = (32, 64, 128, 256), 2e-3
"""A minute of steps does not fill finer planes, and needs smoother ones."""
SHOWN = 3
"""Test views in the gallery: a row of it."""


@dataclass(frozen=True, kw_only=True)
class DemoConfig:
    """The embedded scene: train, measure, restyle, film, and one page that shows it."""

    output: Path = Path("demo")
    """Folder for everything that the demo makes."""
    minutes: float = 1.25
    """Training time."""
    frames: int = 36
    """Frames of the film."""
    device: str = "auto"
    """cpu, cuda, mps, or auto."""

    def __post_init__(self) -> None:
        positive("minutes", self.minutes)
        at_least("frames", self.frames, 2)


def run(args: list[str]) -> int:
    """Everything, in one go; a second run resumes where the first stopped."""
    config = parse(DemoConfig(), args, prog="fprf demo", description="Train, restyle and show the embedded scene.")
    start = time.perf_counter()
    from ..datamanagers.config import RayBatchesConfig
    from ..datamanagers.parsers.config import TownConfig, parse_scene
    from ..evaluation.evaluate import judge
    from ..fields.config import PlanesConfig
    from ..io.atomic import write_json
    from ..io.video import write_video
    from ..methods import fprf_lite
    from ..training.loading import load_run

    method = fprf_lite()
    manager, field = method.datamanager, method.content.field
    assert isinstance(manager, RayBatchesConfig) and isinstance(field, PlanesConfig)  # this very method, not somebody's
    data = Path("town")
    training = replace(
        method,
        data=data,
        downscale=1,
        output=config.output / "run",
        minutes=config.minutes,
        device=config.device,
        datamanager=replace(manager, parser=TownConfig()),
        content=replace(method.content, field=replace(field, resolutions=PLANES)),
        loss=replace(method.loss, variation=VARIATION),
    )
    root = train_scene(training, "fprf-lite")
    trained = load_run(root, config.device)
    scene = parse_scene(data, 1, TownConfig())
    references = _references(config.output / "references")
    with Display() as display:
        metrics, renders = judge(trained, scene, trained.known.test, display.count)
        chosen = [(name, (path,)) for name, path in references.items()] + [(" + ".join(references), tuple(references.values()))]
        views = trained.known.test[:SHOWN]
        styles = restyled(trained, [(n, StyleFile(StyleConfig(references=p))) for n, p in chosen], views, display)
        film = config.output / "film.mp4"
        tour = camera_path(trained.known, RenderVerbConfig(frames=config.frames, split="train"))[0]
        write_video(film, frames_of(trained, tour, lambda _: styles[-1].styled.restyle, display), fps=12)
    seconds = {
        "dictionary_seconds": sum(style.dictionary_seconds for style in styles) / len(styles),
        "restyled_seconds_per_view": sum(style.view_seconds for style in styles) / (len(styles) * max(1, len(views))),
    }
    metrics = {"method": "fprf-lite", "scene": "town", **metrics, **seconds, "total_seconds": time.perf_counter() - start}
    write_json(config.output / "metrics.json", metrics)
    width, height = (int(v) for v in trained.known.cameras.size[0])
    write_page(
        config.output / "gallery.html",
        trained,
        title="A town in other people's light",
        facts={
            "scene": "town (embedded)",
            "views": len(trained.known.names),
            "size": f"{width} x {height}",
            "method": "fprf-lite",
        },
        views=views,
        originals=renders[: len(views)],
        shown=styles,
        references=references,
        metrics={name: value for name, value in metrics.items() if name != "per_view"},
        film=film,
    )
    print(
        f"PSNR {metrics['psnr']:.2f} dB, SSIM {metrics['ssim']:.3f}; a new style in {metrics['dictionary_seconds']:.2f} s "
        f"and {metrics['restyled_seconds_per_view']:.2f} s a view; all in {metrics['total_seconds']:.0f} s\n"
        f"open {config.output / 'gallery.html'}"
    )
    return 0


def _references(folder: Path) -> dict[str, Path]:
    """One picture of another town for each look."""
    from ..io.images import write_image
    from ..town.layout import build_town
    from ..town.palettes import palette
    from ..town.render import render, walk

    paths = {}
    for look, (seed, view) in LOOKS.items():
        paths[look] = folder / f"{look}.png"
        if not paths[look].is_file():
            camera = walk(seed=seed, views=20, width=320, height=240)[view]
            write_image(paths[look], render(build_town(seed), camera, palette(look)).rgb)
    return paths
