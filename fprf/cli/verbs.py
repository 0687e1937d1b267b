"""The verbs: built-in ones with the lines that `fprf --help` shows of them, and those of packages. Importing this
imports none of them.
"""

import importlib
import inspect
from collections.abc import Sequence
from types import ModuleType
from typing import NamedTuple

from ..errors import UsageError
from ..plugins.registry import installed, make, nearest

_VERB_GROUP = "fprf.commands"
"""Entry points of verbs of packages."""


class Verb(NamedTuple):
    """A command's line in `fprf --help`; its code is `fprf.cli.NAME` (`verb_module`), with `run(args) -> exit code`."""

    usage: str
    summary: str


VERBS = {
    "demo": Verb("[--output DIR]", "a garden trained and restyled, as a page; needs no data"),
    "process": Verb("IMAGES|VIDEO --output SCENE", "find poses for images or a video that have none"),
    "train": Verb("[METHOD|CONFIG.json] --data DIR", "train a scene, or go on where a run stopped"),
    "eval": Verb("RUN", "measure a run: quality, speed, consistency"),
    "stylize": Verb("RUN --references A.jpg ...", "restyle captured views with photographs"),
    "restyle": Verb("A.ply --references A.jpg ...", "restyle a capture of 3D Gaussians from its file alone"),
    "gallery": Verb("RUN --references DIR", "a run in every style, as one page to walk through"),
    "render": Verb("RUN --path PATH --output X.mp4", "fly through a scene, plain or restyled"),
    "view": Verb("[RUN]", "in the browser: make a scene, drop a photograph on it"),
    "export": Verb("RUN [ply splat glb cameras]", "points, splats, meshes, cameras as files"),
    "pretrain": Verb("decoder", "train the decoder of an encoder"),
    "plugins": Verb("[--check | new NAME]", "list what is installed, check that it loads, begin another"),
    "config-schema": Verb("style|config|keyframes", "the JSON schema of a file, for editors"),
    "doctor": Verb("[DIR|METHOD]", "look over this machine, a scene or a method's needs"),
}


def verb_module(verb: str) -> ModuleType:
    """The module of a built-in verb."""
    return importlib.import_module(f".{verb.replace('-', '_')}", __package__)


def run_packaged(verb: str, rest: Sequence[str]) -> int:
    """Run a verb of a package: a config whose fields are the flags and whose docstring is the help. Raises UsageError
    where there is no such verb.
    """
    others = packaged()
    if verb not in others:
        known = [*VERBS, *others]
        raise UsageError(f"fprf {verb}: no such verb{nearest(verb, known)} (verbs: {', '.join(known)})")
    from .config import CommandConfig
    from .parsing import parse

    config = make(_VERB_GROUP, verb, CommandConfig)
    about = inspect.getdoc(type(config)) or ""
    return (
        parse(config, rest, prog=f"fprf {verb}", description=about, positional=config.positional).run() or 0
    )


def packaged() -> dict[str, str]:
    """Verbs of packages: name to the packages that provide it. Imports nothing."""
    found: dict[str, str] = {}
    for name, entries in installed(_VERB_GROUP).items():
        if name not in VERBS:
            found[name] = " and ".join(each.package for each in entries)
    return found
