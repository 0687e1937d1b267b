"""`fprf restyle CAPTURE --references A.jpg B.jpg --output OUT`: new colours for a finished capture of 3D Gaussians."""

import functools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..checks import at_least, positive
from ..errors import CheckpointError, UsageError
from ..plugins.captures import endings, format_name
from ..plugins.stylizers.config import RegionToneConfig, StylizerConfig
from ..progress import Display
from ..splats.config import LookConfig
from ..style.config import StyleConfig
from ..style.files import StyleFile, write_style
from .style_flags import read_flags
from .stylize import print_explained

if TYPE_CHECKING:
    from ..io.images import Picture
    from ..splats.files import Capture
    from ..splats.scene import SplatScene
    from ..splats.semantics import Semantics
    from ..style.restyle import Styled

_KEPT = 24
"""Captures of which the cache keeps what was found out."""

_DESCRIPTION = f"""Restyle a finished capture of 3D Gaussians with photographs; its own photographs and cameras are not needed.

Reads and writes {", ".join(endings())} and SOG folders (meta.json); the output's ending says which. In the
format that was read everything but colours is kept bit for bit. REGION is a region's number (--explain lists them), its name
in a style file, VIEW:X,Y (a pixel of a view) or VIEW:MASK.png; in --pin also a place: box:X,Y,Z:X,Y,Z:BORDER,
path:X,Y,Z:X,Y,Z:WIDTH,BORDER or everywhere. REFERENCE is a file or its number, from 0 in the order given."""


@dataclass(frozen=True, kw_only=True)
class RestyleConfig(StyleConfig, LookConfig):
    """Flags of `fprf restyle`: the capture, the style and the files to write."""

    capture: Path = Path()
    """The capture: a file of Gaussians, or a SOG folder."""
    output: Path | None = None
    """The restyled capture; its ending says the format."""
    style: Path | None = None
    """A style file, such as the style.json of an earlier run, of this scene or another; flags come over it."""
    stylizer: StylizerConfig = RegionToneConfig(centred=False)
    """Method that changes the colours of the capture."""
    each: bool = False
    """Each reference is a style of its own; its name is added to those of the files."""
    sheet: Path | None = None
    """A picture (.png .jpg .webp) of views before and after."""
    page: Path | None = None
    """A web page (.html) to walk through the capture before and after; it loads nothing and can be sent."""
    megabytes: float = 16.0
    """Size of that page, at most; Gaussians that show least are left out of it."""
    shown: int = 4
    """Views on the sheet and the page, at least 1."""
    explain: bool = False
    """Also list the scene's regions with what each takes: a table, and explain.json and explain.png beside the output."""
    cache: Path | None = None
    """Folder for what is found out about captures, so that the next style takes a second; by default the user's cache."""

    def __post_init__(self) -> None:
        StyleConfig.__post_init__(self)
        LookConfig.__post_init__(self)
        at_least("shown", self.shown, 1)
        positive("megabytes", self.megabytes)


def run(args: list[str]) -> int:
    """Look at the capture, or take what the cache knows of it; build each style; write files, sheet and page."""
    config, file = read_flags(RestyleConfig(), args, prog="fprf restyle", description=_DESCRIPTION, positional=("capture",))
    _check(config)
    from ..io.images import write_image
    from ..splats.files import Written, read_capture, write_capture
    from ..style.regions import Regions
    from ..style.restyle import apply_style

    begun = time.perf_counter()
    capture = read_capture(config.capture)
    count = len(capture.gaussians)
    with Display() as display:
        scene = seen_capture(capture, config, config.cache, functools.partial(display.count, what="looking"), display.say)
        scene.found()
        looked = time.perf_counter() - begun
        named, made, written, encoders = _styles(config, file), [], Written(), scene.encoders()
        for i, (name, each) in enumerate(named):
            display.count(i, len(named), "restyling")
            start = time.perf_counter()
            styled = apply_style(scene, each, encoders)
            shown = scene.restyled(styled.restyle)
            harmonics = shown.shown.harmonics  # computed now, so that its time counts
            if config.output is not None:
                output = _named(config.output, name)
                written = write_capture(output, capture, harmonics, scene.views)
                write_style(_beside(output, "style.json"), styled.controls.saved)
            made.append((name, styled, shown, time.perf_counter() - start))
        display.count(len(named), len(named), "restyling")
    for note in dict.fromkeys(note for _, styled, _, _ in made for note in styled.controls.notes):
        print(note)
    if config.explain:
        folder = (config.output or config.sheet or config.page or Path("x")).parent
        for name, styled, _, _ in made:
            print_explained(folder / name if name else folder, styled.controls.regions, styled)
        if not made:
            print_explained(folder, Regions(scene, *scene.measured(), file.regions, file.semantic_encoder), None)
    if config.sheet is not None or config.page is not None:
        pictures = _pictures(scene, [shown for _, _, shown, _ in made], config.shown)
        if config.sheet is not None:
            write_image(config.sheet, _sheet(pictures, [name for name, _, _, _ in made]))
        if config.page is not None:
            _write_page(config, scene, made, pictures)
    each_seconds = sum(seconds for *_, seconds in made) / max(1, len(made))
    left = "".join(f", {each} left {'out' if written.faulty else 'as they are'}" for each in capture.gaussians.faults())
    left += "".join(f", {loss}" for loss in written.losses())
    print(f"{count} Gaussians{left}; looked at in {looked:.1f} s, {each_seconds:.2f} s for each of {len(made)} styles")
    return 0


def _check(config: RestyleConfig) -> None:
    """Raise UsageError for what cannot be written, before anything takes time."""
    if config.output is None and not (config.sheet or config.page or config.explain):
        raise UsageError("fprf restyle: name what to write, with --output, --sheet, --page or --explain")
    if config.output is not None and format_name(config.output) is None:
        known = ", ".join(endings())
        raise UsageError(f"--output {config.output}: no file of Gaussians by its name; known endings are {known}")
    if config.page is not None and config.page.suffix.lower() != ".html":
        raise UsageError(f"--page {config.page}: the page is an .html file; give such a name")
    if not config.references and not config.explain:
        raise UsageError("--references: at least one photograph is needed, for example --references autumn.jpg night.jpg")


def _styles(config: RestyleConfig, file: StyleFile) -> list[tuple[str, StyleFile]]:
    """The styles with what is added to the names of their files."""
    if not config.references:
        return []
    if not config.each:
        return [("", file)]
    alone = []
    for i, path in enumerate(config.references):
        style = replace(file.style, references=(path,), weights=(), masks=file.style.masks[i : i + 1])
        name = path.stem if sum(other.stem == path.stem for other in config.references) == 1 else f"{path.stem}-{i}"
        alone.append((name, file._replace(style=style)))
    return alone


def seen_capture(
    capture: "Capture",
    look: LookConfig,
    cache: Path | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> "SplatScene":
    """The Gaussians of a capture that can be drawn, with views and features from the cache.

    What points up is as the flags say, else as the file does. Where views and features are absent, views are found here, and
    features, which are then stored, when they are first asked for.
    """
    from ..splats.scene import cache_name, load_scene, look_at_capture, scene_tensors
    from ..training.prepare import cache_folder
    from ..training.tensorfiles import load_sealed, save_sealed

    look = replace(look, up=look.up or capture.up)
    folder, encoder = cache or cache_folder() / "captures", look.semantic.encoder.build()
    path = folder / cache_name(capture.data, encoder.identity, look)
    gaussians = capture.gaussians.drawable()
    if path.is_file():
        try:
            scene = load_scene(load_sealed(path), gaussians, capture.antialiased, encoder)
        except CheckpointError as error:
            say(f"looking again: {error}")
        else:
            path.touch()
            return replace(scene, origin=capture.origin)
    scene = look_at_capture(gaussians, capture.antialiased, encoder, look, progress, capture.camera)

    def found() -> "Semantics":
        semantics = scene.found()
        save_sealed(path, scene_tensors(scene))
        for old in sorted(folder.glob("*.safetensors"), key=lambda each: each.stat().st_mtime)[:-_KEPT]:
            old.unlink(missing_ok=True)
        return semantics

    return replace(scene, found=functools.cache(found), origin=capture.origin)


def _named(path: Path, name: str) -> Path:
    """A path with a name before its ending; a SOG folder gets a folder of that name."""
    if not name:
        return path
    if path.name.lower() == "meta.json":
        return path.parent / name / path.name
    stem, dot, ending = path.name.partition(".")
    return path.with_name(f"{stem}-{name}{dot}{ending}")


def _beside(output: Path, what: str) -> Path:
    """`out.ply` has its `out.style.json`; a SOG folder holds it."""
    return output.with_name(what if output.name.lower() == "meta.json" else f"{output.name.partition('.')[0]}.{what}")


def _pictures(scene: "SplatScene", styles: "Sequence[SplatScene]", shown: int) -> "list[tuple[str, list[Picture]]]":
    """Views, evenly taken from the nearer half, with their pictures: as it is, then in each style."""
    from ..io.images import to_uint8

    count = max(min(shown, len(scene.names)), len(scene.names) // 2)
    cameras = scene.cameras.scaled(0.5)
    chosen = sorted({round((k + 0.5) * count / min(shown, count) - 0.5) for k in range(min(shown, count))})
    return [(scene.names[view], [to_uint8(each.render(cameras, view).rgb) for each in (scene, *styles)]) for view in chosen]


def _sheet(pictures: "list[tuple[str, list[Picture]]]", names: list[str]) -> "Picture":
    from ..io.sheet import Tile, contact_sheet

    titles = ["before", *(name or "after" for name in names)]
    tiles = [Tile(each, (f"view {view}: {title}",)) for view, row in pictures for title, each in zip(titles, row, strict=True)]
    return contact_sheet(tiles, len(titles))


def _write_page(
    config: RestyleConfig,
    scene: "SplatScene",
    made: "list[tuple[str, Styled, SplatScene, float]]",
    pictures: "list[tuple[str, list[Picture]]]",
) -> None:
    from ..datamanagers.images import load_image
    from ..page.writer import Page, PageView, Reference, Style, write_page
    from ..style.config import labels

    assert config.page is not None
    names = labels(config.references)
    styles = []
    for k, (name, styled, shown, seconds) in enumerate(made):
        of = [names[k]] if config.each else styled.dictionary.names
        styles.append(
            Style(
                name or " + ".join(Path(label).stem for label in of),
                [row[1 + k] for _, row in pictures],
                shown.shown.harmonics,
                references=of,
                metrics={"new_style_seconds": seconds},
            )
        )
    page = Page(
        title=config.capture.resolve().name.partition(".")[0] or "capture",
        facts={"Gaussians": len(scene.gaussians), "Regions": len(scene.measured()[0].share), "Styles": len(styles)},
        views=[PageView(view, row[0]) for view, row in pictures],
        styles=styles,
        references=[
            Reference(label, load_image(path, upright=True)) for label, path in zip(names, config.references, strict=True)
        ],
        scene=scene,
        start=scene.names.index(pictures[0][0]),
    )
    write_page(config.page, page, megabytes=config.megabytes)
