"""A run in several styles, as a page: what `fprf demo` and `fprf gallery` have in common."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any, NamedTuple

from ..errors import FprfError
from ..progress import Display

if TYPE_CHECKING:
    from ..interfaces import Scene
    from ..io.images import Picture
    from ..rendering.cameras import Cameras
    from ..style.dictionary import Reference
    from ..style.files import StyleFile
    from ..style.look import Restyle
    from ..style.restyle import Styled
    from ..training.run import Known, Run
    from ..types import View


_REDUCED = 4.0
"""Views by which matches are judged that nobody sees are smaller by this."""


class Shown(NamedTuple):
    """One style on the views of a gallery."""

    name: str
    styled: "Styled"
    views: "list[View]"
    sources: list[Path]
    """Its photographs, in the order of its match maps' colours."""
    maps: "list[Picture]"
    """Match maps, where it has several photographs."""
    shares: list[float]
    """Share of what was seen that took its style from each of several photographs."""
    metrics: dict[str, Any]
    """Figures beside the style."""


def restyled(scene: "Scene", chosen: "Sequence[tuple[str, StyleFile]]", views: Sequence[int], display: Display) -> list[Shown]:
    """Each style on the views, with match maps and how well the views agree with each other.

    A photograph that is in several styles is encoded once, which counts as time of the first of them.
    """
    from ..style.config import labels
    from ..style.match_maps import match_map, match_picture, summarize
    from ..style.restyle import apply_style

    encoders, shown = scene.encoders(), []
    encoded: dict[tuple[Path, Path], Reference] = {}
    reduced = scene.cameras.scaled(_REDUCED)
    for i, (name, file) in enumerate(chosen):
        display.count(i, len(chosen), "restyling")
        start = time.perf_counter()
        styled = apply_style(scene, file, encoders, encoded=encoded)
        built = time.perf_counter()
        look = scene.restyled(styled.restyle)
        pictures = [look.render(scene.cameras, view) for view in views]
        done = time.perf_counter()
        called = dict(zip(labels(file.style.references), file.style.references, strict=True))
        names = styled.codes.names
        several = len(names) > 1
        summaries, maps = [], []
        for view in views:
            # Where there is one photograph nobody sees the map, and the figures need few pixels.
            matched = match_map(scene, styled, view, scene.cameras if several else reduced)
            summaries.append(summarize(matched, styled.codes))
            maps += [match_picture(matched, styled.codes)] if several else []
        shown.append(
            Shown(
                name,
                styled,
                pictures,
                [called[label] for label in names],
                maps,
                [fmean(row["references"][k]["share"] for row in summaries) for k in range(len(names))] if several else [],
                {
                    "match_score": fmean(row["score"] for row in summaries),
                    "match_entropy_bits": fmean(row["entropy_bits"] for row in summaries),
                    "warp_error": _warped(scene, views, pictures),
                    "new_style_seconds": built - start,
                    "each_view_seconds": (done - built) / len(views),
                },
            )
        )
    display.count(len(chosen), len(chosen), "restyling")
    return shown


def frames_of(
    scene: "Scene", cameras: "Cameras", looks: "Callable[[int], Restyle | None]", display: Display
) -> Iterator["Picture"]:
    """Colours of a flight one by one, each frame in its own look."""
    from ..io.images import to_uint8

    before, shown = None, scene
    for i in range(len(cameras)):
        display.count(i, len(cameras), "rendering")
        if (look := looks(i)) is not before:
            before, shown = look, scene.restyled(look)
        yield to_uint8(shown.render(cameras, i).rgb)
    display.count(len(cameras), len(cameras), "rendering")


def write_shown(
    path: Path,
    scene: "Scene",
    *,
    title: str,
    lead: str = "",
    facts: Mapping[str, str | int | float],
    views: Sequence[int],
    originals: "Sequence[View]",
    photographs: "Mapping[int, Picture]",
    shown: Sequence[Shown],
    references: Mapping[str, Path],
    metrics: Mapping[str, Any],
    film: Path | None = None,
    credits: Sequence[str] = (),
    megabytes: float | None = None,
) -> int:
    """Write the page (`page.writer.Page`); how many Gaussians it shows.

    `references` are all photographs by the names that the page gives them, `photographs` those of views.
    """
    from ..datamanagers.images import load_image
    from ..io.images import to_uint8
    from ..io.maps import depth_image, depth_limits
    from ..page.writer import Page, PageView, Reference, Style, write_page
    from ..splats.scene import SplatScene

    limits = depth_limits([view.depth for view in originals], [view.opacity for view in originals])
    called = {path: name for name, path in references.items()}
    gaussians = scene if isinstance(scene, SplatScene) else None
    styles = [
        Style(
            each.name,
            [to_uint8(view.rgb) for view in each.views],
            None if gaussians is None else gaussians.restyled(each.styled.restyle).shown.harmonics,
            references=[called[path] for path in each.sources],
            shares=each.shares,
            matches=each.maps,
            metrics=each.metrics,
        )
        for each in shown
    ]
    page = Page(
        title=title,
        lead=lead,
        facts=facts,
        views=[
            PageView(
                scene.names[view], to_uint8(drawn.rgb), photographs.get(view), depth_image(drawn.depth, drawn.opacity, limits)
            )
            for view, drawn in zip(views, originals, strict=True)
        ],
        styles=styles,
        references=[Reference(name, load_image(path, upright=True)) for name, path in references.items()],
        scene=gaussians,
        start=views[0],
        metrics=metrics,
        film=film,
        credits=credits,
    )
    return write_page(path, page, megabytes=megabytes)


def photographs_of(run: "Run", known: "Known", views: Sequence[int]) -> "dict[int, Picture]":
    """Photographs of views, as far as the scene's folder is still where it was."""
    from ..datamanagers.images import load_images
    from ..training.prepare import read_scene
    from ..training.run import view_names

    try:
        captured = read_scene(run.load_config()[0])
        if tuple(view_names(captured.paths)) != known.names:
            return {}
        return dict(zip(views, load_images(captured, views=views), strict=True))
    except FprfError:
        return {}


def _warped(scene: "Scene", views: Sequence[int], pictures: "Sequence[View]") -> float | None:
    """RMSE of each view against the next one, warped onto it; None where none sees what the next one sees."""
    import torch

    from ..evaluation.consistency import consistency

    cameras = scene.cameras.select(torch.tensor(list(views), dtype=torch.int64))
    pairs = [(i, i + 1) for i in range(len(views) - 1)]
    scores = consistency([view.rgb for view in pictures], [view.depth for view in pictures], cameras, pairs)
    rmse = scores["rmse"]
    return None if rmse is None else float(rmse)
