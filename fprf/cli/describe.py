"""What a verb takes, as data: for pages about it, and for other programs that offer its flags.

`fprf VERB --describe` prints one JSON object: program, description, positional words, and for each flag what it takes, its
default, its meaning, and the config that it is a field of.
"""

import ast
import dataclasses
import inspect
import json
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..plugins import registry
from ..plugins.slots import slots
from .flags import flags_of

__all__ = ["describe", "meanings"]


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
    found: dict[str, str] = {}
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
                    found[field.target.id] = " ".join(said.split())
    return found


def _written(value: Any) -> str:
    """A default as it would be typed."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (tuple, list)):
        return " ".join(map(_written, value))
    return "" if isinstance(value, Path) and value == Path() else str(value)
