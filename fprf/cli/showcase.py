"""A run in several styles, as a gallery page: what `fprf demo` and `fprf gallery` have in common."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any, NamedTuple

from ..progress import Display

if TYPE_CHECKING:
    from ..interfaces import Scene
    from ..io.images import Picture
    from ..rendering.cameras import Cameras
    from ..style.files import StyleFile
    from ..style.look import Restyle
    from ..style.restyle import Styled
    from ..types import View


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
    """Each style on the views, with match maps and how well the views agree with each other."""
    from ..style.config import labels
    from ..style.match_maps import match_map, match_picture, summarize
    from ..style.restyle import apply_style

    encoders, shown = scene.encoders(), []
    for i, (name, file) in enumerate(chosen):
        display.count(i, len(chosen), "restyling")
        start = time.perf_counter()
        styled = apply_style(scene, file, encoders)
        built = time.perf_counter()
        look = scene.restyled(styled.restyle)
        pictures = [look.render(scene.cameras, view) for view in views]
        done = time.perf_counter()
        maps = [match_map(scene, styled, view) for view in views]
        summaries = [summarize(each, styled.codes) for each in maps]
        called = dict(zip(labels(file.style.references), file.style.references, strict=True))
        names = styled.codes.names
        several = len(names) > 1
        shown.append(
            Shown(
                name,
                styled,
                pictures,
                [called[label] for label in names],
                [match_picture(each, styled.codes) for each in maps] if several else [],
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


def write_page(
    path: Path,
    scene: "Scene",
    *,
    title: str,
    lead: str = "",
    facts: Mapping[str, str | int | float],
    views: Sequence[int],
    originals: "Sequence[View]",
    shown: Sequence[Shown],
    references: Mapping[str, Path],
    metrics: Mapping[str, Any],
    film: Path | None = None,
    credits: Sequence[str] = (),
) -> None:
    """Write the page: `lead` opens it, `credits` end it. `references` are all photographs by the names that it gives them."""
    from ..datamanagers.images import load_image
    from ..io.gallery import Reference, Style, write_gallery
    from ..io.images import to_uint8
    from ..io.maps import depth_image, depth_limits

    limits = depth_limits([view.depth for view in originals], [view.opacity for view in originals])
    called = {path: name for name, path in references.items()}
    write_gallery(
        path,
        title=title,
        lead=lead,
        scene=facts,
        view_names=[scene.names[view] for view in views],
        originals=[to_uint8(view.rgb) for view in originals],
        references=[Reference(name, load_image(path, upright=True)) for name, path in references.items()],
        styles=[
            Style(
                each.name,
                [to_uint8(view.rgb) for view in each.views],
                references=[called[path] for path in each.sources],
                shares=each.shares,
                matches=each.maps,
                metrics=each.metrics,
            )
            for each in shown
        ],
        depth=[depth_image(view.depth, view.opacity, limits) for view in originals],
        metrics=metrics,
        video=film,
        credits=credits,
    )


def _warped(scene: "Scene", views: Sequence[int], pictures: "Sequence[View]") -> float | None:
    """RMSE of each view against the next one, warped onto it; None where none sees what the next one sees."""
    import torch

    from ..evaluation.consistency import consistency

    cameras = scene.cameras.select(torch.tensor(list(views), dtype=torch.int64))
    pairs = [(i, i + 1) for i in range(len(views) - 1)]
    scores = consistency([view.rgb for view in pictures], [view.depth for view in pictures], cameras, pairs)
    rmse = scores["rmse"]
    return None if rmse is None else float(rmse)
