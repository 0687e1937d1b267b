"""Flags of `fprf restyle`, and the files that they have it write: captures in their styles, beside these what explains
them, and a page.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from ..checks import positive
from ..errors import UsageError
from ..io.overwriting import Origin, OverwriteConfig, same_file, unused_name
from ..light.day import check_suns
from ..plugins.captures import captures_in, endings, format_name, is_scene, stem_of
from ..plugins.stylizers.config import RegionToneConfig, StylizerConfig
from ..splats.config import LookConfig
from ..style.config import StyleConfig
from ..style.files import StyleFile
from .parsing import read_paths
from .style_flags import say


@dataclass(frozen=True, kw_only=True)
class RestyleConfig(StyleConfig, LookConfig, OverwriteConfig):
    """Flags of `fprf restyle`: the capture, the style and the files to write."""

    captures: tuple[Path, ...] = ()
    """The captures: files of Gaussians, SOG folders, or folders of them. Several take one style together, so that
    neighbours stay alike.
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
    suns: int = 12
    """Suns of a day on that page, from 2 to 64; one chooses the time there. 0 = none. Each adds
    about a hundredth to its size.
    """
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
        check_suns(self.suns)


class CaptureFile(NamedTuple):
    """Files that are written for one capture in one style."""

    capture: Path
    style: Path
    """The style file beside it."""


def output_of(config: RestyleConfig) -> Path:
    """The output that everything else lies beside."""
    return config.output or config.page or Path("x")


def with_outputs(config: RestyleConfig) -> tuple[RestyleConfig, list[Path]]:
    """The config with the captures of folders in the place of these, and the file for each capture; none where
    none is to be written.

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
    if not config.references and not config.light_asked and not config.explain:
        raise UsageError(
            "--references: at least one photograph is needed, for example --references autumn.jpg night.jpg, or a "
            "light, for example --light golden-hour"
        )
    captures = _with_folders(config.captures)
    several = len(captures) > 1 or captures != config.captures
    config = replace(config, captures=captures)
    if config.output is None:
        return config, []
    # A folder holds a file for each capture.
    if config.output.is_dir() or (several and format_name(config.output) is None):
        return config, _outputs_in_folder(config, config.output)
    if len(captures) > 1:
        raise UsageError(f"--output {config.output}: {len(captures)} captures need a folder; name one")
    _check_format(config.output)
    return config, [config.output]


def _with_folders(captures: Sequence[Path]) -> tuple[Path, ...]:
    """The captures, with those in a folder of captures in its place. Raises UsageError for a folder without."""
    found: list[Path] = []
    for path in captures:
        if not path.is_dir() or is_scene(path):
            found.append(path)
            continue
        held = captures_in(path)
        if not held:
            raise UsageError(
                f"{path}: a folder without captures; name a file ({' '.join(endings())}), a SOG folder, or a folder of them"
            )
        found += held
    return tuple(found)


def _outputs_in_folder(config: RestyleConfig, folder: Path) -> list[Path]:
    """The files in a folder for each capture: under its own name, or a .ply where its format is read alone."""
    from ..splats.files.base import format_of

    outputs: list[Path] = []
    for path in config.captures:
        index = path.name.lower() in ("meta.json", "lod-meta.json")
        inside = folder / (path.parent.name if index else path.name)
        known = format_name(path)
        if index or path.is_dir():
            outputs.append(inside / "meta.json")
        elif known is not None and not format_of(path).writes:
            outputs.append(inside.with_suffix(".ply"))
        else:
            outputs.append(inside)
    names = Counter(str(path).casefold() for path in outputs)
    for path in outputs:
        if names[str(path).casefold()] > 1:
            raise UsageError(
                f"--output {folder}: several captures would be written as {path}; give them other names"
            )
    return outputs


def _check_format(output: Path) -> None:
    """Raise UsageError for a file of Gaussians that cannot be written, DataError where a package is missing."""
    from ..splats.files.base import check_needs, format_of

    if format_name(output) is None:
        known_endings = ", ".join(endings())
        raise UsageError(
            f"--output {output}: no file of Gaussians by its name; known endings are {known_endings}"
        )
    form = format_of(output)
    if not form.writes:
        raise UsageError(
            f"--output {output}: files of this format are read, not written; name a .ply, .spz, .sog or .glb"
        )
    check_needs(form)


def files_of(
    config: RestyleConfig, outputs: Sequence[Path], styles: Sequence[tuple[str, StyleFile]], origin: Origin
) -> list[list[CaptureFile]]:
    """The files of each capture in each style."""
    files = []
    for output in outputs:
        row = []
        for name, style in styles:
            row.append(_file_in_style(config, output, name, _origin_of_style(config, style, origin)))
        files.append(row)
    return files


def _file_in_style(config: RestyleConfig, output: Path, name: str, origin: Origin) -> CaptureFile:
    """The file of a capture in one style, with its style file beside it.

    The style's name goes before the ending; a SOG folder gets a folder of that name, and holds its style.json.
    The style file that is read is never the one that is written, unless the user asked for that.
    """
    stem = stem_of(output)
    folder = output.name.lower() == "meta.json"
    if name and folder:
        output = output.parent / name / output.name
    elif name:
        output = output.with_name(f"{stem}-{name}{output.name[len(stem) :]}")
    usual = "style" if folder else f"{stem_of(output)}.style"
    saved = output.with_name(f"{usual}.json")
    if config.style is None or config.overwrite or not same_file(saved, config.style):
        return CaptureFile(output, saved)
    base = "" if folder else stem_of(output)
    taken = [base]
    while origin.refusal(saved) is not None:
        taken.append(unused_name(base, taken))
        saved = output.with_name(f"{taken[-1].lstrip('-')}.style.json")
    say(f"{config.style} is read and stays as it is; the new style is {saved}")
    return CaptureFile(output, saved)


def _origin_of_style(config: RestyleConfig, style: StyleFile, origin: Origin) -> Origin:
    """Origin of the files in one style: of a style of its own (`--each`) only its photograph counts."""
    if not config.each:
        return origin
    made_of = (*config.captures, *read_paths(style.style))
    if config.style is not None:
        made_of = (*made_of, config.style)
    return replace(origin, reads=made_of, beside=origin.reads)


def written_files(
    config: RestyleConfig,
    files: Sequence[Sequence[CaptureFile]],
    styles: Sequence[tuple[str, StyleFile]],
    origin: Origin,
) -> list[tuple[Origin, list[Path]]]:
    """Every file that is written, with its origin; views in the place of captures among the references are not
    among them.
    """
    found: list[tuple[Origin, list[Path]]] = []
    for number, (name, style) in enumerate(styles):
        paths = _explained(config, name)
        for row in files:
            paths += _capture_files(row[number])
        found.append((_origin_of_style(config, style, origin), paths))
    if not styles:
        found.append((origin, _explained(config, "")))
    if config.page is not None:
        found.append((origin, [config.page]))
    return found


def _explained(config: RestyleConfig, name: str) -> list[Path]:
    """The files of `--explain` in a style."""
    folder = output_of(config).parent / name
    if config.explain:
        return [folder / "explain.json", folder / "explain.png"]
    return []


def _capture_files(file: CaptureFile) -> list[Path]:
    """The files of a capture: with its style, its offset, and what lies in a SOG folder already."""
    from ..rendering.local_frame import offset_file

    paths = [file.capture, offset_file(file.capture), file.style]
    if file.capture.name.lower() == "meta.json":  # its pictures have names of their own
        paths += [*file.capture.parent.glob("*.webp"), *file.capture.parent.glob("*.png")]
    return paths


def names_of(stems: Iterable[str]) -> list[str]:
    """A name for each stem, all different: of stems that agree with their number behind them."""
    stems = list(stems)
    counts = Counter(stem.casefold() for stem in stems)
    names: list[str] = []
    for number, stem in enumerate(stems):
        if counts[stem.casefold()] == 1:
            name = stem
        else:
            name = f"{stem}-{number}"
        names.append(unused_name(name, names))
    return names


def styles_of(config: RestyleConfig, file: StyleFile) -> list[tuple[str, StyleFile]]:
    """The styles with what is added to the names of their files."""
    if not config.each:
        return [("", file)] if config.references or config.light_asked else []
    alone = []
    # Without dots: x.compressed would make another format of a .ply.
    names = names_of(path.stem.replace(".", "_") for path in config.references)
    for i, path in enumerate(config.references):
        style = replace(file.style, references=(path,), weights=(), masks=file.style.masks[i : i + 1])
        alone.append((names[i], file._replace(style=style)))
    return alone
