"""`fprf demo`: the embedded scene from nothing to a gallery. No network, no data."""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..checks import at_least, positive
from ..style.config import StyleConfig
from ..style.files import StyleFile
from .parsing import parse
from .progress import Display
from .render import RenderVerbConfig, camera_path, frames_of
from .train import train_scene

if TYPE_CHECKING:
    from ..engine.loading import Trained
    from ..engine.restyle import Styled
    from ..engine.views import View
    from ..output.images import Picture

__all__ = ["LOOKS", "DemoConfig", "run"]

LOOKS = {"autumn": (3, 9), "winter": (5, 14), "night": (2, 4)}
"""Palette of each reference, with the seed of the other town that it shows and the view of it."""
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

    def __post_init__(self) -> None:
        positive("minutes", self.minutes)
        at_least("frames", self.frames, 2)


def run(args: list[str]) -> int:
    """Everything, in one go; a second run resumes where the first stopped."""
    config = parse(DemoConfig(), args, prog="fprf demo", description="Train, restyle and show the embedded scene.")
    start = time.perf_counter()
    from ..datamanagers.config import RayBatchesConfig
    from ..datamanagers.parsers.config import TownConfig
    from ..datamanagers.parsers.recognise import parse_scene
    from ..engine.loading import load_run
    from ..engine.restyle import apply_style
    from ..evaluation.judge import judge
    from ..methods import fprf_lite
    from ..output.atomic import write_json
    from ..output.video import write_video

    method = fprf_lite()
    manager = method.datamanager
    assert isinstance(manager, RayBatchesConfig)  # this very method, not somebody's
    training = replace(
        method,
        data=Path("town"),
        output=config.output / "run",
        minutes=config.minutes,
        datamanager=replace(manager, parser=TownConfig()),
    )
    root = train_scene(training, "fprf-lite")
    trained = load_run(root)
    scene = parse_scene(training.data, 1, TownConfig())
    references = _references(config.output / "references")
    with Display() as display:
        metrics, renders = judge(trained, scene, trained.known.test, display.count)
        styles, seconds = _styles(trained, references, display)
        film = config.output / "film.mp4"
        tour = camera_path(trained, RenderVerbConfig(frames=config.frames, split="train"))[0]
        mixed = apply_style(trained, StyleFile(StyleConfig(references=tuple(references.values()))))
        write_video(film, frames_of(trained, tour, lambda _: mixed.restyle, display), fps=12)
    metrics = {"method": "fprf-lite", "scene": "town", **metrics, **seconds, "total_seconds": time.perf_counter() - start}
    write_json(config.output / "metrics.json", metrics)
    _show(config.output / "gallery.html", trained, renders, styles, references, metrics, film)
    print(
        f"PSNR {metrics['psnr']:.2f} dB, SSIM {metrics['ssim']:.3f}; a new style in {metrics['dictionary_seconds']:.2f} s "
        f"and {metrics['restyled_seconds_per_view']:.2f} s a view; all in {metrics['total_seconds']:.0f} s\n"
        f"open {config.output / 'gallery.html'}"
    )
    return 0


def _references(folder: Path) -> dict[str, Path]:
    """One picture of another town for each look."""
    from ..output.images import write_image
    from ..town.layout import build_town
    from ..town.palettes import palette
    from ..town.render import render
    from ..town.views import walk

    paths = {}
    for look, (seed, view) in LOOKS.items():
        paths[look] = folder / f"{look}.png"
        if not paths[look].is_file():
            camera = walk(seed=seed, views=20, width=320, height=240)[view]
            write_image(paths[look], render(build_town(seed), camera, palette(look)).rgb)
    return paths


def _styles(
    trained: "Trained", references: dict[str, Path], display: Display
) -> tuple[list[tuple[str, "Styled", list["View"], list["Picture"]]], dict[str, float]]:
    """Each reference alone and all at once, on the test views, with match maps; and what that took."""
    from ..engine.restyle import apply_style
    from ..engine.views import match_view, render_view
    from ..output.maps import match_image

    known, config = trained.known, trained.config.render
    chosen: list[tuple[str, tuple[Path, ...]]] = [(name, (path,)) for name, path in references.items()]
    chosen.append((" + ".join(references), tuple(references.values())))
    views = known.test[:SHOWN]
    result, dictionary_seconds, view_seconds = [], 0.0, 0.0
    for i, (name, paths) in enumerate(chosen):
        display.count(i, len(chosen), "restyling")
        start = time.perf_counter()
        styled = apply_style(trained, StyleFile(StyleConfig(references=paths)))
        built = time.perf_counter()
        pictures = [render_view(trained.model, known.facts, known.cameras, v, config, styled.restyle) for v in views]
        dictionary_seconds += built - start
        view_seconds += time.perf_counter() - built
        maps = []
        for view, picture in zip(views, pictures, strict=True):
            attention = match_view(trained.model, known.cameras, view, config, styled.restyle.stylizer)
            maps.append(match_image(attention, styled.dictionary.reference, styled.dictionary.names, picture.opacity))
        result.append((name, styled, pictures, maps))
    display.count(len(chosen), len(chosen), "restyling")
    return result, {
        "dictionary_seconds": dictionary_seconds / len(chosen),
        "restyled_seconds_per_view": view_seconds / (len(chosen) * max(1, len(views))),
    }


def _show(
    path: Path,
    trained: "Trained",
    renders: list["View"],
    styles: list[tuple[str, "Styled", list["View"], list["Picture"]]],
    references: dict[str, Path],
    metrics: dict[str, Any],
    film: Path,
) -> None:
    from ..datamanagers.images import load_image
    from ..output.gallery import Reference, Style, write_gallery
    from ..output.images import to_uint8
    from ..output.maps import depth_image, depth_limits

    known = trained.known
    count = len(styles[0][2])
    shown = renders[:count]
    limits = depth_limits([v.depth for v in shown], [v.opacity for v in shown])
    by_file = {p.name: name for name, p in references.items()}
    pages: list[Style] = [
        Style(
            name,
            [to_uint8(v.rgb) for v in pictures],
            references=[by_file[n] for n in styled.dictionary.names],
            matches=maps if len(styled.dictionary.names) > 1 else (),
        )
        for name, styled, pictures, maps in styles
    ]
    width, height = (int(v) for v in known.cameras.size[0])
    write_gallery(
        path,
        title="A town in other people's light",
        scene={"scene": "town (embedded)", "views": len(known.names), "size": f"{width} x {height}", "method": "fprf-lite"},
        view_names=[known.names[v] for v in known.test[:count]],
        originals=[to_uint8(v.rgb) for v in shown],
        references=[Reference(name, load_image(p)) for name, p in references.items()],
        styles=pages,
        depth=[depth_image(v.depth, v.opacity, limits) for v in shown],
        metrics={k: v for k, v in metrics.items() if k != "per_view"},
        video=film,
    )
