"""Find the parser of a scene folder among all that are installed."""

import sys
from pathlib import Path

from ...checks import between
from ...errors import DataError
from ...plugins import registry
from ..scene import Scene
from .config import DataParserConfig

__all__ = ["parse_scene", "recognise"]


def recognise(data: Path) -> DataParserConfig:
    """The parser with the highest confidence, with its defaults; `town`, where no such folder exists, is the embedded scene.

    A parser that raises is skipped, with a warning on standard error. Raises DataError where no parser recognises the folder,
    or where several have the same confidence.
    """
    group, best = DataParserConfig.group, 0.0
    surest: dict[str, tuple[DataParserConfig, str]] = {}
    for name, entries in registry.installed(group).items():
        try:
            config = registry.make(group, name, DataParserConfig)
            answer = config.recognises(data)
            confidence, reason = answer or (0.0, "")
            between("confidence", confidence, 0.0, 1.0)
        except (Exception, SystemExit) as fault:  # a stranger's
            origin = ", ".join(each.origin for each in entries)
            print(f"warning: data parser {name!r} ({origin}) is skipped: {_line(fault)}", file=sys.stderr)
            continue
        if answer and confidence >= best:
            surest = {name: (config, reason)} if confidence > best else {**surest, name: (config, reason)}
            best = confidence
    if len(surest) > 1:
        claims = " and by ".join(f"{name!r} ({reason})" for name, (_, reason) in surest.items())
        raise DataError(f"{data}: is recognised by {claims}; choose one with --datamanager.parser NAME")
    for config, _ in surest.values():
        return config
    if not data.exists():
        raise DataError(f"{data}: no such folder; give a scene folder, or `town` for the embedded scene")
    if not data.is_dir():
        raise DataError(f"{data}: a file; give the scene folder that it lies in, and name it with the parser's own field")
    raise DataError(
        f"{data}: no transforms.json, sparse/0/cameras.bin or other file that a parser knows, but {_content(data)}; "
        f"choose a parser with --datamanager.parser NAME ({', '.join(registry.installed(group))}), "
        "or make poses with `fprf process`"
    )


def parse_scene(data: Path, downscale: int, parser: DataParserConfig | None) -> Scene:
    """The scene of a folder at 1/downscale of its size, by the parser that is named or, without one, recognised."""
    chosen = recognise(data) if parser is None else parser
    return chosen.build().parse(data, downscale)


def _content(data: Path) -> str:
    names = sorted(path.name + "/" * path.is_dir() for path in data.iterdir())
    return f"{len(names)} entries ({', '.join(names[:5])}{', ...' if len(names) > 5 else ''})" if names else "nothing"


def _line(fault: BaseException) -> str:
    return f"{type(fault).__name__}: {' '.join(str(fault).split())}"
