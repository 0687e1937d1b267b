"""Arguments to a config: slots first, then every field as a flag, by tyro."""

import ast
import contextlib
import dataclasses
import inspect
import io
import json
import os
import shutil
import sys
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from ..errors import ConfigError, PluginError, UsageError
from ..plugins import registry
from ..plugins.codec import Missing, load_config, method_config
from ..plugins.slots import Slot, hints_of, resolve, slots
from .flags import Flag, explain, flags_of, spell

if TYPE_CHECKING:
    from ..config import RunConfig, TrainConfig

__all__ = ["DESCRIBE", "LIST_FLAGS", "describe", "load_field_method", "load_method", "meanings", "methods", "parse"]

C = TypeVar("C")
LIST_FLAGS = "--list-flags"
"""Asks any verb for its flags, one a line: for shells that complete them."""
DESCRIBE = "--describe"
"""Asks any verb for all of its flags with their meanings, as JSON."""
_COLUMNS = 100


def parse(default: C, args: Sequence[str], *, prog: str, description: str, positional: tuple[str, ...] = ()) -> C:
    """The default, a frozen dataclass tree, changed by the arguments.

    `--path.to.slot NAME` chooses a plug-in, `--path.to.field VALUE` sets a field, in any order and also with `=`;
    `none` empties whatever may be None. Fields named in `positional` are given without a flag, in that order, and must
    be given. `--help` prints all of it and exits. Raises UsageError, PluginError or ConfigError with one line.
    """
    if LIST_FLAGS in args:
        print("\n".join(sorted({*flags_of(default), *(f"--{slot.path.replace('_', '-')}" for slot in slots(default))})))
        raise SystemExit(0)
    if DESCRIBE in args:
        print(describe(default, prog=prog, description=description, positional=positional))
        raise SystemExit(0)
    config, rest = resolve(default, args)
    for slot in slots(config):
        if isinstance(slot.value, Missing):
            slot.value.build()
    flags = flags_of(config)
    if positional:
        flags = {text: flag for text, flag in flags.items() if flag.path not in positional}
    rest = spell(rest, flags)
    heard = io.StringIO()
    try:
        with contextlib.redirect_stderr(heard), _width(_COLUMNS):
            parsed = _tyro(config, rest, prog=prog, description=description, positional=positional)
    except SystemExit as end:
        if not end.code:
            raise
        raise UsageError(explain(heard.getvalue(), config, rest, positional=positional, prog=prog)) from None
    except ConfigError as fault:
        raise ConfigError(_located(str(fault), flags, rest)) from fault
    sys.stderr.write(heard.getvalue())
    return parsed


def load_method(name: str) -> "tuple[RunConfig, str]":
    """The config of a method, or of a saved `config.json` with the name of the method that it started from."""
    from ..config import IncompleteConfig

    if name.endswith(".json"):
        config, method = load_config(Path(name))
        if isinstance(config, IncompleteConfig):
            package = json.loads(config.packages)["method"]
            raise PluginError(f"{name}: {config.reason}; to train with this config install {package}")
        return config, method
    if (Path(name) / "config.json").is_file() and name not in registry.installed("fprf.methods"):
        raise UsageError(f"{name}: is a folder, not a method; to train with its config name {Path(name) / 'config.json'}")
    return method_config(name), name


def load_field_method(name: str) -> "tuple[TrainConfig, str]":
    """The same for what is made of fields alone. Raises UsageError for a method of another kind."""
    config, method = load_method(name)
    return config.fields_only(Path(name)), method


def methods() -> Iterator[tuple[str, str]]:
    """Names of the installed methods with the first line of their documentation; a broken one says so instead."""
    for name in registry.installed("fprf.methods"):
        try:
            lines = (registry.load_object("fprf.methods", name).__doc__ or "").strip().splitlines()
        except PluginError as fault:
            lines = [f"(broken) {fault}"]
        yield name, lines[0] if lines else ""


def _tyro(config: C, args: list[str], *, prog: str, description: str, positional: tuple[str, ...]) -> C:
    import tyro

    tyro.extras.set_accent_color("cyan")
    shown, chosen = _with_positional(config, positional), _slot_flags(list(slots(config)))

    def main(config: Any, plug_ins: Any) -> Any:
        return config

    main.__defaults__ = (shown, chosen)
    main.__annotations__ = {  # name="" and not OmitArgPrefixes for the config: that one strips every nested prefix
        "config": Annotated[type(shown), tyro.conf.arg(name="")],
        "plug_ins": Annotated[type(chosen), tyro.conf.arg(name="plug-in"), tyro.conf.OmitArgPrefixes],
    }
    markers = (tyro.conf.AvoidSubcommands, tyro.conf.FlagConversionOff)
    parsed = tyro.cli(main, args=args, prog=prog, description=description, config=markers)
    values = {field.name: getattr(parsed, field.name) for field in dataclasses.fields(parsed)}
    return type(config)(**values)


def _with_positional(config: Any, names: tuple[str, ...]) -> Any:
    """The config with some fields marked as positional, in a subclass that checks nothing yet; None can be left out."""
    import tyro

    if not names:
        return config
    hints = hints_of(type(config))
    marked = []
    for name in names:
        hint = None if getattr(config, name) is None else "(required)"
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
    values = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
    return kind(**values | {name: tyro.MISSING for name in names if values[name] is not None})


def _slot_flags(filled: list[Slot]) -> Any:
    """A dataclass that only adds the slot flags to the help text: `resolve` has taken them already."""
    import tyro

    rows: list[tuple[str, Any, Any]] = []
    for slot in filled:
        names = [name for name in registry.installed(slot.kind.group) if _may_fill(slot, name)]
        allowed = ", ".join([*names, "none"] if slot.optional else names)
        about = (slot.kind.__doc__ or "").strip().partition("\n")[0]
        arg = tyro.conf.arg(name=slot.path, metavar="NAME", help=f"{about} One of {allowed}.")
        here = "none" if slot.value is None else registry.name_of(slot.kind.group, type(slot.value))
        rows.append((slot.path.replace(".", "_"), Annotated[str, arg], dataclasses.field(default=here)))
    kind = dataclasses.make_dataclass("PlugIns", rows, frozen=True, kw_only=True)
    kind.__doc__ = "What fills each slot, by name; its own fields are flags above. `fprf plugins` lists all."
    return kind()


def _may_fill(slot: Slot, name: str) -> bool:
    """False for what is known, without importing anything, to be of another kind that shares the group."""
    known = registry.peek(slot.kind.group, name)
    return not isinstance(known, type) or issubclass(known, slot.kind)


def _located(fault: str, flags: dict[str, Flag], args: Sequence[str]) -> str:
    """A range error with the flag that caused it, where the arguments tell which."""
    field, _, rest = fault.partition(": ")
    given = {arg.partition("=")[0].replace("_", "-") for arg in args if arg.startswith("--")}
    fits = [text for text, flag in flags.items() if text in given and f".{flag.path}".endswith(f".{field}")]
    return f"{fits[0]}: {rest}" if len(fits) == 1 and rest else fault


@contextlib.contextmanager
def _width(columns: int) -> Iterator[None]:
    """Help is set for a page, not for a wide screen; tyro asks the environment for the width."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(min(columns, shutil.get_terminal_size((columns, 24)).columns))
    try:
        yield
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before


def describe(config: Any, *, prog: str, description: str, positional: Sequence[str]) -> str:
    """The JSON text of a config that flags change."""
    rows = []
    for text, flag in flags_of(config).items():
        owner = config
        *way, name = flag.path.split(".")
        for part in way:
            owner = getattr(owner, part)
        given = name if flag.path in positional else text
        row = {"flag": given, "takes": flag.takes, "default": _written(getattr(owner, name)), "of": ".".join(way)}
        rows.append(row | {"meaning": meanings(type(owner)).get(name, ""), "positional": flag.path in positional})
    chosen = []
    for slot in slots(config):
        default = "none" if slot.value is None else registry.name_of(slot.kind.group, type(slot.value))
        about = (slot.kind.__doc__ or "").strip().partition("\n")[0]
        names = list(registry.installed(slot.kind.group))
        chosen.append({"flag": f"--{slot.path.replace('_', '-')}", "one of": names, "default": default, "meaning": about})
    return json.dumps({"prog": prog, "description": description, "flags": rows, "slots": chosen}, indent=1)


def meanings(kind: type) -> dict[str, str]:
    """The docstring below each field of a dataclass, those of its bases included; of a class without source, none."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        try:
            body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        except (OSError, TypeError, SyntaxError):
            continue
        assert isinstance(body, ast.ClassDef)
        for field, text in zip(body.body, body.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr):
                said = text.value.value if isinstance(text.value, ast.Constant) else None
                if isinstance(said, str):
                    texts[field.target.id] = " ".join(said.split())
    return texts


def _written(value: Any) -> str:
    """A default as it would be typed."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (tuple, list)):
        return " ".join(map(_written, value))
    return "" if isinstance(value, Path) and value == Path() else str(value)
