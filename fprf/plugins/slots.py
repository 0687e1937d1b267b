"""Slots of a config tree: where they are, and how `--path NAME` fills them.

A slot is a field annotated with an abstract `PluginConfig` (one that sets `group`), or with that or None.
"""

import dataclasses
import types
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

from ..errors import ConfigError, PluginError, UsageError
from . import registry
from .config import PluginConfig

C = TypeVar("C")


class Slot(NamedTuple):
    """A place in a config tree that a plug-in fills."""

    path: str
    """Dotted, for example `semantic.encoder`."""
    kind: type[PluginConfig]
    """The abstract config that whatever fills it derives from."""
    value: Any
    """The config that fills it now, or None."""
    optional: bool
    """None is allowed."""

    @property
    def choices(self) -> list[str]:
        """Choices of `--path`: the names of its kind, and `none` where that is allowed."""
        names = registry.choices(self.kind.group, self.kind)
        return [*names, "none"] if self.optional else names


def members(hint: Any) -> tuple[Any, ...]:
    """The alternatives of a union; the hint itself otherwise."""
    if get_origin(hint) in (Union, types.UnionType):
        return get_args(hint)
    return (hint,)


def is_slot(hint: Any) -> bool:
    """True for an abstract plug-in config: one that sets `group` itself."""
    return isinstance(hint, type) and issubclass(hint, PluginConfig) and "group" in hint.__dict__


def hints_of(cls: type) -> dict[str, Any]:
    """Types of a dataclass's fields. Raises PluginError where an annotation cannot be resolved."""
    try:
        return get_type_hints(cls)
    except Exception as error:  # names in a stranger's annotations are evaluated here
        raise PluginError(
            f"{cls.__module__}:{cls.__qualname__}: its field types cannot be resolved ({error}); "
            "types of config fields must be importable at run time"
        ) from error


def slots(config: Any, prefix: str = "") -> Iterator[Slot]:
    """Every slot of a config tree, outer before inner, in the order of declaration."""
    hints = hints_of(type(config))
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        path = f"{prefix}{field.name}"
        choices = members(hints[field.name])
        for kind in filter(is_slot, choices):
            yield Slot(path, kind, value, type(None) in choices)
        if dataclasses.is_dataclass(value):
            yield from slots(value, f"{path}.")


def replace(config: C, path: str, value: object) -> C:
    """`dataclasses.replace` along a dotted path."""
    # From the inside out, each level as a copy.
    head, _, rest = path.partition(".")
    if rest:
        inner = replace(getattr(config, head), rest, value)
    else:
        inner = value
    changed: C = dataclasses.replace(config, **{head: inner})  # type: ignore[type-var]  # C is a dataclass by contract
    return changed


def take_flag(args: Sequence[str], flag: str) -> tuple[str | None, list[str]]:
    """Value of `--flag V` or `--flag=V` (the last one wins), and the other arguments. '-' and '_' are one
    letter.
    """
    value: str | None = None
    rest: list[str] = []
    # Flags of other slots and of fields are left for whoever knows them.
    waiting = iter(args)
    for arg in waiting:
        key, equals, inline = arg.partition("=")
        if not key.startswith("--") or key[2:].replace("_", "-") != flag.replace("_", "-"):
            rest.append(arg)
            continue
        value = inline if equals else next(waiting, "")
        if not value or value.startswith("-"):
            raise UsageError(f"--{flag}: needs the name of a plug-in; `fprf plugins` lists them")
    return value, rest


def _of_number(slot: Slot, text: str) -> PluginConfig | None:
    """The config that a number in the place of a name stands for; None where it is none, or stands for
    nothing.
    """
    if not text.isdecimal() or text in slot.choices:
        return None
    try:
        return slot.kind.of_number(int(text))
    except ConfigError as error:
        raise ConfigError(f"--{slot.path}: {error}") from error


def resolve(config: C, args: Sequence[str]) -> tuple[C, list[str]]:
    """Apply the slot flags among the arguments, outermost first, so that a chosen plug-in may bring slots of
    its own.

    Naming the plug-in that is there keeps the values it has; another one starts from its own defaults.
    """
    rest = list(args)
    seen = set[str]()
    while todo := [slot for slot in slots(config) if slot.path not in seen]:
        slot = todo[0]
        seen.add(slot.path)
        name, rest = take_flag(rest, slot.path)
        if name is None:
            continue
        # Nothing, the plug-in that is there, or another one.
        if name == "none":
            if not slot.optional:
                raise UsageError(f"--{slot.path}: cannot be none; allowed are {', '.join(slot.choices)}")
            config = replace(config, slot.path, None)
            continue
        numbered = _of_number(slot, name)
        if numbered is not None:
            config = replace(config, slot.path, numbered)
            continue
        try:
            if type(slot.value) is not registry.load(slot.kind.group, name, slot.kind):
                config = replace(config, slot.path, registry.make(slot.kind.group, name, slot.kind))
        except PluginError as error:
            raise PluginError(f"--{slot.path}: {error}") from error
    return config, rest
