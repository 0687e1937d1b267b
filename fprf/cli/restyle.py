"""`fprf restyle CAPTURE... --references A.jpg B.jpg --output OUT`: new colours for finished captures of 3D
Gaussians.
"""

import contextlib
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ..errors import DataError, UsageError
from ..io.overwriting import Origin
from ..plugins.captures import endings, format_name, is_scene, stem_of
from ..progress import Display
from ..style.config import NO_MASK, StyleConfig, find_reference, labels, parse_region_value
from ..style.files import StyleFile, write_style
from .restyle_outputs import (
    CaptureFile,
    RestyleConfig,
    files_of,
    names_of,
    output_of,
    styles_of,
    with_outputs,
    written_files,
)
from .style_flags import origin_of, read_flags
from .stylize import print_explained

if TYPE_CHECKING:
    from torch import Tensor

    from ..splats.captures import Captures
    from ..splats.scene import SplatScene
    from ..style.restyle import Styled

_MAX_PAGE_VIEWS = 4
"""Views on the page: by eye, they stand in one row."""
_PAGE_BACKGROUND = (0.85, 0.845, 0.83)
"""Behind an object in pictures of the page: as behind it on the stage, in the light theme; by eye."""
_RESTYLE_HELP = f"""Restyle finished captures of 3D Gaussians with photographs; their own photographs and cameras are not
needed.

Takes {", ".join(endings())} (.ksplat is read alone, .usdz written alone) and SOG folders (meta.json,
lod-meta.json); the output's ending says which is written. A reference may also be a capture or a run: views of it stand for
photographs. In the format that was read everything but colours is kept bit for bit. REGION is a region's number (--explain
lists them), its name in a style file, VIEW:X,Y (a pixel of a view) or VIEW:MASK.png; in --pin also a place:
box:X,Y,Z:X,Y,Z:BORDER, path:X,Y,Z:X,Y,Z:WIDTH,BORDER or everywhere. REFERENCE is a file or its number, from 0 in the order
given."""


class _Restyled(NamedTuple):
    """The captures in one style."""

    name: str
    """What is added to the names of its files; empty where there is one style."""
    styled: "Styled"
    scene: "SplatScene"
    seconds: float


class _Written(NamedTuple):
    """Outcome of writing the captures."""

    left: Counter[str]
    """Gaussians that cannot be drawn, by what is wrong with them and what became of them."""
    losses: list[str]
    """What formats do not hold, each as a phrase."""
    seconds: float


def run(args: list[str]) -> int:
    """Look at the captures, or take what the cache knows of them; build each style; write files and page."""
    config, file = read_flags(
        RestyleConfig(), args, prog="fprf restyle", description=_RESTYLE_HELP, positional=("captures",)
    )
    config, outputs = with_outputs(config)
    origin = origin_of("restyle", config, file)
    _check_references(file.style)
    styles = styles_of(config, file)
    files = files_of(config, outputs, styles, origin)
    for made_of, paths in written_files(config, files, styles, origin):
        made_of.check(paths)
    photographed = file.style.references
    file = _with_views(config, file, origin)
    config = replace(config, references=file.style.references, weights=(), masks=())
    with contextlib.ExitStack() as stack:
        for made_of, paths in written_files(config, files, styles, origin):
            stack.enter_context(made_of.writing(paths))
        display = stack.enter_context(Display())
        seen, looked = _look(config, display)
        gain = _neighbours_gain(config, photographed, seen, display)
        made = _apply(styles_of(config, file), seen.scene, gain, config)
        written = _write_captures(config, files, made, seen, display)
        _say_notes(config, made)
        if config.explain:
            _explain(config, file, seen.scene, made)
        if config.page is not None:
            _write_page(config.page, config, seen.scene, made)
    _report(config, seen, looked, made, written)
    return 0


def _check_references(style: StyleConfig) -> None:
    """Raise DataError for a photograph or mask that is not there, before anything takes time."""
    for path in (*style.references, *style.masks):
        if path != NO_MASK and not path.exists():
            raise DataError(f"{path}: no such file; check what --references and --masks name")


def _look(config: RestyleConfig, display: Display) -> "tuple[Captures, float]":
    """The captures as one scene, with their features, and the seconds that it took to find them."""
    from ..splats.captures import open_captures

    begun = time.perf_counter()

    def report(what: str, done: int, total: int) -> None:
        display.count(done, total, what)

    seen = open_captures(config.captures, config, cache=config.cache, progress=report, say=display.say)
    # Views are encoded now, or read from the cache: the time is reported apart from that of styles.
    seen.scene.found()
    return seen, time.perf_counter() - begun


def _neighbours_gain(
    config: RestyleConfig, photographed: Sequence[Path], seen: "Captures", display: Display
) -> "Tensor | None":
    """Gains of colours that `--match-light` takes from captures that lie beside; None where it takes means."""
    from ..splats.capture_light import neighbouring_light

    captures = []
    for path in photographed:
        if format_name(path) is not None:
            captures.append(path)
    if not config.match_light or not captures or len(captures) < len(photographed):
        return None
    gain = neighbouring_light(seen, photographed, activated=config.activated)
    if gain is None:
        how = "by the means of all colours"
    else:
        how = "where the captures meet"
    display.say(f"--match-light: {how}")
    return gain


def _apply(
    styles: Sequence[tuple[str, StyleFile]], scene: "SplatScene", gain: "Tensor | None", config: RestyleConfig
) -> list[_Restyled]:
    """The scene in each style; encoders are loaded once."""
    from ..splats.capture_light import light_alone
    from ..style.restyle import apply_style

    made = []
    encoders = scene.encoders()
    for name, file in styles:
        start = time.perf_counter()
        styled = apply_style(scene, file, encoders)
        if config.match_light:
            styled = light_alone(styled, gain)
        restyled = scene.restyled(styled.restyle)
        made.append(_Restyled(name, styled, restyled, time.perf_counter() - start))
    return made


def _write_captures(
    config: RestyleConfig,
    files: Sequence[Sequence[CaptureFile]],
    made: Sequence[_Restyled],
    seen: "Captures",
    display: Display,
) -> _Written:
    """Write file by file, each in all styles: one of the captures is in memory at a time."""
    from ..splats.files import read_capture, write_capture

    left = Counter[str]()
    losses = dict[str, None]()
    begun = time.perf_counter()
    steps = len(files) * len(made)
    done = 0
    # Of a single capture that is not written the faults are told all the same.
    for number, path in enumerate(config.captures if files or len(config.captures) == 1 else ()):
        if number == 0:
            capture = seen.first
        else:
            capture = read_capture(path, activated=config.activated)
        faulty = False
        for one, out in zip(made, files[number] if files else (), strict=False):
            display.count(done, steps, "restyling")
            harmonics = seen.harmonics(number, capture, one.scene)
            written = write_capture(out.capture, capture, harmonics, seen.views_of(number, capture))
            write_style(out.style, one.styled.controls.saved)
            faulty = written.faulty
            if len(files) > 1:
                where = f"{out.capture.name}: "
            else:
                where = ""
            for loss in written.losses():
                losses[f"{where}{loss}"] = None
            done += 1
        for fault in capture.gaussians.faults():
            count, what = fault.split(" ", 1)
            left[f"{what} left {'out' if faulty else 'as they are'}"] += int(count)
    display.count(steps, steps, "restyling")
    return _Written(left, list(losses), time.perf_counter() - begun)


def _say_notes(config: RestyleConfig, made: Sequence[_Restyled]) -> None:
    """Print what the styles have to say, each line once."""
    notes = dict[str, None]()
    for each in made:
        notes |= dict.fromkeys((*each.styled.controls.notes, *each.scene.light_notes))
    for note in notes:
        print(note)
    if config.output is not None and not made:
        print(
            f"--output {config.output}: no capture is written, since neither --references nor a light are named"
        )


def _explain(config: RestyleConfig, file: StyleFile, scene: "SplatScene", made: Sequence[_Restyled]) -> None:
    """List the regions of the scene with what they take in each style; alone where there is none."""
    from ..style.regions import Regions

    folder = output_of(config).parent
    for one in made:
        print_explained(folder / one.name, one.styled.controls.regions, one.styled)
    if not made:
        regions = Regions(scene, *scene.measured(), file.regions, file.semantic_encoder)
        print_explained(folder, regions, None)


def _report(
    config: RestyleConfig, seen: "Captures", looked: float, made: Sequence[_Restyled], written: _Written
) -> None:
    """Print how many Gaussians there are, what was left out, and the times."""
    from ..memory import peak

    seconds = written.seconds + sum(each.seconds for each in made)
    missing = []
    for what, number in written.left.items():
        missing.append(f"{number} {what}")
    told = "".join(f", {each}" for each in (*missing, *written.losses))
    if len(config.captures) > 1:
        files = f" in {len(config.captures)} files"
    else:
        files = ""
    print(
        f"{seen.count} Gaussians{files}{told}; looked at in {looked:.1f} s, "
        f"{seconds / max(1, len(made)):.2f} s for each of {len(made)} styles, at most {(peak() or 0) / 1e9:.1f} GB"
    )


def _with_views(config: RestyleConfig, file: StyleFile, origin: Origin) -> StyleFile:
    """The style with rendered views in the place of captures and runs among its references."""
    style = file.style
    scenes = []
    for path in style.references:
        if is_scene(path):
            scenes.append(path)
    if not scenes:
        return file
    if config.each:
        raise UsageError(f"--each: {scenes[0]} gives several views, which are one style; leave --each out")
    # Photographs stay; in the place of a capture or run stand its views, with masks of what they show.
    rows: list[tuple[Path, Path, float]] = []
    numbers_of = list[range]()
    names = names_of(stem_of(path) for path in style.references)
    weights = style.weights or (1.0,) * len(style.references)
    masks = style.masks or (NO_MASK,) * len(style.references)
    for path, name, mask, weight in zip(style.references, names, masks, weights, strict=True):
        before = len(rows)
        if path not in scenes:
            rows.append((path, mask, weight))
        elif mask != NO_MASK:
            raise UsageError(f"--masks: {mask} is for one photograph, {path} gives several views; write none")
        else:
            rows += _view_rows(path, weight, config, origin, name)
        numbers_of.append(range(before, len(rows)))

    def for_each_view(field: str, texts: Sequence[str]) -> tuple[str, ...]:
        # What is said of a capture holds for each of its views.
        found = []
        for text in texts:
            region, of = parse_region_value(field, text)
            for number in numbers_of[find_reference(of, style.references)]:
                found.append(f"{region}={number}")
        return tuple(found)

    pin = for_each_view("pin", style.pin)
    forbid = for_each_view("forbid", style.forbid)
    pictures, covers, numbers = zip(*rows, strict=True)
    # A capture shows what there is, not a mood: where no photograph is among them, everything takes its
    # match.
    if len(scenes) == len(style.references) and style.bold == StyleConfig().bold:
        bold = 1.0
    else:
        bold = style.bold
    return file._replace(
        style=replace(
            style, references=pictures, masks=covers, weights=numbers, pin=pin, forbid=forbid, bold=bold
        )
    )


def _view_rows(
    path: Path, weight: float, config: RestyleConfig, origin: Origin, name: str
) -> list[tuple[Path, Path, float]]:
    """Views of a capture or run beside the output, each with its mask and weight: together as much as one
    photograph.
    """
    from ..splats.captures import MAX_REFERENCE_VIEWS, reference_views

    beside = output_of(config)
    folder = beside.parent / f"{stem_of(beside)}.references" / name
    files = []
    for view in range(MAX_REFERENCE_VIEWS):
        files += [folder / f"{view:02d}.png", folder / f"{view:02d}.mask.png"]
    with origin.writing(files):
        pictures, covers, shares = reference_views(path, config, folder)
    rows = []
    for picture, cover, share in zip(pictures, covers, shares, strict=True):
        rows.append((picture, cover, weight * share / sum(shares)))
    return rows


def _write_page(path: Path, config: RestyleConfig, scene: "SplatScene", made: Sequence[_Restyled]) -> None:
    """Write the page: views as they are and in each style, evenly taken from the nearer half."""
    from ..datamanagers.images import load_preview
    from ..io.images import to_uint8
    from ..page.writer import REFERENCE_PIXELS, Page, PageView, Reference, Style, shown_of, write_page

    # Views lie on rings around the scene or within it, the nearer ones first: from these the things can be
    # told.
    nearer = max(min(_MAX_PAGE_VIEWS, len(scene.names)), len(scene.names) // 2)
    most = min(_MAX_PAGE_VIEWS, nearer)
    views = sorted({round((k + 0.5) * nearer / most - 0.5) for k in range(most)})
    cameras = scene.cameras.scaled(0.5)
    scene = replace(scene, background=_PAGE_BACKGROUND)
    shown = [replace(each.scene, background=_PAGE_BACKGROUND) for each in made]
    before = []
    for view in views:
        before.append(to_uint8(scene.render(cameras, view).rgb))
    after = []
    for styled in shown:
        after.append([to_uint8(styled.render(cameras, view).rgb) for view in views])
    names = labels(config.references)
    styles = []
    for k, (each, pictures) in enumerate(zip(made, after, strict=True)):
        # Without photographs the dictionary is that of the scene itself, which is no reference of the page.
        of = [names[k]] if config.each else names
        shown_name = each.name or " + ".join(Path(label).stem for label in of)
        name = ", ".join(part for part in (shown_name, config.light_name) if part)
        harmonics = each.scene.shown.harmonics
        lit = each.styled.restyle.lit
        styles.append(Style(name, pictures, harmonics, references=of, lit=lit))
    page = Page(
        title=stem_of(config.captures[0]) or "capture",
        facts={
            "Regions": len(scene.measured()[0].share),
            "Styles": len(styles),
        },
        views=[PageView(scene.names[view], picture) for view, picture in zip(views, before, strict=True)],
        styles=styles,
        references=[
            Reference(label, load_preview(path, REFERENCE_PIXELS))
            for label, path in zip(names, config.references, strict=True)
        ],
        scene=scene,
        start=views[0],
        suns=config.suns,
    )
    count = write_page(path, page, megabytes=config.megabytes)
    if count < len(scene.gaussians):
        held = shown_of(count, len(scene.gaussians))
        print(
            f"{path}: {held} Gaussians, those that show most; --megabytes above {config.megabytes:g} leaves fewer out"
        )
