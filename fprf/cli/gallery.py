"""`fprf gallery RUN --references DIR`: a run in every style, as one page that needs nothing else."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any, Literal

from ..checks import at_least, positive
from ..errors import FprfError, UsageError
from ..progress import Display
from ..style.config import StyleConfig
from ..style.files import StyleFile, check_photographs, read_style
from ..training.quality import QualityConfig
from .style_flags import read_flags

if TYPE_CHECKING:
    from ..interfaces import Scene
    from ..io.images import Picture
    from ..page.writer import PageView, Style
    from ..rendering.cameras import Cameras
    from ..style.dictionary import Reference
    from ..training.loading import LoadedRun

_REDUCED = 4.0
"""Factor by which views are reduced whose matches are only counted, not shown."""
_FADE = 5
"""Frames in which a film goes over to the next look."""

_DESCRIPTION = """A run in every style, as one page to walk through, with match maps, depth and figures. It loads nothing.

Each reference is a style of its own; with several of them all together are one more."""


@dataclass(frozen=True, kw_only=True)
class GalleryConfig(StyleConfig, QualityConfig):
    """Views and styles of the page."""

    run: Path = Path()
    """Run folder."""
    styles: tuple[Path, ...] = ()
    """Style files (style.json), each one more style."""
    together: bool = True
    """Also show all photographs as one style."""
    split: Literal["some", "test", "train", "all"] = "some"
    """Views to choose from. some: at most 8 training views, spread evenly; test: those held out from training."""
    most: int = 6
    """Views that are shown, evenly taken from the split."""
    views: tuple[str, ...] = ()
    """Views to show by name, instead."""
    frames: int = 0
    """Frames of a flight through the last style; 0 = none."""
    path: str = "interpolate"
    """Path of the flight: spiral, orbit, interpolate, or a camera-path file."""
    title: str = ""
    """Headline; empty = the scene's name."""
    megabytes: float = 16.0
    """Size of the page, at most; Gaussians that show least are left out of it."""
    output: Path | None = None
    """The page; by default RUN/gallery.html."""
    device: str = "auto"
    """cpu, cuda, mps, or auto."""

    def __post_init__(self) -> None:
        StyleConfig.__post_init__(self)
        QualityConfig.__post_init__(self)
        at_least("most", self.most, 1)
        at_least("frames", self.frames, 0)
        positive("megabytes", self.megabytes)


def run(args: list[str]) -> int:
    """Render the views in every style, film, write the page."""
    config, file = read_flags(GalleryConfig(), args, prog="fprf gallery", description=_DESCRIPTION, positional=("run",))
    output = config.output if config.output is not None else config.run / "gallery.html"
    if output.suffix.lower() != ".html":
        raise UsageError(f"--output {output}: the page is an .html file; give such a name")
    from ..datamanagers.images import load_image
    from ..io.video import write_video
    from ..page.writer import Page, Reference, write_page
    from ..plugins.codec import read_json
    from ..rendering.paths import make_path
    from ..splats.scene import SplatScene
    from ..training.loading import open_run

    opened = open_run(config.run, config.device, config)
    known, scene = opened.known, opened.scene
    views = known.views(config.split, config.views)
    # Evenly from the split; views that are named are all shown.
    most = len(views) if config.views else min(config.most, len(views))
    views = [views[k * len(views) // most] for k in range(most)]
    chosen = _chosen(config, file)
    called = _called([*config.references, *(path for _, each in chosen for path in each.style.references)])
    film = None
    with Display() as display:
        originals = page_views(opened, views, display)
        styles = page_styles(scene, chosen, views, called, display)
        if config.frames:
            film = output.with_suffix(".mp4")
            flight = make_path(known.cameras, known.split("all"), config.path, config.frames, scene.origin)
            write_video(film, fading([styles[-1][1]], flight, display), fps=24)
    # Figures of `fprf eval`, where it has run, without those of single views.
    measured: Any = {}
    if (path := config.run / "metrics.json").is_file():
        measured = read_json(path, "the metrics.json of `fprf eval`")
    figures = measured if isinstance(measured, dict) else {}
    width, height = known.cameras.size[views[0]].tolist()
    page = Page(
        title=config.title or known.name,
        facts={
            "Photographs": len(known.names),
            "Size": f"{width} × {height}",
            "Method": opened.method,
            "Styles": len(styles),
            "Trained for": f"{opened.seconds / 60:.1f} min",
        },
        views=originals,
        styles=[style for style, _ in styles],
        references=[Reference(name, load_image(path, upright=True)) for path, name in called.items()],
        scene=scene if isinstance(scene, SplatScene) else None,
        start=views[0],
        metrics={name: value for name, value in figures.items() if name not in ("per_view", "method", "scene")},
        film=film,
    )
    write_page(output, page, megabytes=config.megabytes)
    print(f"{len(views)} views in {len(styles)} styles: {output} ({output.stat().st_size / 2**20:.1f} MiB)")
    return 0


def _chosen(config: GalleryConfig, together: StyleFile) -> list[tuple[str, StyleFile]]:
    """The styles with their names. Raises UsageError where there are none."""
    names = _called(config.references)
    # What names photographs one by one does not hold where each is alone.
    alone = replace(together.style, weights=(), masks=(), pin=(), forbid=())
    chosen = [(name, StyleFile(replace(alone, references=(path,)))) for path, name in names.items()]
    for path in config.styles:
        file = read_style(path)
        check_photographs(path, file)
        own = path.resolve().parent.name if path.name == "style.json" else path.stem
        chosen.append((f"{own} ({len(chosen) + 1})" if own in dict(chosen) else own, file))
    if config.together and len(names) > 1:
        chosen.append((" + ".join(names.values()) if len(names) <= 3 else f"all {len(names)}", together))
    if not chosen:
        raise UsageError("fprf gallery: name photographs with --references, or style files with --styles")
    return chosen


def _called(paths: Sequence[Path]) -> dict[Path, str]:
    """Names of photographs: their stems; where two agree, their whole names, with a number where these agree as well."""
    names: dict[Path, str] = {}
    paths = list(dict.fromkeys(paths))
    for path in paths:
        alike = sum(other.stem == path.stem for other in paths) > 1
        name = path.name if alike else path.stem
        names[path] = f"{name} ({len(names) + 1})" if name in names.values() else name
    return names


def page_views(opened: "LoadedRun[Scene]", views: Sequence[int], display: Display) -> "list[PageView]":
    """Views of a run as a page shows them: rendered, in depth, and photographed where they were held out.

    Photographs are absent where the scene's folder is no longer what it was.
    """
    from ..datamanagers.images import load_images
    from ..io.images import to_uint8
    from ..io.maps import depth_image, depth_limits
    from ..page.writer import PageView
    from ..training.prepare import read_scene
    from ..training.run import view_names

    scene, known = opened.scene, opened.known
    drawn = []
    for done, view in enumerate(views):
        display.count(done, len(views), "rendering")
        drawn.append(scene.render(scene.cameras, view))
    limits = depth_limits([each.depth for each in drawn], [each.opacity for each in drawn])
    photographs: dict[int, Picture] = {}
    try:
        captured = read_scene(opened.run.load_config()[0])
        if tuple(view_names(captured.paths)) == known.names:
            unseen = [view for view in views if view in known.test]
            photographs = dict(zip(unseen, load_images(captured, views=unseen), strict=True))
    except FprfError:
        pass
    return [
        PageView(scene.names[view], to_uint8(each.rgb), photographs.get(view), depth_image(each.depth, each.opacity, limits))
        for view, each in zip(views, drawn, strict=True)
    ]


def page_styles(
    scene: "Scene",
    chosen: Sequence[tuple[str, StyleFile]],
    views: Sequence[int],
    called: Mapping[Path, str],
    display: Display,
) -> "list[tuple[Style, Scene]]":
    """Each style on the views, with match maps and how well the views agree with each other, and the scene in that style.

    `called` are the names of all photographs. A photograph that is in several styles is encoded once, which counts as time of
    the first of them.
    """
    import torch

    from ..evaluation.consistency import consistency
    from ..io.images import to_uint8
    from ..page.writer import Style
    from ..splats.scene import SplatScene
    from ..style.config import labels
    from ..style.match_maps import match_map, match_picture, summarize
    from ..style.restyle import apply_style

    # Encoders are loaded once, and photographs encoded once, for all styles.
    encoders, made = scene.encoders(), []
    encoded: dict[tuple[Path, Path], Reference] = {}
    reduced = scene.cameras.scaled(_REDUCED)
    shown_cameras = scene.cameras.select(torch.tensor(list(views), dtype=torch.int64))
    for i, (name, file) in enumerate(chosen):
        display.count(i, len(chosen), "restyling")
        start = time.perf_counter()
        styled = apply_style(scene, file, encoders, encoded=encoded)
        built = time.perf_counter()
        look = scene.restyled(styled.restyle)
        drawn = [look.render(scene.cameras, view) for view in views]
        done = time.perf_counter()
        # Where there is one photograph nobody sees the map, and the figures need few pixels.
        several = len(styled.codes.names) > 1
        summaries, maps = [], []
        for view in views:
            matched = match_map(scene, styled, view, scene.cameras if several else reduced)
            summaries.append(summarize(matched, styled.codes))
            maps += [match_picture(matched, styled.codes)] if several else []
        # Each view against the next one, warped onto it.
        pairs = [(k, k + 1) for k in range(len(views) - 1)]
        warped = consistency([each.rgb for each in drawn], [each.depth for each in drawn], shown_cameras, pairs)
        # Of a style on the way to another, the page names its own photographs alone.
        paths = dict(zip(labels(file.style.references), file.style.references, strict=True))
        names = [label for label in styled.codes.names if label in paths]
        shares = [fmean(row["references"][k]["share"] for row in summaries) for k in range(len(styled.codes.names))]
        style = Style(
            name,
            [to_uint8(each.rgb) for each in drawn],
            look.shown.harmonics if isinstance(look, SplatScene) else None,
            references=[called[paths[label]] for label in names],
            shares=shares if several and len(shares) == len(names) else [],
            matches=maps,
            metrics={
                "match_score": fmean(row["score"] for row in summaries),
                "match_entropy_bits": fmean(row["entropy_bits"] for row in summaries),
                "warp_error": warped["rmse"],
                "new_style_seconds": built - start,
                "each_view_seconds": (done - built) / len(views),
            },
        )
        made.append((style, look))
    display.count(len(chosen), len(chosen), "restyling")
    return made


def fading(looks: "Sequence[Scene]", cameras: "Cameras", display: Display) -> "Iterator[Picture]":
    """Frames of a flight: every look for an equal share of them, each fading into the next.

    Pictures fade, as their colours would: what is drawn is linear in these.
    """
    from ..io.images import to_uint8

    share = len(cameras) / len(looks)
    for frame in range(len(cameras)):
        display.count(frame, len(cameras), "rendering")
        place = min(int(frame / share), len(looks) - 1)
        into = (frame - (place + 1) * share) / _FADE + 1
        rgb = looks[place].render(cameras, frame).rgb
        if into > 0 and place + 1 < len(looks):
            rgb = rgb.lerp(looks[place + 1].render(cameras, frame).rgb, into)
        yield to_uint8(rgb)
    display.count(len(cameras), len(cameras), "rendering")
