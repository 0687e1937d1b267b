"""`fprf restyle CAPTURE... --references A.jpg B.jpg --output OUT`: new colours for finished captures of 3D
Gaussians.
"""

import functools
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ..checks import positive
from ..errors import DataError, UsageError
from ..plugins.captures import endings, format_name, is_scene, stem_of
from ..plugins.stylizers.config import RegionToneConfig, StylizerConfig
from ..progress import Display
from ..splats.config import LookConfig
from ..style.config import NO_MASK, StyleConfig, find_reference, labels, parse_region_value
from ..style.files import StyleFile, write_style
from .style_flags import read_flags
from .stylize import print_explained

if TYPE_CHECKING:
    from ..splats.scene import SplatScene
    from ..style.restyle import Styled

_SHOWN = 4
"""Views on the page."""
_DESCRIPTION = f"""Restyle finished captures of 3D Gaussians with photographs; their own photographs and cameras are not needed.

Takes {", ".join(endings())} (.ksplat is read alone, .usdz written alone) and SOG folders (meta.json,
lod-meta.json); the output's ending says which is written. A reference may also be a capture or a run: views of it stand for
photographs. In the format that was read everything but colours is kept bit for bit. REGION is a region's number (--explain
lists them), its name in a style file, VIEW:X,Y (a pixel of a view) or VIEW:MASK.png; in --pin also a place:
box:X,Y,Z:X,Y,Z:BORDER, path:X,Y,Z:X,Y,Z:WIDTH,BORDER or everywhere. REFERENCE is a file or its number, from 0 in the order
given."""


@dataclass(frozen=True, kw_only=True)
class RestyleConfig(StyleConfig, LookConfig):
    """Flags of `fprf restyle`: the capture, the style and the files to write."""

    captures: tuple[Path, ...] = ()
    """The captures: files of Gaussians, or SOG folders. Several take one style together, so that neighbours
    stay alike.
    """
    output: Path | None = None
    """The restyled capture; its ending says the format. A folder for several captures, or where it is one
    already.
    """
    style: Path | None = None
    """A style file, such as the style.json of an earlier run, of this scene or another; flags come over
    it.
    """
    stylizer: StylizerConfig = RegionToneConfig(centred=False)
    """Method that changes the colours of the capture."""
    match_light: bool = False
    """Take exposure and white balance of the references alone: one gain for each channel of the whole
    scene.
    """
    each: bool = False
    """Each reference is a style of its own; its name is added to those of the files."""
    page: Path | None = None
    """A web page (.html) to walk through the capture before and after; it loads nothing and can be sent."""
    megabytes: float = 16.0
    """Size of that page, at most; Gaussians that show least are left out of it."""
    explain: bool = False
    """Also list the scene's regions with what each takes: a table, and explain.json and explain.png beside
    the output.
    """
    cache: Path | None = None
    """Folder for what is found out about captures, so that the next style takes a second; by default the
    user's cache.
    """

    def __post_init__(self) -> None:
        StyleConfig.__post_init__(self)
        LookConfig.__post_init__(self)
        positive("megabytes", self.megabytes)


class _Restyled(NamedTuple):
    """The captures in one style."""

    name: str
    """What is added to the names of its files; empty where there is one style."""
    styled: "Styled"
    scene: "SplatScene"
    seconds: float


def run(args: list[str]) -> int:
    """Look at the captures, or take what the cache knows of them; build each style; write files and page."""
    config, file = read_flags(
        RestyleConfig(), args, prog="fprf restyle", description=_DESCRIPTION, positional=("captures",)
    )
    outputs = _outputs(config)
    from ..memory import peak
    from ..splats.captures import light_alone, neighbouring_light, open_captures
    from ..splats.files import read_capture, write_capture
    from ..style.regions import Regions
    from ..style.restyle import apply_style

    for path in (*file.style.references, *file.style.masks):
        if path != NO_MASK and not path.exists():
            raise DataError(f"{path}: no such file; check what --references and --masks name")
    begun = time.perf_counter()
    photographed = file.style.references
    file = _with_views(config, file)
    config = replace(config, references=file.style.references, weights=(), masks=())
    with Display() as display:
        report = functools.partial(display.count, what="looking")
        seen = open_captures(config.captures, config, cache=config.cache, progress=report, say=display.say)
        scene = seen.scene
        # views are encoded now, or read from the cache: the time is reported apart from that of styles
        scene.found()
        looked = time.perf_counter() - begun
        gain = None
        if (
            config.match_light
            and photographed
            and all(format_name(path) is not None for path in photographed)
        ):
            gain = neighbouring_light(seen, photographed)
            display.say(
                f"--match-light: {'where the captures meet' if gain is not None else 'by the means of all colours'}"
            )
        named = _styles(config, file)
        made = list[_Restyled]()
        encoders = scene.encoders()
        for name, each in named:
            start = time.perf_counter()
            styled = apply_style(scene, each, encoders)
            if config.match_light:
                styled = light_alone(styled, gain)
            else:
                styled = styled
            made.append(_Restyled(name, styled, scene.restyled(styled.restyle), time.perf_counter() - start))
        # File by file, each in all styles: one of them is in memory at a time.
        left = Counter[str]()
        losses = dict[str, None]()
        steps = len(config.captures) * len(named)
        for k, path in enumerate(config.captures if outputs or len(config.captures) == 1 else ()):
            capture = seen.first if k == 0 else read_capture(path)
            faulty = False
            for i, one in enumerate(made if outputs else ()):
                display.count(k * len(named) + i, steps, "restyling")
                start = time.perf_counter()
                # The style's name goes before the ending; a SOG folder gets a folder of that name, and holds
                # its style.json.
                output = outputs[k]
                stem = stem_of(outputs[k])
                folder = output.name.lower() == "meta.json"
                if one.name and folder:
                    output = output.parent / one.name / output.name
                elif one.name:
                    output = output.with_name(f"{stem}-{one.name}{output.name[len(stem) :]}")
                harmonics = seen.harmonics(k, capture, one.styled.restyle)
                written = write_capture(output, capture, harmonics, scene.views)
                faulty = written.faulty
                where = f"{output.name}: " if len(outputs) > 1 else ""
                losses |= dict.fromkeys(f"{where}{loss}" for loss in written.losses())
                if folder:
                    beside = "style.json"
                else:
                    beside = f"{stem_of(output)}.style.json"
                write_style(output.with_name(beside), one.styled.controls.saved)
                made[i] = one._replace(seconds=one.seconds + time.perf_counter() - start)
            for number, what in (each.split(" ", 1) for each in capture.gaussians.faults()):
                left[f"{what} left {'out' if faulty else 'as they are'}"] += int(number)
        display.count(steps, steps, "restyling")
    for note in dict.fromkeys(note for each in made for note in each.styled.controls.notes):
        print(note)
    if outputs and not made:
        print(f"--output {config.output}: no capture is written, since no --references are named")
    if config.explain:
        parent = (config.output or config.page or Path("x")).parent
        for one in made:
            print_explained(parent / one.name, one.styled.controls.regions, one.styled)
        if not made:
            print_explained(
                parent, Regions(scene, *scene.measured(), file.regions, file.semantic_encoder), None
            )
    if config.page is not None:
        _write_page(config.page, config, scene, made)
    each_seconds = sum(each.seconds for each in made) / max(1, len(made))
    missing = "".join(
        f", {each}" for each in (*(f"{number} {what}" for what, number in left.items()), *losses)
    )
    if len(config.captures) > 1:
        files = f" in {len(config.captures)} files"
    else:
        files = ""
    print(
        f"{seen.count} Gaussians{files}{missing}; looked at in {looked:.1f} s, {each_seconds:.2f} s for each of {len(made)} "
        f"styles, at most {(peak() or 0) / 1e9:.1f} GB"
    )
    return 0


def _outputs(config: RestyleConfig) -> list[Path]:
    """The file for each capture; none where none is to be written.

    Raises UsageError for what cannot be written, before anything takes time.
    """
    if not config.captures:
        raise UsageError(
            "fprf restyle: name a capture, for example fprf restyle scan.ply --references autumn.jpg --output new.ply"
        )
    # Something must be asked for, and have what it needs, before a capture is read.
    if config.output is None and not (config.page or config.explain):
        raise UsageError("fprf restyle: name what to write, with --output, --page or --explain")
    if config.page is not None and config.page.suffix.lower() != ".html":
        raise UsageError(f"--page {config.page}: the page is an .html file; give such a name")
    if not config.references and not config.explain:
        raise UsageError(
            "--references: at least one photograph is needed, for example --references autumn.jpg night.jpg"
        )
    if config.output is None:
        return []
    from ..splats.files.base import check_needs, format_of

    # A folder holds a file for each capture under its own name, or a .ply where its format is read alone.
    if config.output.is_dir() or (len(config.captures) > 1 and format_name(config.output) is None):
        outputs = []
        for path in config.captures:
            index = path.name.lower() in ("meta.json", "lod-meta.json")
            inside = config.output / (path.parent.name if index else path.name)
            known = format_name(path)
            outputs.append(inside / "meta.json" if index or path.is_dir() else inside)
            if known is not None and not index and not format_of(path).writes:
                outputs[-1] = inside.with_suffix(".ply")
        same = [path for path in outputs if outputs.count(path) > 1]
        if same:
            raise UsageError(
                f"--output {config.output}: several captures would be written as {same[0]}; give them other names"
            )
        if any(path.resolve() in [each.resolve() for each in config.captures] for path in outputs):
            raise UsageError(f"--output {config.output}: the captures lie there; name another folder")
        return outputs
    if len(config.captures) > 1:
        raise UsageError(f"--output {config.output}: {len(config.captures)} captures need a folder; name one")
    if format_name(config.output) is None:
        known_endings = ", ".join(endings())
        raise UsageError(
            f"--output {config.output}: no file of Gaussians by its name; known endings are {known_endings}"
        )
    if not (form := format_of(config.output)).writes:
        raise UsageError(
            f"--output {config.output}: files of this format are read, not written; name a .ply, .spz, .sog or .glb"
        )
    check_needs(form)
    return [config.output]


def _with_views(config: RestyleConfig, file: StyleFile) -> StyleFile:
    """The style with rendered views in the place of captures and runs among its references."""
    style = file.style
    scenes = [path for path in style.references if is_scene(path)]
    if not scenes:
        return file
    if config.each:
        raise UsageError(f"--each: {scenes[0]} gives several views, which are one style; leave --each out")
    from ..splats.captures import reference_views

    # Photographs stay; in the place of a capture or run stand its views, with masks of what they show.
    rows: list[tuple[Path, Path, float]] = []
    numbers_of = list[range]()
    stems = [stem_of(path) for path in style.references]
    beside = config.output or config.page or Path("x")
    weights = style.weights or (1.0,) * len(style.references)
    masks = style.masks or (NO_MASK,) * len(style.references)
    for i, (path, mask, weight) in enumerate(zip(style.references, masks, weights, strict=True)):
        before = len(rows)
        if path not in scenes:
            rows.append((path, mask, weight))
            numbers_of.append(range(before, len(rows)))
            continue
        if mask != NO_MASK:
            raise UsageError(f"--masks: {mask} is for one photograph, {path} gives several views; write none")
        if stems.count(stems[i]) == 1:
            name = stems[i]
        else:
            name = f"{stems[i]}-{i}"
        pictures, covers, shares = reference_views(
            path, config, beside.parent / f"{stem_of(beside)}.references" / name
        )
        # All views of a scene weigh as much as one photograph.
        rows += [
            (picture, cover, weight * share / sum(shares))
            for picture, cover, share in zip(pictures, covers, shares, strict=True)
        ]
        numbers_of.append(range(before, len(rows)))

    def expanded(field: str, texts: Sequence[str]) -> tuple[str, ...]:
        # What is said of a capture holds for each of its views.
        pairs = [parse_region_value(field, text) for text in texts]
        return tuple(
            f"{region}={k}" for region, of in pairs for k in numbers_of[find_reference(of, style.references)]
        )

    pin = expanded("pin", style.pin)
    forbid = expanded("forbid", style.forbid)
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


def _styles(config: RestyleConfig, file: StyleFile) -> list[tuple[str, StyleFile]]:
    """The styles with what is added to the names of their files."""
    if not config.each:
        return [("", file)] if config.references else []
    # Without dots: x.compressed would make another format of a .ply.
    alone = []
    stems = [path.stem.replace(".", "_") for path in config.references]
    for i, path in enumerate(config.references):
        style = replace(file.style, references=(path,), weights=(), masks=file.style.masks[i : i + 1])
        if stems.count(stems[i]) == 1:
            name = stems[i]
        else:
            name = f"{stems[i]}-{i}"
        alone.append((name, file._replace(style=style)))
    return alone


def _write_page(path: Path, config: RestyleConfig, scene: "SplatScene", made: Sequence[_Restyled]) -> None:
    """Write the page: views as they are and in each style, evenly taken from the nearer half."""
    from ..datamanagers.images import load_preview
    from ..io.images import to_uint8
    from ..page.writer import REFERENCE_PIXELS, Page, PageView, Reference, Style, write_page

    # Views lie on rings around the scene or within it, the nearer ones first: from these the things can be
    # told.
    nearer = max(min(_SHOWN, len(scene.names)), len(scene.names) // 2)
    most = min(_SHOWN, nearer)
    views = sorted({round((k + 0.5) * nearer / most - 0.5) for k in range(most)})
    cameras = scene.cameras.scaled(0.5)
    before = [to_uint8(scene.render(cameras, view).rgb) for view in views]
    after = [[to_uint8(each.scene.render(cameras, view).rgb) for view in views] for each in made]
    names = labels(config.references)
    styles = []
    for k, (each, pictures) in enumerate(zip(made, after, strict=True)):
        of = [names[k]] if config.each else each.styled.dictionary.names
        name = each.name or " + ".join(Path(label).stem for label in of)
        harmonics = each.scene.shown.harmonics
        styles.append(Style(name, pictures, harmonics, references=of))
    page = Page(
        title=stem_of(config.captures[0]) or "capture",
        facts={
            "Gaussians": len(scene.gaussians),
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
    )
    write_page(path, page, megabytes=config.megabytes)
