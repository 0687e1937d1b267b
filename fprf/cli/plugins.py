"""`fprf plugins`: what is installed, from metadata alone; `--check` imports each and says what is wrong with
it; `new` writes a package with another.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ..blocks.config import LayoutConfig
from ..datamanagers.config import DataManagerConfig
from ..datamanagers.parsers.config import DataParserConfig
from ..errors import PluginError
from ..fields.config import ContentFieldConfig, SemanticFieldConfig
from ..plugins import registry
from ..plugins.captures import CAPTURES
from ..plugins.config import PluginConfig
from ..plugins.decoders.config import DecoderConfig
from ..plugins.encoders.config import EncoderConfig
from ..plugins.executors.config import ExecutorConfig
from ..plugins.losses.config import LossTermConfig
from ..plugins.samplers.config import SamplerConfig
from ..plugins.stylizers.config import StylizerConfig
from . import new_plugin
from .config import CommandConfig
from .parsing import load_method, parse

METHODS = "fprf.methods"
SCENES = "fprf.scenes"
KINDS: dict[str, tuple[type[PluginConfig], ...]] = {
    "fprf.fields": (ContentFieldConfig, SemanticFieldConfig),
    "fprf.samplers": (SamplerConfig,),
    "fprf.encoders": (EncoderConfig,),
    "fprf.decoders": (DecoderConfig,),
    "fprf.stylizers": (StylizerConfig,),
    "fprf.layouts": (LayoutConfig,),
    "fprf.datamanagers": (DataManagerConfig,),
    "fprf.dataparsers": (DataParserConfig,),
    "fprf.executors": (ExecutorConfig,),
    "fprf.losses": (LossTermConfig,),
    "fprf.commands": (CommandConfig,),
}
"""The groups of configs, and what a plug-in of each must derive from. Formats of captures, which import
torch, stand apart.
"""


class Row(NamedTuple):
    """One entry point."""

    group: str
    name: str
    value: str
    package: str


@dataclass(frozen=True, kw_only=True)
class PluginsConfig:
    """Settings of `fprf plugins`."""

    check: bool = False
    """Import each one and report what fails; exit code 1 if anything does."""


def run(args: list[str]) -> int:
    """List, and with `--check` load, every installed plug-in; `new` writes one."""
    if args[:1] == ["new"]:
        return new_plugin.run(args[1:])
    about = (
        "List the installed plug-ins. `fprf plugins new NAME --kind KIND` writes a package with a new one."
    )
    config = parse(PluginsConfig(), args, prog="fprf plugins", description=about)
    # Listing reads metadata alone; --check imports everything.
    checked = dict(faults()) if config.check else {}
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    # The state stands where it is read first; objects and versions, which are long, wrap on a narrow screen.
    for title in ("group", "name", *(["state"] if config.check else []), "object", "package"):
        table.add_column(title, no_wrap=title not in ("object", "package"), overflow="fold")
    last = ""
    for row in rows():
        shown = "" if row.group == last else row.group
        last = row.group
        if row in checked:
            state = "[red]broken[/]"
        else:
            state = "[green]ok[/]"
        name = f"[cyan]{escape(row.name)}[/]"
        # Of a version between releases the commit is left out: it is long, and `fprf --version` says it.
        package = escape(row.package.partition("+")[0])
        table.add_row(shown, name, *([state] if config.check else []), escape(row.value), package)
    console = Console()
    console.print(table)
    if not config.check:
        return 0
    problems = [*checked.values(), *registry.unreadable()]
    for problem in dict.fromkeys(problems):
        console.print(f"[red]broken:[/] {escape(problem)}", soft_wrap=True, highlight=False)
    return 1 if problems else 0


def rows() -> Iterator[Row]:
    """Every entry point of every group of ours."""
    for group in (METHODS, SCENES, CAPTURES, *KINDS):
        for name, entries in registry.installed(group).items():
            for each in entries:
                yield Row(group, name, each.point.value, each.package)


def faults() -> Iterator[tuple[Row, str]]:
    """Load each plug-in, build its config from defaults, and yield those that cannot be used, with the
    reason.
    """
    from ..splats.files.base import CaptureFormat
    from .main import VERBS

    for row in rows():
        origin = f"{row.value} from {row.package}"
        try:
            if row.group == METHODS:
                load_method(row.name)
            elif row.group == SCENES:  # a function, which has nothing to build before there is a run
                registry.load_object(row.group, row.name)
            elif row.group == CAPTURES:
                registry.make(row.group, row.name, CaptureFormat)
            else:
                # Groups of several kinds say which kind it is not of only where it is of none.
                loaded: Any = registry.load_object(row.group, row.name)
                if not (isinstance(loaded, type) and issubclass(loaded, KINDS[row.group])):
                    registry.load(row.group, row.name, KINDS[row.group][0])
                if row.name == "none":
                    raise PluginError(
                        f"{row.group}: 'none' ({origin}) can never be chosen: none empties a slot"
                    )
                if row.group == CommandConfig.group and row.name in VERBS:
                    verb = f"{row.group}: {row.name!r} ({origin})"
                    raise PluginError(f"{verb} is never called: fprf has a verb of that name; rename it")
                registry.make(row.group, row.name, loaded)
        except PluginError as fault:
            yield row, str(fault)
