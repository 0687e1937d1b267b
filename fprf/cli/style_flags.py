"""Flags of the verbs that restyle: a style file first, where one is named, then a preset, then every flag
over both.
"""

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

from ..errors import UsageError
from ..io.overwriting import Origin, OverwriteConfig
from ..io.paths import as_path, expanded
from ..plugins import slots
from ..style.config import NO_MASK, PRESETS, StyleConfig, preset_flags, with_preset
from ..style.files import StyleFile, check_photographs, read_style, with_folders
from ..training.quality import QualityConfig
from .parsing import parse, read_paths

C = TypeVar("C", bound=StyleConfig)

_MAX_CHOSEN_CHARACTERS = 60
"""Of a style's name that users choose: by eye, file names carry it beside others."""
_MAX_JOINED_CHARACTERS = 80
"""Of a style's name that is made of those of its photographs: by eye, it names a folder."""


@dataclass(frozen=True, kw_only=True)
class StyledRunConfig(StyleConfig, QualityConfig, OverwriteConfig):
    """A run and its style, for the verbs that render it."""

    run: Path = Path()
    """Run folder."""
    device: str = "auto"
    """cpu, cuda, mps, or auto."""

    def __post_init__(self) -> None:
        StyleConfig.__post_init__(self)
        QualityConfig.__post_init__(self)


def read_flags(
    default: C, args: Sequence[str], *, prog: str, description: str, positional: tuple[str, ...]
) -> tuple[C, StyleFile]:
    """The verb's config and the style that it asks for; `--style FILE` gives the values that no flag gives.

    `--gentle`, or another name of `PRESETS`, sets what that preset sets, over the file and below every other
    flag. A flag of many values may stand several times: `--pin 3=a.jpg --pin 5=b.jpg` is `--pin 3=a.jpg
    5=b.jpg`. Folders among the references stand for the images in them. Raises what `parse`, `with_folders`
    and `read_style` raise, and DataError where a photograph of the file is no longer the one it was.
    """
    # Defaults from the style file, then the stylizer, which decides what a preset sets, then the preset, then
    # all other flags. Whether cosines are centred is up to the verb: where neither file nor flag says it, its
    # own default holds.
    path = _style_flag(args)
    centred = getattr(default.stylizer, "centred", True)
    if path is not None:
        file = read_style(path, centred=centred)
    else:
        file = StyleFile(StyleConfig())
    if path is not None:
        default = replace(default, **_styles(file.style))
    kind = type(default.stylizer)
    default, args = slots.resolve(default, args)
    if type(default.stylizer) is not kind and hasattr(default.stylizer, "centred"):
        default = slots.replace(default, "stylizer.centred", centred)
    flags = {}
    for name in PRESETS:
        flags[f"--{name}"] = name
    for flag in (arg for arg in args if arg in flags):
        print(f"{flag}: {preset_flags(flags[flag])}")
        default = with_preset(default, flags[flag])
    args = [arg for arg in args if arg not in flags]
    meanings = []
    for flag, name in flags.items():
        meanings.append(f"{flag} stands for {preset_flags(name)}; other flags come over it.")
    about = "\n\n".join([description, *meanings])
    config = parse(default, _joined(args, default), prog=prog, description=about, positional=positional)
    config = with_folders(config, say)
    _say_colours(config)
    file = file._replace(style=StyleConfig(**_styles(config)))
    # Who names photographs takes them as they are now, and masks likewise.
    if path is not None:
        given = set()
        for arg in args:
            given.add(arg.partition("=")[0])
        photographs = () if "--references" in given else config.references
        masks = () if "--masks" in given else config.masks
        check_photographs(path, file._replace(style=replace(file.style, references=photographs, masks=masks)))
    return config, file


def _say_colours(style: StyleConfig) -> None:
    """Say what is decided about the colours of a style's photographs."""
    from ..datamanagers.images import colour_notes

    for note in colour_notes(style.references):
        say(note)


def say(text: str) -> None:
    """A line on standard error."""
    print(text, file=sys.stderr)


def _styles(config: StyleConfig) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for field in fields(StyleConfig):
        found[field.name] = getattr(config, field.name)
    return found


def _joined(args: Sequence[str], config: StyleConfig) -> list[str]:
    """The arguments with each flag of many values once, with all of its values: otherwise the last one alone
    would count.
    """
    many = set()
    for field in fields(config):
        if isinstance(getattr(config, field.name), tuple):
            many.add(f"--{field.name.replace('_', '-')}")
    rest: list[str] = []
    values: dict[str, list[str]] = {}
    into = rest
    for arg in args:
        key, equals, inline = arg.partition("=")
        flag = key.replace("_", "-")
        if flag in many:
            into = values.setdefault(flag, [])
            into += [inline] if equals else []
            continue
        if arg.startswith("-"):
            into = rest
        into.append(arg)
    return [*rest, *(word for flag, words in values.items() for word in (flag, *words))]


def _style_flag(args: Sequence[str]) -> Path | None:
    """The last `--style FILE`; what is wrong with it otherwise, `parse` says."""
    path = None
    for at, arg in enumerate(args):
        key, equals, inline = arg.partition("=")
        if equals:
            value = inline
        else:
            value = "".join(args[at + 1 : at + 2])
        if key == "--style" and value and not value.startswith("-") and value != "none":
            (path,) = expanded([as_path(value)])[:1]
    return path


def named_styles(texts: Sequence[str], base: StyleFile) -> list[tuple[str, StyleFile]]:
    """Styles from NAME=STYLE.json or NAME=PHOTO[,PHOTO ...], by name; photographs go with the other settings
    of `base`.

    Folders stand for the images in them; those that cannot be read are named on standard error. Raises
    UsageError for another form, and what reading a style file raises.
    """
    styles = []
    for text in texts:
        name, equals, what = text.partition("=")
        if not (equals and name and what) or name != tidy(name):
            raise UsageError(
                f"--styles {text}: write NAME=PHOTO,PHOTO or NAME=STYLE.json, with a name of letters, digits, + - and _"
            )
        if what.lower().endswith(".json"):
            file = read_style(as_path(what))
            check_photographs(as_path(what), file)
        else:
            # What names photographs one by one does not carry over to others.
            photographs = named_files(what)
            style = replace(base.style, references=photographs, weights=(), masks=(), pin=(), forbid=())
            file = StyleFile(style)
        style = with_folders(file.style, say)
        _say_colours(style)
        styles.append((name, file._replace(style=style)))
    return styles


def named_files(texts: str) -> tuple[Path, ...]:
    """Files that stand in a flag's text, with commas between them."""
    return expanded([as_path(part) for part in texts.split(",")])


def origin_of(by: str, config: StyleConfig, file: StyleFile, more: Sequence[Path] = ()) -> Origin:
    """Origin of what a verb makes in a style: every file that its flags and its style name, and those of `more`."""
    reads = [*read_paths(config), *read_paths(file.style), *more]
    # A region may be given by a mask over a view: VIEW:MASK.png.
    for text in (*config.pin, *config.forbid, *config.keep, *config.region_strength):
        mask = Path(text.rpartition("=")[0].rpartition(":")[2] or text.rpartition(":")[2])
        if mask.is_file():
            reads.append(mask)
    overwrite = isinstance(config, OverwriteConfig) and config.overwrite
    return Origin(by=by, reads=tuple(path for path in reads if path != NO_MASK), overwrite=overwrite)


def style_name(style: Path | None, references: Sequence[Path]) -> str:
    """Name of a style: that of its file, of a style.json its folder's; without a file the stems of its
    photographs, joined.

    Cut to what every file system takes.
    """
    if style is not None:
        if style.name != "style.json":
            return style.stem
        return style.resolve().parent.name or "style"
    joined = "+".join(path.stem for path in references)
    if len(joined) <= _MAX_JOINED_CHARACTERS:
        return joined
    return f"{joined[:_MAX_JOINED_CHARACTERS]}+{len(references)}"


def tidy(name: str) -> str:
    """A name as file names carry it: letters, digits, + - and _, at most 60."""
    return re.sub(r"[^\w+-]+", "_", name, flags=re.ASCII).strip("_")[:_MAX_CHOSEN_CHARACTERS]
