"""`fprf plugins new NAME --kind KIND`: write a package with one plug-in that keeps to its contract."""

import re
import shlex
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Literal, NamedTuple, get_args

from ..errors import UsageError
from ..io.atomic import write_text
from ..plugins.captures import CAPTURES
from ..plugins.registry import installed
from .parsing import parse

Kind = Literal["encoder", "stylizer", "parser", "format", "layout", "loss"]

_NAME_PATTERN = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
_MAGIC_BYTES = 8
"""Letters that the files of a new format begin with."""


class _Kind(NamedTuple):
    """Words of a kind in the texts of a package."""

    group: str
    summary: str
    """Content of the package, as a phrase."""
    try_it: str
    """A command that uses it; NAME stands for its name."""
    explained: str


_CONFIG_RULES = (
    "`src/MODULE/__init__.py` holds the config: every field has a default, a docstring (its `--help`) and a range "
    "check, and importing it imports no torch. `build()` imports the implementation beside it."
)
_KINDS: dict[Kind, _Kind] = {
    "encoder": _Kind(
        "fprf.encoders",
        "An encoder",
        "fprf train fprf-lite --data DIR --semantic.encoder NAME --semantic.encoder.window 15",
        f"{_CONFIG_RULES} `identity` names everything that changes the features: caches are kept by it.",
    ),
    "stylizer": _Kind(
        "fprf.stylizers",
        "A stylizer",
        "fprf stylize RUN --references A.jpg --stylizer NAME --stylizer.share 0.5",
        f"{_CONFIG_RULES} Gaussians take what is affine in the content.",
    ),
    "parser": _Kind(
        "fprf.dataparsers",
        "A format of scene folders",
        "fprf train --data DIR --parser NAME",
        f"{_CONFIG_RULES} `recognises` looks at names alone; where it returns nothing, the format is only used by name.",
    ),
    "format": _Kind(
        CAPTURES,
        "A file format of Gaussians",
        "fprf restyle scan.NAME --references A.jpg --output autumn.ply",
        "`src/MODULE/__init__.py` holds the format, whose entry point is the ending of its files. Reading never "
        "allocates on a file's word; `recolour` changes colours and nothing else.",
    ),
    "layout": _Kind(
        "fprf.layouts",
        "A layout of blocks and cells",
        "fprf train --data DIR --cells NAME --cells.count 4",
        f"{_CONFIG_RULES} All cells have one border, in which neighbours are blended.",
    ),
    "loss": _Kind(
        "fprf.losses",
        "A training term",
        "fprf train fprf-lite --data DIR --loss.extra NAME --loss.extra.weight 0.02",
        f"{_CONFIG_RULES} The term runs in every step: nothing in it waits for the device.",
    ),
}


@dataclass(frozen=True, kw_only=True)
class NewPluginConfig:
    """Settings of `fprf plugins new`."""

    name: str = ""
    """Its name on the command line: small letters, digits and hyphens; of a format, the ending of its files."""
    kind: Kind = "encoder"
    """Example of one kind of plug-in; docs/plugins.md lists the other kinds, which begin as one of these."""
    output: Path | None = None
    """Folder of the package, new or empty; by default fprf-NAME."""


def run(args: list[str]) -> int:
    """Write the package, and say what comes next."""
    about = "Write a package with one plug-in and its tests, which pass: a place to begin."
    config = parse(NewPluginConfig(), args, prog="fprf plugins new", description=about, positional=("name",))
    name = _checked_name(config)
    folder = config.output or Path(f"fprf-{name}")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder}: is there already; name a new or empty folder with --output")
    for path, text in package_files(name, config.kind).items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        write_text(folder / path, text)
    quoted = shlex.quote(str(folder))
    print(f"{folder}: {_KINDS[config.kind].summary.lower()} named {name}")
    package = shlex.quote(f"{folder}[test]")
    print(f"pip install -e {package} && fprf plugins --check && pytest {quoted}")
    return 0


def package_files(name: str, kind: Kind) -> dict[str, str]:
    """The package's files by their path: texts of `plugin_template`, with the names put in."""
    about = _KINDS[kind]
    title = "".join(part.capitalize() for part in name.split("-"))
    module = f"fprf_{name.replace('-', '_')}"
    values = {
        "name": name,
        "package": f"fprf-{name}",
        "module": module,
        "title": title,
        "object": title if kind == "format" else f"{title}Config",
        "group": about.group,
        "summary": about.summary,
        "try_it": about.try_it.replace("NAME", name),
        "explained": about.explained.replace("MODULE", module),
        "magic": title[:_MAGIC_BYTES].ljust(_MAGIC_BYTES, "-"),
    }
    sources = {
        "pyproject.toml": "pyproject.toml.txt",
        "README.md": "README.md.txt",
        f"src/{module}/__init__.py": f"{kind}/config.txt",
        f"src/{module}/{kind}.py": f"{kind}/part.txt",
        f"tests/test_{module}.py": f"{kind}/test.txt",
    }
    root = files(__package__) / "plugin_template"
    found = {}
    for path, source in sources.items():
        template = root / source
        if template.is_file():  # a format has no second module
            found[path] = Template(template.read_text("utf-8")).substitute(values)
    return found


def _checked_name(config: NewPluginConfig) -> str:
    """The plug-in's name. Raises UsageError where it is none, or taken."""
    name = config.name.removeprefix("fprf-")
    if not _NAME_PATTERN.fullmatch(name) or name in get_args(Kind):
        raise UsageError(
            f"{config.name}: is no name for a plug-in; write small letters, digits and hyphens, such as my-{config.kind}"
        )
    if name in installed(_KINDS[config.kind].group):
        raise UsageError(f"{name}: is installed already, see `fprf plugins`; choose another name")
    return name
