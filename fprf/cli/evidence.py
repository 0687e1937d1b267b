"""`fprf bench restyle`, `peer` and `paper`: reports with true answers; see `fprf.evidence`."""

import os
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from ..evidence.config import EvidenceConfig, PaperConfig, PeerConfig, RestyleConfig
from .parsing import load_field_method, parse
from .progress import Display
from .train import train_scene

__all__ = ["NAMES", "run"]

NAMES: dict[str, EvidenceConfig] = {"restyle": RestyleConfig(), "peer": PeerConfig(), "paper": PaperConfig()}
"""Defaults of each report."""
_WIDTH = 150


def run(name: str, args: list[str]) -> int:
    """`fprf bench NAME ...`: 0 when the figures are printed and written where they should be."""
    return {"restyle": _restyle, "peer": _peer, "paper": _paper}[name](args)


def _restyle(args: list[str]) -> int:
    if args and not args[0].startswith("-"):  # tyro has no positional argument that may be absent
        args = ["--run", *args]
    config = parse(RestyleConfig(), args, prog="fprf bench restyle [RUN]", description=about(RestyleConfig()))
    with tempfile.TemporaryDirectory(prefix="fprf-restyle-") as made:
        root = config.run or _town(config.minutes, config.device, Path(made) / "run")
        from ..evidence.provenance import provenance
        from ..evidence.restyle import restyle, restyle_sheet
        from ..evidence.restyle_page import COLUMNS, restyle_page
        from ..evidence.table import printed
        from ..io.images import write_image

        with Display() as display:
            document, cases = restyle(config, root, Path(made), display.count)
    document["provenance"] = provenance(config.device)
    console = _console()
    for name, rows in document["means"].items():
        console.print(printed(f"mean over {len(config.palettes)} palettes, references: {name}", rows, COLUMNS))
    if config.sheet is not None:
        write_image(config.sheet, restyle_sheet(cases))
    _write(config, document, lambda: restyle_page(document, picture=_beside(config.page, config.sheet)))
    return 0


def _peer(args: list[str]) -> int:
    about_it = about(PeerConfig())
    config = parse(PeerConfig(), args, prog="fprf bench peer", description=about_it, positional=("frames",))
    from ..evidence.peer import peer
    from ..evidence.peer_page import peer_page
    from ..evidence.provenance import provenance

    with Display() as display:
        document = peer(config, display.count)
    document["provenance"] = provenance(config.device)
    page = peer_page(document)
    print(page)
    _write(config, document, lambda: page)
    return 0


def _paper(args: list[str]) -> int:
    config = parse(PaperConfig(), args, prog="fprf bench paper", description=about(PaperConfig()))
    from ..evidence.paper import paper
    from ..evidence.paper_page import paper_page
    from ..evidence.provenance import provenance

    with Display() as display:
        document = paper(config, *load_field_method(config.method), display.count)
    document["provenance"] = provenance(config.device)
    page = paper_page(document)
    print(page)
    _write(config, document, lambda: page)
    return 0


def about(config: EvidenceConfig) -> str:
    """What a report is, in one line."""
    return (type(config).__doc__ or "").strip()


def _town(minutes: float, device: str, output: Path) -> Path:
    method, name = load_field_method("fprf-lite")
    return train_scene(replace(method, data=Path("town"), output=output, minutes=minutes, device=device), name)


def _write(config: EvidenceConfig, document: dict[str, object], page: Callable[[], str]) -> None:
    from ..io.atomic import write_json, write_text

    if config.output is not None:
        write_json(config.output, document)
    if config.page is not None:
        write_text(config.page, page())


def _beside(page: Path | None, picture: Path | None) -> str | None:
    """The picture's path as the page names it."""
    if page is None or picture is None:
        return None
    return Path(os.path.relpath(picture, page.parent)).as_posix()


def _console() -> Console:
    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = _WIDTH
    return console
