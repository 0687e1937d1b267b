"""Arguments to a config: slots first, then every field as a flag. Help is tyro's, which is imported for it alone."""

import contextlib
import dataclasses
import difflib
import enum
import math
import os
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, TypeVar, get_args, get_origin

from ..errors import ConfigError, UsageError
from ..methods import load_config, method_config
from ..plugins import registry
from ..plugins.codec import Missing
from ..plugins.slots import Slot, hints_of, is_slot, members, resolve, slots

if TYPE_CHECKING:
    from ..config import RunConfig


C = TypeVar("C")

_COLUMNS = 100
"""Widest help text: a page, not a wide screen."""
_SCALARS = {bool: "True or False", int: "a whole number", float: "a number", str: "a text", Path: "a path", NoneType: "none"}


class Flag(NamedTuple):
    """A leaf of a config tree."""

    path: str
    """Dotted field names."""
    kinds: tuple[Any, ...]
    """The types that it takes, None last."""

    @property
    def text(self) -> str:
        """As it is written on the command line."""
        return f"--{_dashed(self.path)}"

    @property
    def most(self) -> float:
        """Words that it takes, at most."""
        return max(map(_width, self.kinds))

    def value(self, words: Sequence[str]) -> Any:
        """The value that words on the command line mean. Raises UsageError."""
        if not words and bool in self.kinds:
            return True
        for kind in sorted(self.kinds, key=lambda kind: kind is not NoneType):  # None first: `none` is a text as well
            with contextlib.suppress(ValueError, KeyError, TypeError):
                return _convert(words, kind)
        takes = " or ".join(map(_words, self.kinds))
        raise UsageError(f"{' '.join([self.text, *words])}: {'it takes' if words else 'needs a value:'} {takes}")


def flags_of(config: Any, prefix: str = "") -> dict[str, Flag]:
    """Every leaf of the tree by the flag's text."""
    flags: dict[str, Flag] = {}
    for field in dataclasses.fields(config):
        value, path, hint = getattr(config, field.name), f"{prefix}{field.name}", hints_of(type(config))[field.name]
        if dataclasses.is_dataclass(value):
            flags |= flags_of(value, f"{path}.")
        elif not any(is_slot(each) for each in members(hint)):
            flag = Flag(path, tuple(sorted(members(hint), key=lambda kind: kind is NoneType)))
            flags[flag.text] = flag
    return flags


def _width(kind: Any) -> float:
    """Words that a value of a type takes; infinite for any number."""
    origin, args = get_origin(kind), get_args(kind)
    if origin in (list, dict) or args[-1:] == (Ellipsis,):
        return math.inf
    return sum(map(_width, args)) if origin is tuple else 1


def _convert(words: Sequence[str], kind: Any) -> Any:
    """The value of a type that words mean. Raises ValueError, KeyError or TypeError where they mean none."""
    origin, args = get_origin(kind), get_args(kind)
    if origin is dict:
        return dict(_convert(words, tuple[tuple[args], ...]))  # type: ignore[valid-type]  # a word each for key and value
    if origin in (tuple, list):
        # Of any number, as many items as the words are enough for; an item may be of several words itself.
        if origin is list or args[-1] is Ellipsis:
            args = (args[0],) * math.ceil(len(words) / _width(args[0]))
        items, rest = [], list(words)
        for arg in args:
            width = int(_width(arg))
            items.append(_convert(rest[:width], arg))
            del rest[:width]
        if rest:
            raise ValueError(rest)
        return origin(items)
    (word,) = words
    if origin is Literal:
        return {str(value): value for value in args}[word]
    if kind is bool or kind is NoneType:
        return ({"true": True, "false": False} if kind is bool else {"none": None})[word.lower()]
    return kind[word] if issubclass(kind, enum.Enum) else kind(word)


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


def _dashed(key: str) -> str:
    return key.replace("_", "-")


def _words(hint: Any) -> str:
    """A type in words."""
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


def parse(default: C, args: Sequence[str], *, prog: str, description: str, positional: tuple[str, ...] = ()) -> C:
    """The default, a frozen dataclass tree, changed by the arguments.

    `--path.to.slot NAME` chooses a plug-in, `--path.to.field VALUE` sets a field, in any order and also with `=`. `none`
    empties what may be None; a bare `--path.switch` is true, `--path.no-switch` false. A flag of any number of values takes
    those of all places where it stands. Fields named in `positional` are given without a flag, in that order, and must be given
    unless they are None or empty. `--help` prints all of it and exits. Raises UsageError, PluginError or ConfigError with one
    line.
    """
    # Slots first: what fills them decides which flags there are.
    config, rest = resolve(default, args)
    for slot in slots(config):
        if isinstance(slot.value, Missing):
            slot.value.build()
    if {"-h", "--help"} & {*rest}:
        _print_help(config, prog, description, positional)
    every = {flag.path: flag for flag in flags_of(config).values()}
    flags = {flag.text: flag for flag in every.values() if flag.path not in positional}
    # The words of each flag; those that no flag takes are the positional fields'.
    given: dict[str, list[str]] = {}
    loose: list[str] = []
    into, room, switch = loose, 0.0, False
    for arg in rest:
        key, equals, inline = arg.partition("=")
        if arg.startswith("--"):
            flag = flags.get(_dashed(key))
            opposite = flags.get(re.sub(r"(^--|\.)no-(?=[^.]*$)", r"\1", _dashed(arg)))
            if flag is None and opposite is not None and bool in opposite.kinds:
                given[opposite.path], room = ["false"], 0.0
                continue
            if flag is None:
                raise UsageError(_unknown(key, config, flags, prog))
            into = [*(given.get(flag.path, ()) if flag.most == math.inf else ()), *([inline] if equals else [])]
            given[flag.path] = into
            room, switch = flag.most - (1 if equals else 0), bool in flag.kinds
        elif room > 0 and not (switch and arg.lower() not in ("true", "false", "none")):
            into.append(arg)
            room -= 1
        else:
            loose.append(arg)
            room = 0.0
    for path in positional:
        most = every[path].most
        count = len(loose) if most == math.inf else int(most)
        if loose:
            given[path], loose = loose[:count], loose[count:]
        elif getattr(config, path) not in (None, ()):
            raise UsageError(f"{prog}: {path.upper()} is missing; `{prog} --help` says what it takes")
    if loose:
        raise UsageError(f"{loose[0]!r}: belongs to no flag; `{prog} --help` lists the flags")
    # Words become values when all flags are known to exist, so that an unknown one is told first.
    values = {path: every[path].value(words) for path, words in given.items()}
    try:
        return _changed(config, values)
    except ConfigError as fault:
        # A range error names its field; here the flag that caused it, where the arguments tell which.
        field, _, reason = str(fault).partition(": ")
        fits = [every[path].text for path in values if f".{path}".endswith(f".{field}")]
        raise ConfigError(f"{fits[0]}: {reason}" if len(fits) == 1 and reason else str(fault)) from fault


def _changed(config: C, values: dict[str, Any], prefix: str = "") -> C:
    """A config tree with other leaves, by their paths; each dataclass is made once, since its checks see all of its fields."""
    changes = {}
    for field in dataclasses.fields(config):  # type: ignore[arg-type]  # a dataclass by contract
        path, value = f"{prefix}{field.name}", getattr(config, field.name)
        if path in values:
            changes[field.name] = values[path]
        elif any(each.startswith(f"{path}.") for each in values):
            changes[field.name] = _changed(value, values, f"{path}.")
    return dataclasses.replace(config, **changes)  # type: ignore[type-var]


def load_method(name: str) -> "tuple[RunConfig, str]":
    """The config of a method, or of a saved `config.json` with the name of the method that it started from."""
    if name.endswith(".json"):
        return load_config(Path(name))
    if (Path(name) / "config.json").is_file() and name not in registry.installed("fprf.methods"):
        raise UsageError(f"{name}: is a folder, not a method; to train with its config name {Path(name) / 'config.json'}")
    return method_config(name), name


def _print_help(config: Any, prog: str, description: str, positional: tuple[str, ...]) -> None:
    """Print every flag and exit; fields that are positional are marked as such in a copy of the config's class."""
    import tyro

    tyro.extras.set_accent_color("cyan")
    kind, hints, marked = type(config), hints_of(type(config)), []
    for name in positional:
        hint = None if getattr(config, name) in (None, ()) else "(required)"
        arg = tyro.conf.arg(metavar=name.upper(), help_behavior_hint=hint)
        marked.append((name, Annotated[hints[name], tyro.conf.Positional, arg]))
    unchecked = {"__post_init__": lambda self: None, "__doc__": kind.__doc__}
    copy = dataclasses.make_dataclass(kind.__name__, marked, bases=(kind,), namespace=unchecked, frozen=True, kw_only=True)
    shown = copy(**{field.name: getattr(config, field.name) for field in dataclasses.fields(config)})
    chosen = _slot_flags(list(slots(config)))

    def main(config: Any, plug_ins: Any) -> None:
        """Only its arguments count."""

    main.__defaults__ = (shown, chosen)
    main.__annotations__ = {  # name="" and not OmitArgPrefixes for the config: that one strips every nested prefix
        "config": Annotated[copy, tyro.conf.arg(name="")],
        "plug_ins": Annotated[type(chosen), tyro.conf.arg(name="plug-in"), tyro.conf.OmitArgPrefixes],
    }
    # Help is set for a page, not for a wide screen; tyro asks the environment for the width.
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(min(_COLUMNS, shutil.get_terminal_size((_COLUMNS, 24)).columns))
    markers = (tyro.conf.AvoidSubcommands, tyro.conf.FlagConversionOff)
    try:
        tyro.cli(main, args=["--help"], prog=prog, description=description, config=markers)
    finally:
        del os.environ["COLUMNS"]
        os.environ |= {} if before is None else {"COLUMNS": before}


def _slot_flags(filled: list[Slot]) -> Any:
    """A dataclass that only adds the slot flags to the help text: `resolve` has taken them already."""
    import tyro

    rows: list[tuple[str, Any, Any]] = []
    for slot in filled:
        about = f"{first_line(slot.kind)} One of {', '.join(slot.choices)}."
        arg = tyro.conf.arg(name=slot.path, metavar="NAME", help=about)
        rows.append((slot.path.replace(".", "_"), Annotated[str, arg], dataclasses.field(default=_filled_by(slot))))
    kind = dataclasses.make_dataclass("PlugIns", rows, frozen=True, kw_only=True)
    kind.__doc__ = "What fills each slot, by name; its own fields are flags above. `fprf plugins` lists all."
    return kind()


def _filled_by(slot: Slot) -> str:
    """Name of what fills a slot now."""
    return "none" if slot.value is None else registry.name_of(slot.kind.group, type(slot.value))


def first_line(documented: object) -> str:
    """The first line of a docstring."""
    return (documented.__doc__ or "").strip().partition("\n")[0]
