"""`fprf bench NAME`: measure a run, a restyling whose truth is known, or the frames of another system."""

import os
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from rich.console import Console

from ..errors import UsageError
from ..evaluation.config import BenchConfig, PeerConfig, ReportConfig, RestyleConfig, SpeedConfig
from ..methods import fprf_lite
from .parsing import as_flag, load_field_method, parse
from .progress import Display
from .train import train_scene

if TYPE_CHECKING:
    from ..evaluation.report import Outcome

NAMES: dict[str, BenchConfig | ReportConfig] = {
    "speed": SpeedConfig(),
    "restyle": RestyleConfig(),
    "peer": PeerConfig(),
}
"""Defaults of each benchmark."""
_MOVED = {name: name for name in ("paper", "pareto", "scaling", "stress")} | {"memory": "peak_memory", "profile": "profiling"}
"""Benchmarks that the installed package does not hold: what the repository calls them."""
_WIDTH = 150
"""Columns of a table that goes to a file."""
C = TypeVar("C", bound=BenchConfig)
Progress = Callable[[int, int, str], None]


def run(args: list[str]) -> int:
    """`fprf bench NAME [RUN] ...`: 0 when the figures are printed and, with --output, written."""
    name, rest = (args[0], args[1:]) if args else ("", [])
    if name in ("", "-h", "--help"):
        print(_usage())
        return 0 if name else 2
    if name in _MOVED:
        raise UsageError(
            f"fprf bench {name}: not in the installed package; run `python -m benchmarks {_MOVED[name]}` in a clone of fprf"
        )
    if name == "speed":
        from ..evaluation.speed import speed

        return bench_run(f"fprf bench {name}", SpeedConfig(), rest, speed)
    if name == "restyle":
        return _restyle(rest)
    if name == "peer":
        return _peer(rest)
    raise UsageError(f"fprf bench {name}: no such benchmark; allowed are {', '.join(NAMES)}")


def bench_run(prog: str, default: C, args: list[str], measure: "Callable[[C, Path, Path, Progress], Outcome]") -> int:
    """Measure the run that the arguments name, or a scene that is trained first; print the tables and write the JSON.

    `measure` gets the config, the run folder, a temporary folder and a function that shows progress.
    """
    config = parse(default, as_flag(args, "--run"), prog=f"{prog} [RUN]", description=_about(default))
    with tempfile.TemporaryDirectory(prefix="fprf-bench-") as made:
        folder = Path(made)
        root = config.run or _trained(config, folder / "run")
        from ..io.atomic import write_json

        with Display() as display:
            outcome = measure(config, root, folder, display.count)
        for table in outcome.tables:
            console().print(table)
        if config.output is not None:
            write_json(config.output, outcome.document)
    return 0


def console() -> Console:
    """A console whose tables are as wide in a file as on a wide terminal."""
    made = Console(highlight=False)
    if not made.is_terminal:
        made.width = _WIDTH
    return made


def write_report(config: ReportConfig, document: dict[str, Any], page: Callable[[], str]) -> None:
    """Write the JSON and the page where the config asks for them."""
    from ..io.atomic import write_json, write_text

    if config.output is not None:
        write_json(config.output, document)
    if config.page is not None:
        write_text(config.page, page())


def _restyle(args: list[str]) -> int:
    default = RestyleConfig()
    config = parse(default, as_flag(args, "--run"), prog="fprf bench restyle [RUN]", description=_about(default))
    with tempfile.TemporaryDirectory(prefix="fprf-restyle-") as made:
        town = replace(fprf_lite(), data=Path("town"), output=Path(made) / "run", minutes=config.minutes, device=config.device)
        root = config.run or train_scene(town, "fprf-lite")
        from ..evaluation.report import printed, provenance
        from ..evaluation.restyle import COLUMNS, restyle, restyle_page, restyle_sheet
        from ..io.images import write_image

        with Display() as display:
            document, cases = restyle(config, root, Path(made), display.count)
    document["provenance"] = provenance(config.device)
    for name, rows in document["means"].items():
        console().print(printed(f"mean over {len(config.palettes)} palettes, references: {name}", rows, COLUMNS))
    if config.sheet is not None:
        write_image(config.sheet, restyle_sheet(cases))
    write_report(config, document, lambda: restyle_page(document, picture=_beside(config.page, config.sheet)))
    return 0


def _peer(args: list[str]) -> int:
    default = PeerConfig()
    config = parse(default, args, prog="fprf bench peer", description=_about(default), positional=("frames",))
    from ..evaluation.peer import peer, peer_page
    from ..evaluation.report import provenance

    with Display() as display:
        document = peer(config, display.count)
    document["provenance"] = provenance(config.device)
    page = peer_page(document)
    print(page)
    write_report(config, document, lambda: page)
    return 0


def _trained(config: BenchConfig, output: Path) -> Path:
    method, name = load_field_method(config.method)
    data = config.data or method.data or Path("town")
    return train_scene(replace(method, data=data, output=output, steps=config.steps, minutes=None, device=config.device), name)


def _beside(page: Path | None, picture: Path | None) -> str | None:
    """The picture's path relative to the page."""
    return None if page is None or picture is None else Path(os.path.relpath(picture, page.parent)).as_posix()


def _about(config: object) -> str:
    return (type(config).__doc__ or "").strip()


def _usage() -> str:
    width = max(map(len, NAMES))
    lines = [f"usage: fprf bench {'|'.join(NAMES)} [RUN] [--output JSON] [any field]", ""]
    lines += [f"  {name:<{width}}  {_about(config)}" for name, config in NAMES.items()]
    lines += ["", "`fprf bench NAME --help` lists every field; without RUN a scene is trained first, --data DIR by --method."]
    lines += ["Further benchmarks are in the repository: `python -m benchmarks` in a clone of fprf."]
    return "\n".join(lines)
