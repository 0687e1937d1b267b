"""`fprf plugins`: what is installed, from metadata alone; `--check` imports each and says what is wrong with it."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ..blocks.config import LayoutConfig
from ..datamanagers.config import DataManagerConfig
from ..datamanagers.parsers.config import DataParserConfig
from ..errors import PluginError
from ..fields.config import ContentFieldConfig, SemanticFieldConfig
from ..plugins import registry
from ..plugins.config import PluginConfig
from ..plugins.decoders.config import DecoderConfig
from ..plugins.encoders.config import EncoderConfig
from ..plugins.executors.config import ExecutorConfig
from ..plugins.losses.config import LossTermConfig
from ..plugins.samplers.config import SamplerConfig
from ..plugins.stylizers.config import StylizerConfig
from ..splats.config import CAPTURES
from .config import CommandConfig
from .parsing import load_method, parse

METHODS, SCENES = "fprf.methods", "fprf.scenes"
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
"""The groups of configs, and what a plug-in of each must derive from. Formats of captures, which import torch, stand apart."""


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
    """List, and with `--check` load, every installed plug-in."""
    config = parse(PluginsConfig(), args, prog="fprf plugins", description="List the installed plug-ins.")
    # Listing reads metadata alone; --check imports everything.
    checked = dict(faults()) if config.check else {}
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    for title in ("group", "name", "object", "package", *(["state"] if config.check else [])):
        table.add_column(title, no_wrap=title != "object", overflow="fold")
    last = ""
    for row in rows():
        shown = "" if row.group == last else row.group
        last = row.group
        state = "[red]broken[/]" if row in checked else "[green]ok[/]"
        cells = (shown, f"[cyan]{escape(row.name)}[/]", escape(row.value), escape(row.package))
        table.add_row(*cells, *([state] if config.check else []))
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
    """Load each plug-in and yield those that cannot be used, with the reason."""
    for row in rows():
        try:
            _check(row)
        except PluginError as fault:
            yield row, str(fault)


def _check(row: Row) -> None:
    """Load a plug-in and build its config from defaults. Raises PluginError."""
    from .main import VERBS

    if row.group == METHODS:
        load_method(row.name)
        return
    loaded = registry.load_object(row.group, row.name)
    if row.group == SCENES:
        return
    if row.group == CAPTURES:
        from ..splats.files.base import CaptureFormat

        registry.make(row.group, row.name, CaptureFormat)
        return
    if not (isinstance(loaded, type) and issubclass(loaded, KINDS[row.group])):
        registry.load(row.group, row.name, KINDS[row.group][0])  # says what it is instead
        return
    origin = f"{row.value} from {row.package}"
    if row.name == "none":
        raise PluginError(f"{row.group}: 'none' ({origin}) can never be chosen: none empties a slot")
    if row.group == CommandConfig.group and row.name in VERBS:
        raise PluginError(f"{row.group}: {row.name!r} ({origin}) is never called: fprf has a verb of that name; rename it")
    registry.make(row.group, row.name, loaded)
