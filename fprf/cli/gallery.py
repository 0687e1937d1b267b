"""`fprf gallery RUN --references DIR`: a run in every style, as one page that needs nothing else."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Literal

from ..checks import at_least, positive
from ..errors import FprfError, UsageError
from ..light.day import check_suns
from ..progress import Display
from ..style.files import StyleFile, check_photographs, read_style, with_folders
from .style_flags import StyledRunConfig, origin_of, read_flags, say, style_name

if TYPE_CHECKING:
    from ..io.images import Picture
    from ..page.writer import PageView, Style
    from ..scenes import Scene
    from ..style.dictionary import Reference
    from ..training.loading import LoadedRun

_GALLERY_HELP = """A run in every style, as one page to walk through, with match maps. It loads nothing.

Each reference is a style of its own; with several of them all together are one more."""


@dataclass(frozen=True, kw_only=True)
class GalleryConfig(StyledRunConfig):
    """Views and styles of the page."""

    styles: tuple[Path, ...] = ()
    """Style files (style.json), each one more style."""
    split: Literal["some", "test", "train", "all"] = "some"
    """Views to choose from. some: at most 8 training views, spread evenly; test: those held out from
    training.
    """
    most: int = 6
    """Views that are shown, evenly taken from the split."""
    views: tuple[str, ...] = ()
    """Views to show by name, instead."""
    title: str = ""
    """Headline; empty = the scene's name."""
    megabytes: float = 16.0
    """Size of the page, at most; Gaussians that show least are left out of it."""
    suns: int = 12
    """Suns of a day on the page, from 2 to 64, for runs of Gaussians; one chooses the time there. 0 = none. Each adds
    about a hundredth to its size.
    """
    output: Path | None = None
    """The page; by default RUN/gallery.html."""
    address: str = ""
    """Address of the page on the web (https://HOST/garden.html): chats then show the picture that is written
    beside it.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least("most", self.most, 1)
        positive("megabytes", self.megabytes)
        check_suns(self.suns)


def run(args: list[str]) -> int:
    """Render the views in every style, write the page."""
    config, file = read_flags(
        GalleryConfig(), args, prog="fprf gallery", description=_GALLERY_HELP, positional=("run",)
    )
    from ..datamanagers.images import load_preview
    from ..page.writer import REFERENCE_PIXELS, Page, Reference, preview_of, write_page
    from ..splats.scene import SplatScene
    from ..training.loading import open_run

    if config.output is None:
        output = config.run / "gallery.html"
    else:
        output = config.output
    if output.suffix.lower() != ".html":
        raise UsageError(f"--output {output}: the page is an .html file; give such a name")
    origin = origin_of("gallery", config, file)
    outputs = [output, preview_of(output)] if config.address else [output]
    origin.check(outputs)
    opened = open_run(config.run, config.device, config)
    known = opened.known
    scene = opened.scene
    views = known.views(config.split, config.views)
    # Evenly from the split; views that are named are all shown.
    if config.views:
        most = len(views)
    else:
        most = min(config.most, len(views))
    views = [views[k * len(views) // most] for k in range(most)]
    chosen = _chosen(config, file)
    # Photographs have one name on the whole page, whichever styles they are in.
    called = _called([*config.references, *(path for _, each in chosen for path in each.style.references)])
    with Display() as display:
        originals = page_views(opened, views, display)
        styles = page_styles(scene, chosen, views, called, display)
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
        styles=[style for style, *_ in styles],
        references=[Reference(name, load_preview(path, REFERENCE_PIXELS)) for path, name in called.items()],
        scene=scene if isinstance(scene, SplatScene) else None,
        start=views[0],
        suns=config.suns,
        address=config.address,
    )
    with origin.writing(outputs):
        write_page(output, page, megabytes=config.megabytes)
    print(f"{len(views)} views in {len(styles)} styles: {output} ({output.stat().st_size / 2**20:.1f} MiB)")
    return 0


def _chosen(config: GalleryConfig, together: StyleFile) -> list[tuple[str, StyleFile]]:
    """The styles with their names. Raises UsageError where there are none."""
    from ..page.writer import CAPTURED

    names = _called(config.references)
    # What names photographs one by one does not hold where each is alone.
    alone = replace(together.style, weights=(), masks=(), pin=(), forbid=())
    chosen = []
    for path, name in names.items():
        chosen.append((name, StyleFile(replace(alone, references=(path,)))))
    for path in config.styles:
        file = read_style(path)
        check_photographs(path, file)
        file = file._replace(style=with_folders(file.style, say))
        own = style_name(path, ())
        chosen.append((f"{own} ({len(chosen) + 1})" if own in (CAPTURED, *dict(chosen)) else own, file))
    if len(names) > 1:
        chosen.append((" + ".join(names.values()) if len(names) <= 3 else f"all {len(names)}", together))
    if not chosen:
        raise UsageError("fprf gallery: name photographs with --references, or style files with --styles")
    return chosen


def _called(paths: Sequence[Path]) -> dict[Path, str]:
    """Names of photographs: their stems; where two agree, their whole names, with a number where these agree
    as well.

    None is called as the scene without a style is.
    """
    from ..page.writer import CAPTURED

    names: dict[Path, str] = {}
    paths = list(dict.fromkeys(paths))
    for path in paths:
        alike = sum(other.stem == path.stem for other in paths) > 1
        name = path.name if alike else path.stem
        if name in (CAPTURED, *names.values()):
            names[path] = f"{name} ({len(names) + 1})"
        else:
            names[path] = name
    return names


def page_views(opened: "LoadedRun[Scene]", views: Sequence[int], display: Display) -> "list[PageView]":
    """Views of a run as a page shows them: rendered, and photographed where they were held out.

    Photographs are absent where the scene's folder is no longer what it was.
    """
    from ..datamanagers.images import load_images
    from ..io.images import to_uint8
    from ..page.writer import PageView
    from ..training.prepare import read_scene
    from ..training.run import view_names

    scene = opened.scene
    known = opened.known
    photographs: dict[int, Picture] = {}
    try:
        captured = read_scene(opened.run.load_config()[0])
        if tuple(view_names(captured.paths)) == known.names:
            unseen = []
            for view in views:
                if view in known.test:
                    unseen.append(view)
            photographs = dict(zip(unseen, load_images(captured, views=unseen), strict=True))
    except FprfError:
        pass
    shown = []
    for done, view in enumerate(views):
        display.count(done, len(views), "rendering")
        rendered = to_uint8(scene.render(scene.cameras, view).rgb)
        shown.append(PageView(scene.names[view], rendered, photographs.get(view)))
    return shown


def page_styles(
    scene: "Scene",
    chosen: Sequence[tuple[str, StyleFile]],
    views: Sequence[int],
    called: Mapping[Path, str],
    display: Display,
) -> "list[tuple[Style, Scene, float]]":
    """Each style on the views, with match maps; the scene in that style; the seconds that the style took.

    `called` are the names of all photographs. A photograph that is in several styles is encoded once, which
    counts as time of the first of them.
    """
    from ..io.images import to_uint8
    from ..page.writer import Style
    from ..splats.scene import SplatScene
    from ..style.config import labels
    from ..style.match_maps import match_map, match_picture, summarize
    from ..style.restyle import apply_style

    # Encoders are loaded once, and photographs encoded once, for all styles.
    encoders = scene.encoders()
    made = []
    encoded: dict[tuple[Path, Path], Reference] = {}
    for i, (name, file) in enumerate(chosen):
        display.count(i, len(chosen), "restyling")
        start = time.perf_counter()
        styled = apply_style(scene, file, encoders, encoded=encoded)
        seconds = time.perf_counter() - start
        look = scene.restyled(styled.restyle)
        stills = []
        for view in views:
            stills.append(to_uint8(look.render(scene.cameras, view).rgb))
        # Of a style on the way to another, the page names its own photographs alone.
        paths = dict(zip(labels(file.style.references), file.style.references, strict=True))
        names = []
        for label in styled.codes.names:
            if label in paths:
                names.append(label)
        # Match maps say which photograph is where: there is something to say where there are several.
        rows = []
        maps = []
        for view in views if len(styled.codes.names) > 1 else ():
            matched = match_map(scene, styled, view)
            maps.append(match_picture(matched, styled.codes))
            rows.append([row["share"] for row in summarize(matched, styled.codes)["references"]])
        shares = []
        for column in zip(*rows, strict=True):
            shares.append(fmean(column))
        style = Style(
            name,
            stills,
            look.shown.harmonics if isinstance(look, SplatScene) else None,
            references=[called[paths[label]] for label in names],
            shares=shares if len(shares) == len(names) else [],
            matches=maps,
            lit=styled.restyle.lit,
        )
        made.append((style, look, seconds))
    display.count(len(chosen), len(chosen), "restyling")
    return made
