"""Measure a result again, or for the first time, and write it with commit, command, date and sources.

    python -m benchmarks record NAME
    python -m benchmarks record NAME --sources PATH ... -- BENCHMARK FLAGS
    python -m benchmarks record NAME --command "by hand: ..."

The first runs the command that NAME.json names, with its sources. The second makes a new result, or takes another command.
The third runs nothing: the figures that were put into NAME.json by hand are of this tree.
NAME.json lies in benchmarks/results (or docs/evidence, where it is there already). `--output` is added to the command.
Then `python -m benchmarks tables` writes tables and marks of the documents.
"""

import argparse
import json
import shlex
import subprocess
import sys
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fprf.errors import DataError, UsageError
from fprf.io.atomic import write_json

from .evidence import (
    DERIVED,
    FOLDERS,
    ORIGIN,
    ROOT,
    Origin,
    document,
    read_result,
    result_files,
    sources_hash,
)
from .report import commit

RUN = ("python", "-m", "benchmarks")


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks record",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("name", help="result, without .json")
    parser.add_argument(
        "--sources", nargs="+", metavar="PATH", help="files and folders that the figures depend on"
    )
    parser.add_argument("--folder", type=Path, default=ROOT / FOLDERS[0], help="of a new result")
    parser.add_argument(
        "--command", help="run nothing: this has made the figures that NAME.json holds, on this tree"
    )
    cut = argv.index("--") if "--" in argv else len(argv)
    asked = parser.parse_args(argv[:cut])
    path = result_files().get(asked.name, asked.folder / f"{asked.name}.json")
    known = _origin(path)
    sources = asked.sources or (known and list(known.sources))
    if not sources:
        raise UsageError(f"{asked.name}: no sources known; name them by --sources PATH ...")
    absent = [source for source in sources if not (ROOT / source).exists()]
    if absent:
        raise UsageError(f"{asked.name}: {', '.join(absent)} not in the repository; --sources names what is")
    if asked.command is not None:
        command = asked.command
        figures = _figures(path)
    else:
        words = argv[cut + 1 :] or _words(asked.name, known)
        command = shlex.join([*RUN, *words])
        figures = _measured(words)
        kept = _figures(path).get(DERIVED) if path.is_file() else None
        if kept:
            figures = {**figures, DERIVED: kept}
    made = Origin(
        commit=_short(commit(ROOT)),
        command=command,
        date=datetime.now(UTC).date().isoformat(),
        sources=tuple(sources),
        sources_hash=sources_hash(sources),
    )
    write_json(path, document(made, figures))
    print(path)
    return 0


def _short(found: str | None) -> str:
    """A commit in eight digits, with `+` where the checkout had changes. Raises UsageError outside of a checkout."""
    if found is None:
        raise UsageError("no commit: results are recorded in a checkout of the repository")
    return found[:8] + ("+" if found.endswith("+") else "")


def _origin(path: Path) -> Origin | None:
    try:
        return read_result(path)[0] if path.is_file() else None
    except DataError:
        return None


def _figures(path: Path) -> dict[str, Any]:
    """Content of a result without its origin; a benchmark's own commit and command are left to that."""
    if not path.is_file():
        raise UsageError(f"{path}: not there; write the figures into it first")
    found: dict[str, Any] = json.loads(path.read_text("utf-8"))
    return {key: value for key, value in found.items() if key not in (ORIGIN, "commit", "command")}


def _words(name: str, known: Origin | None) -> list[str]:
    """Benchmark and flags of a result's command."""
    words = shlex.split(known.command) if known else []
    if tuple(words[:3]) != RUN:
        told = f"; it was made by: {known.command}" if known else ""
        raise UsageError(
            f"{name}: no benchmark makes it alone{told}; write its figures, then name what made them by --command"
        )
    return words[3:]


def _measured(words: list[str]) -> dict[str, Any]:
    """Figures of a benchmark that runs in a process of its own. Raises UsageError where it fails."""
    if "--output" in words:
        at = words.index("--output")
        words = words[:at] + words[at + 2 :]
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "result.json"
        process = subprocess.run(
            [sys.executable, "-m", "benchmarks", *words, "--output", str(output)], cwd=ROOT
        )
        if process.returncode or not output.is_file():
            raise UsageError(
                f"{shlex.join([*RUN, *words])}: exit code {process.returncode}, no result written"
            )
        return _figures(output)
