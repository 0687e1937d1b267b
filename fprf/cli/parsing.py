"""Arguments to a config: slots first, then every field as a flag, by tyro."""

import contextlib
import dataclasses
import difflib
import enum
import io
import math
import os
import re
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, TypeVar, get_args, get_origin

from ..config_files import load_config, method_config
from ..errors import ConfigError, UsageError
from ..io.paths import as_path, expanded, has_wildcards
from ..plugins import registry
from ..plugins.codec import Missing
from ..plugins.slots import Slot, hints_of, is_slot, members, resolve, slots

if TYPE_CHECKING:
    from ..run_config import RunConfig


C = TypeVar("C")

COMPLETING = "--fprf-complete"
"""Among the arguments: `parse` raises Completing in the place of parsing them."""
_MAX_HELP_COLUMNS = 100
"""Widest help text: a page, not a wide screen."""
_TRUTHS = (["True"], ["False"], ["true"], ["false"])
_NONES = (["none"], ["None"])
_SCALARS = {
    bool: "True or False",
    int: "a whole number",
    float: "a number",
    str: "a text",
    Path: "a path",
    type(None): "none",
}


class Completing(Exception):
    """The config whose flags a command line may have, for the completion of shells."""

    def __init__(self, config: Any, positional: tuple[str, ...]) -> None:
        super().__init__()
        self.config = config
        self.positional = positional


class Flag(NamedTuple):
    """A leaf of a config tree."""

    path: str
    """Dotted field names."""
    kinds: tuple[Any, ...]
    """The types that it takes, None last."""
    owner: Any
    """The config that holds it."""

    @property
    def text(self) -> str:
        """As it is written on the command line."""
        return f"--{_dashed(self.path)}"

    @property
    def most(self) -> float:
        """Number of values that it takes, at most."""
        most = 1.0
        for kind in self.kinds:
            args = get_args(kind)
            if get_origin(kind) is list or Ellipsis in args:
                return math.inf
            if get_origin(kind) is tuple:
                most = float(len(args))
        return most

    @property
    def takes(self) -> str:
        """Its values in words."""
        return " or ".join(map(_words, self.kinds))


def flags_of(config: Any, prefix: str = "") -> dict[str, Flag]:
    """Every leaf of the tree by the flag's text."""
    flags: dict[str, Flag] = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        path = f"{prefix}{field.name}"
        hint = hints_of(type(config))[field.name]
        if dataclasses.is_dataclass(value):
            flags |= flags_of(value, f"{path}.")
        elif not any(is_slot(each) for each in members(hint)):
            flag = Flag(path, tuple(sorted(members(hint), key=lambda kind: kind is type(None))), config)
            flags[flag.text] = flag
    return flags


def spell(args: Sequence[str], flags: dict[str, Flag]) -> list[str]:
    """The arguments as tyro spells them.

    `none` is None, `true` is True, a bare `--path.switch` is `--path.switch True`, `--path.no-switch` is its
    opposite.
    """
    spelled: list[str] = []
    for at, arg in enumerate(args):
        key, equals, inline = arg.partition("=")
        flag = flags.get(_dashed(key))
        opposite = flags.get(re.sub(r"(^--|\.)no-(?=[^.]*$)", r"\1", _dashed(arg)))
        before = flags.get(_dashed(args[at - 1])) if at else None
        if flag and equals:  # --field=VALUE
            spelled.append(f"{key}={_literal(inline, flag)}")
        elif flag and bool in flag.kinds:  # --switch, --switch true
            truth_follows = args[at + 1 : at + 2] in _TRUTHS
            none_follows = type(None) in flag.kinds and args[at + 1 : at + 2] in _NONES
            spelled.append(arg)
            if not truth_follows and not none_follows:
                spelled.append("True")
        elif not flag and opposite and bool in opposite.kinds:  # --no-switch
            spelled += [opposite.text, "False"]
        elif before and not arg.startswith("--"):  # the value of the flag before it
            spelled.append(_literal(arg, before))
        else:
            spelled.append(arg)
    return spelled


_WRITTEN = ("output", "page", "cache", "tensorboard")
"""Fields of verbs that name what is written; every other path is read."""


def read_paths(config: Any) -> tuple[Path, ...]:
    """Files and folders that a config names to be read."""
    paths: list[Path] = []
    for flag in flags_of(config).values():
        name = flag.path.rpartition(".")[2]
        value = getattr(flag.owner, name)
        if name in _WRITTEN:
            continue
        values = value if isinstance(value, tuple) else (value,)
        paths.extend(each for each in values if isinstance(each, Path))
    return tuple(paths)


def spell_paths(args: Sequence[str], flags: dict[str, Flag], positional: Sequence[Flag]) -> list[str]:
    """The arguments, as `spell` returns them, with the home folder for `~` and files for wildcards, wherever
    paths are taken.

    Raises UsageError where nothing matches, and where several files match that are to be one.
    """
    spelled: list[str] = []
    current: Flag | None = None
    room = 0.0  # values that the flag still takes
    places = list(positional)
    for arg in args:
        key, equals, inline = arg.partition("=")
        if key.startswith("--"):
            current = flags.get(_dashed(key))
            room = 0.0 if current is None else current.most
            values = [arg]
            if current is not None and equals:
                found = _paths(inline, current)
                if len(found) == 1:
                    values = [f"{key}={found[0]}"]
                else:
                    values = [key, *found]
                room = 0.0
            spelled += values
            continue
        if room > 0:
            room -= 1
            spelled += [arg] if current is None else _paths(arg, current)
            continue
        spelled += _paths(arg, places[0]) if places else [arg]
        if places and places[0].most == 1:
            places.pop(0)
    return spelled


def _paths(word: str, flag: Flag) -> list[str]:
    """The words for one word among the values of a flag."""
    several = any(Path in get_args(kind) for kind in flag.kinds)
    if word == "none" or not (several or Path in flag.kinds):
        return [word]
    path = as_path(word)
    if word.startswith("~"):
        word = str(path)
    if flag.path.rpartition(".")[2] in _WRITTEN or not has_wildcards(path):
        return [word]
    found = [str(each) for each in expanded([path])]
    if len(found) > 1 and not several:
        raise UsageError(
            f"{word}: {len(found)} files match, such as {found[0]} and {found[1]}; name one of them"
        )
    return [f".{os.sep}{each}" if each.startswith("-") else each for each in found]


def explain(refusal: str, config: Any, args: Sequence[str], *, positional: Sequence[str], prog: str) -> str:
    """One line for what tyro refused: an unknown flag, a value that does not fit, a value too many or too
    few.
    """
    flags = flags_of(config)
    # An unknown flag first: it is named whatever else is wrong.
    for arg in args:
        key = arg.partition("=")[0]
        if re.match(r"--[a-zA-Z]", key) and _dashed(key) not in flags:
            return _unknown(key, config, flags, prog)
    # The text of the box, without its frame and colours, in one line.
    text = re.sub(r"\x1b\[[0-9;]*m", "", refusal)
    text = " ".join(re.sub(r"[╭╮╰╯│─]|-{3,}", " ", text).split())
    for flag in flags.values():
        if re.search(rf"(?<![\w.-]){re.escape(flag.text)}(?![\w.-])", text):
            given = _given(flag, args)
            return (
                f"{' '.join([flag.text, *given])}: {'it takes' if given else 'needs a value:'} {flag.takes}"
            )
    if "equired" in text and positional:
        return f"{prog}: {positional[0].upper()} is missing; `{prog} --help` says what it takes"
    if stray := re.search(r"Unrecognized options: (.*?)(?: Perhaps | For full |$)", text):
        return f"{stray[1]!r}: belongs to no flag; `{prog} --help` lists the flags"
    return text


def _unknown(key: str, config: Any, flags: dict[str, Flag], prog: str) -> str:
    """Message for an unknown flag. Below a slot, its plug-in decides which fields there are."""
    lists = f"; `{prog} --help` lists all"
    within = [slot for slot in slots(config) if _dashed(key).startswith(f"--{_dashed(slot.path)}.")]
    if within:
        slot = within[-1]
        if slot.value is None:
            return f"{key}: {slot.path} is none; choose one with --{slot.path} NAME"
        flags = {text: flag for text, flag in flags.items() if flag.path.startswith(f"{slot.path}.")}
        lists = f"; {slot.path} is {_filled_by(slot)}, which takes {', '.join(flags) or 'no flags'}"
    close = difflib.get_close_matches(_dashed(key), flags, n=1, cutoff=0.8)
    return f"{key}: no such flag{f'; did you mean {close[0]}?' if close else lists}"


def _given(flag: Flag, args: Sequence[str]) -> list[str]:
    """The values that the user gave to the flag, the last time that it stands there."""
    values: list[str] = []
    inside = False
    for arg in args:
        key, equals, inline = arg.partition("=")
        if arg.startswith("--"):
            inside = _dashed(key) == flag.text
            if inside:
                values = [inline] if equals else []
        elif inside:
            values.append(arg)
    several = any(get_origin(kind) in (tuple, list, dict) for kind in flag.kinds)
    return values if several else values[:1]


def _literal(value: str, flag: Flag) -> str:
    if value == "none" and type(None) in flag.kinds:
        return "None"
    if value in ("true", "false") and bool in flag.kinds:
        return value.capitalize()
    return value


def _dashed(key: str) -> str:
    return key.replace("_", "-")


def _words(hint: Any) -> str:
    args = get_args(hint)
    if get_origin(hint) is Literal:
        return " or ".join(map(str, args))
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return " or ".join(member.name for member in hint)
    if get_origin(hint) is list or (args and args[-1] is Ellipsis):
        return f"any number of values, each {_words(args[0])}"
    if get_origin(hint) is tuple:
        return f"{len(args)} values ({', '.join(map(_words, args))})"
    return _SCALARS.get(hint, str(hint))


def parse(
    default: C, args: Sequence[str], *, prog: str, description: str, positional: tuple[str, ...] = ()
) -> C:
    """The default, a frozen dataclass tree, changed by the arguments.

    `--path.to.slot NAME` chooses a plug-in, `--path.to.field VALUE` sets a field, in any order and also with
    `=`; `none` empties whatever may be None. Fields named in `positional` are given without a flag, in that
    order, and must be given. `--help` prints all of it and exits. Raises UsageError, PluginError or
    ConfigError with one line.
    """
    # Slots first: what fills them decides which flags there are.
    config, rest = resolve(default, args)
    if COMPLETING in rest:
        raise Completing(config, positional)
    for slot in slots(config):
        if isinstance(slot.value, Missing):
            slot.value.build()
    flags = {}
    for text, flag in flags_of(config).items():
        if flag.path not in positional:
            flags[text] = flag
    rest = spell(rest, flags)
    every = flags_of(config)
    rest = spell_paths(rest, flags, [every[f"--{_dashed(name)}"] for name in positional])
    # What tyro says of a mistake is a box of many lines; ours is one.
    heard = io.StringIO()
    try:
        with contextlib.redirect_stderr(heard), _page_width():
            parsed = _tyro(config, rest, prog=prog, description=description, positional=positional)
    except SystemExit as end:
        if not end.code:
            raise
        raise UsageError(explain(heard.getvalue(), config, rest, positional=positional, prog=prog)) from None
    except ConfigError as fault:
        # A range error names its field; here the flag that caused it, where the arguments tell which.
        field, _, reason = str(fault).partition(": ")
        given = set()
        for arg in rest:
            if arg.startswith("--"):
                given.add(_dashed(arg.partition("=")[0]))
        fits = []
        for text, flag in flags.items():
            if text in given and f".{flag.path}".endswith(f".{field}"):
                fits.append(text)
        raise ConfigError(f"{fits[0]}: {reason}" if len(fits) == 1 and reason else str(fault)) from fault
    sys.stderr.write(heard.getvalue())
    return parsed


def load_method(name: str) -> "tuple[RunConfig, str]":
    """The config of a method, or of a saved `config.json` with the name of the method that it started
    from.
    """
    if name.endswith(".json"):
        return load_config(as_path(name))
    if (Path(name) / "config.json").is_file() and name not in registry.installed("fprf.methods"):
        raise UsageError(
            f"{name}: is a folder, not a method; to train with its config name {Path(name) / 'config.json'}"
        )
    return method_config(name), name


def _tyro(config: C, args: list[str], *, prog: str, description: str, positional: tuple[str, ...]) -> C:
    import tyro

    tyro.extras.set_accent_color("cyan")
    shown = _with_positional(config, positional)
    chosen = _slot_flags(list(slots(config)))

    def main(config: Any, plug_ins: Any) -> Any:
        return config

    main.__defaults__ = (shown, chosen)
    # name="" and not OmitArgPrefixes for the config: that one strips every nested prefix
    main.__annotations__ = {
        "config": Annotated[type(shown), tyro.conf.arg(name="")],
        "plug_ins": Annotated[type(chosen), tyro.conf.arg(name="plug-in"), tyro.conf.OmitArgPrefixes],
    }
    markers = (tyro.conf.AvoidSubcommands, tyro.conf.FlagConversionOff)
    parsed = tyro.cli(main, args=args, prog=prog, description=description, config=markers)
    # Back to the config's own class, which checks the ranges.
    values = {}
    for field in dataclasses.fields(parsed):
        values[field.name] = getattr(parsed, field.name)
    return type(config)(**values)


def _with_positional(config: Any, names: tuple[str, ...]) -> Any:
    """The config with some fields marked as positional, in a subclass that checks nothing yet; None and ()
    can be left out.
    """
    import tyro

    if not names:
        return config
    hints = hints_of(type(config))
    optional = (None, ())
    marked = []
    for name in names:
        hint = None
        if getattr(config, name) not in optional:
            hint = "(required)"
        arg = tyro.conf.arg(metavar=name.upper(), help_behavior_hint=hint)
        marked.append((name, Annotated[hints[name], tyro.conf.Positional, arg]))
    kind = dataclasses.make_dataclass(
        type(config).__name__,
        marked,
        bases=(type(config),),
        namespace={"__post_init__": lambda self: None, "__doc__": type(config).__doc__},
        frozen=True,
        kw_only=True,
    )
    values = {}
    for field in dataclasses.fields(config):
        values[field.name] = getattr(config, field.name)
    return kind(**values | {name: tyro.MISSING for name in names if values[name] not in optional})


def _slot_flags(filled: list[Slot]) -> Any:
    """A dataclass that only adds the slot flags to the help text: `resolve` has taken them already."""
    import tyro

    rows: list[tuple[str, Any, Any]] = []
    for slot in filled:
        about = f"{first_line(slot.kind)} One of {', '.join(slot.choices)}."
        arg = tyro.conf.arg(name=slot.path, metavar="NAME", help=about)
        rows.append(
            (slot.path.replace(".", "_"), Annotated[str, arg], dataclasses.field(default=_filled_by(slot)))
        )
    kind = dataclasses.make_dataclass("PlugIns", rows, frozen=True, kw_only=True)
    kind.__doc__ = "What fills each slot, by name; its own fields are flags above. `fprf plugins` lists all."
    return kind()


def _filled_by(slot: Slot) -> str:
    """Name of what fills a slot now."""
    if slot.value is None:
        return "none"
    return registry.name_of(slot.kind.group, type(slot.value))


def first_line(documented: object) -> str:
    """The first line of a docstring."""
    return (documented.__doc__ or "").strip().partition("\n")[0]


@contextlib.contextmanager
def _page_width() -> Iterator[None]:
    """Help is set for a page, not for a wide screen; tyro asks the environment for the width."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(
        min(_MAX_HELP_COLUMNS, shutil.get_terminal_size((_MAX_HELP_COLUMNS, 24)).columns)
    )
    try:
        yield
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before
