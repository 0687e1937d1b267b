"""JSON schemas of configs and files: dataclasses become structs of msgspec, which writes the schemas.

A slot is an object with the plug-in's name as `type`: any of those that are installed. Ranges are not part of it:
they are checked when a file is read.
"""

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache, reduce
from operator import or_
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

import msgspec

from ..errors import PluginError
from . import registry
from .slots import hints_of, is_slot, members


def schema_of(name: str, fields: Mapping[str, tuple[Any, str]], needed: Sequence[str]) -> dict[str, Any]:
    """The JSON schema (draft 2020-12) of a file: an object with these fields, by their types and meanings, of which
    the `needed` must be there.
    """
    listed: list[Any] = []
    for field, (hint, about) in fields.items():
        documented: Any = Annotated[_converted(hint), msgspec.Meta(description=about)]
        if field in needed:
            listed.append((field, documented))
        else:
            listed.append((field, documented, msgspec.field(default_factory=lambda: None)))
    file = msgspec.defstruct(
        "File", listed, kw_only=True, forbid_unknown_fields=True, rename={"schema": "$schema"}
    )
    schema = msgspec.json.schema(file)
    # msgspec refers to the file itself as to any other struct.
    whole = schema["$defs"].pop("File")
    whole["title"] = name
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **whole, "$defs": schema["$defs"]}


@cache
def _struct(kind: type, name: str, within: frozenset[type]) -> Any:
    """A struct with the fields of a dataclass; the plug-in of a slot says its `name`. `within` are the kinds of the
    slots that it lies in.
    """
    documented = _field_docstrings(kind)
    hints = hints_of(kind)
    fields: list[Any] = []
    for field in dataclasses.fields(kind):
        if not field.init:
            continue
        hint = _converted(hints[field.name], within)
        if field.name in documented:
            hint = Annotated[hint, msgspec.Meta(description=documented[field.name])]
        if field.default is dataclasses.MISSING:
            fields.append((field.name, hint))
        else:
            fields.append((field.name, hint, _default(field.default)))
    return msgspec.defstruct(
        kind.__name__,
        fields,
        kw_only=True,
        forbid_unknown_fields=True,
        namespace={"__doc__": inspect.getdoc(kind)},
        tag_field="type" if name else None,
        tag=name or None,
    )


def _default(value: Any) -> Any:
    """A default as files hold it; the schema does not spell out those that are configs."""
    if dataclasses.is_dataclass(value):
        return msgspec.field(default_factory=lambda: value)
    if isinstance(value, Path):
        return str(value)
    return value


def _converted(hint: Any, within: frozenset[type] = frozenset()) -> Any:
    """The type that msgspec knows, for one of a config."""
    choices = members(hint)
    if len(choices) > 1:
        return reduce(or_, [_converted(each, within) for each in choices])
    if is_slot(hint):
        return _of_slot(hint, within)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return _struct(hint, "", within)
    if hint is Path:
        return str
    origin = get_origin(hint)
    if origin in (tuple, list, dict):
        inner = [each if each is Ellipsis else _converted(each, within) for each in get_args(hint)]
        return origin[tuple(inner)]
    return hint


def _of_slot(kind: Any, within: frozenset[type]) -> Any:
    """Any of the plug-ins of a kind that are installed and can be loaded. What lies in one of its own kind, as an
    encoder in one of several, may hold anything.
    """
    structs = []
    for name in registry.choices(kind.group, kind):
        if kind not in within:
            with suppress(PluginError):  # of another kind, or broken: no file can name it
                plugin: type = registry.load(kind.group, name, kind)
                structs.append(_struct(plugin, name, within | {kind}))
    return reduce(or_, structs) if structs else dict[str, Any]


def _field_docstrings(kind: type) -> dict[str, str]:
    """The docstring below each field, of a class and of those that it derives from."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        try:
            (tree,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        except (OSError, TypeError, SyntaxError):  # a class without a file
            continue
        assert isinstance(tree, ast.ClassDef)
        for field, below in zip(tree.body[:-1], tree.body[1:], strict=True):
            if not (isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)):
                continue
            if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                found[field.target.id] = inspect.cleandoc(str(below.value.value)).replace("\n", " ")
    return found
