"""The flags of a config tree, and what a user's mistake with one of them is called.

tyro parses; where it refuses, it explains itself in a box. `explain` says the same in one line: where, what was found,
what is allowed.
"""

import dataclasses
import difflib
import enum
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args, get_origin

from ..plugins.registry import name_of
from ..plugins.slots import hints_of, is_slot, members, slots

__all__ = ["Flag", "explain", "flags_of", "spell"]

_MANY = -1


class Flag(NamedTuple):
    """A leaf of a config tree."""

    path: str
    """Dotted field names."""
    hint: Any

    @property
    def text(self) -> str:
        """As it is written on the command line."""
        return "--" + self.path.replace("_", "-")

    @property
    def optional(self) -> bool:
        """None is allowed."""
        return type(None) in members(self.hint)

    @property
    def boolean(self) -> bool:
        """It is true or false."""
        return bool in members(self.hint)

    @property
    def arity(self) -> int:
        """Values that follow it; _MANY if that varies."""
        counts = {_count(hint) for hint in members(self.hint) if hint is not type(None)}
        return counts.pop() if len(counts) == 1 else _MANY

    @property
    def takes(self) -> str:
        """Its values in words."""
        return " or ".join("none" if hint is type(None) else _words(hint) for hint in _none_last(members(self.hint)))


def flags_of(config: Any, prefix: str = "") -> dict[str, Flag]:
    """Every leaf of the tree by the flag's text."""
    flags: dict[str, Flag] = {}
    for field in dataclasses.fields(config):
        value, path, hint = getattr(config, field.name), f"{prefix}{field.name}", hints_of(type(config))[field.name]
        if dataclasses.is_dataclass(value):
            flags |= flags_of(value, f"{path}.")
        elif not any(is_slot(each) for each in members(hint)):
            flag = Flag(path, hint)
            flags[flag.text] = flag
    return flags


def spell(args: Sequence[str], flags: dict[str, Flag]) -> list[str]:
    """The arguments as tyro spells them.

    `none` is None, `true` is True, a bare `--path.switch` is `--path.switch True`, `--path.no-switch` is its opposite.
    """
    spelled: list[str] = []
    for at, arg in enumerate(args):
        key, equals, inline = arg.partition("=")
        flag = flags.get(_dashed(key))
        if flag and equals:
            spelled.append(f"{key}={_literal(inline, flag)}")
        elif flag and flag.boolean and args[at + 1 : at + 2] not in (*_TRUTHS, *(_NONES if flag.optional else ())):
            spelled += [arg, "True"]
        elif (opposite := flags.get(re.sub(r"(^--|\.)no-(?=[^.]*$)", r"\1", _dashed(arg)))) and not flag and opposite.boolean:
            spelled += [opposite.text, "False"]
        elif at and not arg.startswith("--") and (before := flags.get(_dashed(args[at - 1]))):
            spelled.append(_literal(arg, before))
        else:
            spelled.append(arg)
    return spelled


def explain(refusal: str, config: Any, args: Sequence[str], *, positional: Sequence[str], prog: str) -> str:
    """One line for what tyro refused: an unknown flag, a value that does not fit, a value too many or too few."""
    flags = flags_of(config)
    for arg in args:
        key = arg.partition("=")[0]
        if re.match(r"--[a-zA-Z]", key) and _dashed(key) not in flags:
            return _unknown(key, config, flags, prog)
    text = _plain(refusal)
    for flag in flags.values():
        if re.search(rf"(?<![\w.-]){re.escape(flag.text)}(?![\w.-])", text):
            given = _given(flag, args)
            return f"{' '.join([flag.text, *given])}: {'it takes' if given else 'needs a value:'} {flag.takes}"
    if "equired" in text and positional:
        return f"{prog}: {positional[0].upper()} is missing; `{prog} --help` says what it takes"
    if stray := re.search(r"Unrecognized options: (.*?)(?: Perhaps | For full |$)", text):
        return f"{stray[1]!r}: belongs to no flag; `{prog} --help` lists the flags"
    return text


def _unknown(key: str, config: Any, flags: dict[str, Flag], prog: str) -> str:
    """Message for an unknown flag. Below a slot, its plug-in decides which fields there are."""
    lists = f"; `{prog} --help` lists all"
    within = [slot for slot in slots(config) if _dashed(key).startswith(f"--{slot.path.replace('_', '-')}.")]
    if within:
        slot = within[-1]
        if slot.value is None:
            return f"{key}: {slot.path} is none; choose one with --{slot.path} NAME"
        flags = {text: flag for text, flag in flags.items() if flag.path.startswith(f"{slot.path}.")}
        name = name_of(slot.kind.group, type(slot.value))
        lists = f"; {slot.path} is {name}, which takes {', '.join(flags) or 'no flags'}"
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
            values = ([inline] if equals else []) if inside else values
        elif inside:
            values.append(arg)
    return values if flag.arity == _MANY else values[: max(flag.arity, 1)]


def _literal(value: str, flag: Flag) -> str:
    if value == "none" and flag.optional:
        return "None"
    if value in ("true", "false") and flag.boolean:
        return value.capitalize()
    return value


def _dashed(key: str) -> str:
    return key.replace("_", "-")


def _plain(refusal: str) -> str:
    """Text of a box: no frame, no colours, one line."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", refusal)
    return " ".join(re.sub(r"[╭╮╰╯│─]|-{3,}", " ", text).split())


def _count(hint: Any) -> int:
    if get_origin(hint) is tuple and Ellipsis not in get_args(hint):
        counts = [_count(each) for each in get_args(hint)]
        return _MANY if _MANY in counts else sum(counts)
    return _MANY if get_origin(hint) in (tuple, list, dict) else 1


def _none_last(hints: Sequence[Any]) -> list[Any]:
    return sorted(hints, key=lambda hint: hint is type(None))


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


_TRUTHS = (["True"], ["False"], ["true"], ["false"])
_NONES = (["none"], ["None"])
_SCALARS = {bool: "True or False", int: "a whole number", float: "a number", str: "a text", Path: "a path"}
