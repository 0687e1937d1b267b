"""Files that look for unread code: libFuzzer changes each reader's valid file and keeps what reaches lines
not reached before.

    python -m benchmarks fuzz_guided [--minutes 60] [--only NAME ...] [--corpus FOLDER] [--seal] [--output FILE]

Needs `pip install atheris`. The minutes are shared equally among the readers; each runs in a process of its
own, with 2 GiB of address space more than it has at its start, and an input may take ten seconds. A reader
that fails is told with the bytes that did it, and goes on. What reached new code is kept in the corpus, where
a later run takes it up; `--seal` puts a corpus into `tests/fuzz/corpus.zip`, which the tests read again.
"""

import base64
import contextlib
import importlib
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
import zipfile
from pathlib import Path
from typing import Any

from .common import ROOT, arguments, report
from .readers import targets

ROOM = 2 << 30
"""Bytes of address space beyond what a process has at its start."""
LONGEST = 4096
"""Bytes of the longest file that is tried; the valid ones are shorter."""
PATIENCE = 10
"""Seconds for one file."""
SEALED = ROOT / "tests" / "fuzz" / "corpus.zip"
THIRD_PARTY = ("numpy", "torch", "cv2", "numba", "tyro", "rich", "safetensors", "kornia.color")
"""Modules that are imported before: only what comes after is watched, which is fprf."""


def inside(name: str, corpora: list[str], options: list[str]) -> None:
    """In a child: one reader under libFuzzer, which ends the process."""
    import atheris

    for module in THIRD_PARTY:
        importlib.import_module(module)
    for module in [
        each for each in sys.modules if each.split(".")[0] == "fprf" or each == "benchmarks.readers"
    ]:
        del sys.modules[module]  # this script's own, which nobody watched
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        with atheris.instrument_imports(include=["fprf"]):
            readers = importlib.import_module("benchmarks.readers")
            errors = importlib.import_module("fprf.errors")
            target = next(each for each in readers.targets(Path(folder) / "files") if each.name == name)
            valid = target.file.read_bytes()
            target.read()
        (Path(corpora[0]) / "valid").write_bytes(valid)
        size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGESIZE")
        resource.setrlimit(resource.RLIMIT_AS, (size + ROOM, size + ROOM))

        def one(data: bytes) -> None:
            target.file.write_bytes(data)
            with contextlib.suppress(errors.FprfError):
                target.read()

        atheris.Setup([sys.argv[0], *options, f"-max_len={LONGEST}", *corpora], one)
        atheris.Fuzz()


def run(name: str, corpus: Path, options: list[str]) -> tuple[int, str]:
    """One reader in a process of its own: its exit code and what it said."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", "fuzz_guided", "--inside", name, str(corpus), *options],
        capture_output=True,
        check=False,
    )
    return done.returncode, (done.stdout + done.stderr).decode(errors="replace")


def _last(pattern: str, text: str) -> int:
    found = re.findall(pattern, text)
    return int(found[-1]) if found else 0


def search(name: str, corpus: Path, seconds: float) -> dict[str, Any]:
    """Search with one reader for so long, begun anew behind every fault; what came of it."""
    corpus.mkdir(parents=True, exist_ok=True)
    faults: list[dict[str, Any]] = []
    rounds = 0
    reached = 0
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as found:
        while (left := seconds - (time.monotonic() - begun)) > 1 and len(faults) < 10:
            options = [
                f"-max_total_time={int(left) + 1}",
                f"-timeout={PATIENCE}",
                "-rss_limit_mb=4096",
                "-print_final_stats=1",
            ]
            code, said = run(name, corpus, [*options, f"-artifact_prefix={found}/"])
            rounds += _last(r"stat::number_of_executed_units:\s*(\d+)", said)
            reached = max(reached, _last(r"\bcov: (\d+)", said))
            if code == 0:
                break
            harmful = sorted(Path(found).iterdir())
            named = (
                line for line in said.splitlines() if re.match(r"\w*(Error|Exception|Interrupt)\b", line)
            )
            line = next(named, said[-300:])
            faults.append(
                {
                    "said": line[:300],
                    "bytes": [base64.b64encode(path.read_bytes()).decode() for path in harmful],
                }
            )
            for path in harmful:
                path.unlink()
    return {
        "rounds": rounds,
        "reached": reached,
        "seconds": round(time.monotonic() - begun, 1),
        "faults": faults,
    }


def seal(corpus: Path, to: Path) -> None:
    """All files of a corpus in one archive, the same bytes for the same files."""
    with zipfile.ZipFile(to, "w") as archive:
        for path in sorted(path for path in corpus.rglob("*") if path.is_file()):
            entry = zipfile.ZipInfo(path.relative_to(corpus).as_posix())
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, path.read_bytes(), compresslevel=9)


def names() -> list[str]:
    """All readers."""
    with tempfile.TemporaryDirectory() as folder:
        return [target.name for target in targets(Path(folder) / "files")]


def measure(chosen: list[str], corpus: Path, minutes: float, output: Path | None) -> None:
    """Reader after reader; the output is written after each."""
    command = f"python -m benchmarks fuzz_guided --minutes {minutes:g}"
    document: dict[str, Any] = {"command": command, "minutes": minutes, "readers": {}}
    for name in chosen:
        folder = corpus / name
        row = search(name, folder, 60 * minutes / len(chosen))
        row["kept"] = len(list(folder.iterdir()))
        document["readers"][name] = row
        print(name, json.dumps(row), flush=True)
        if output is not None:
            report(output, document)


def main(argv: list[str]) -> None:
    if argv[:1] == ["--inside"]:
        flags = [each for each in argv[2:] if each.startswith("-")]
        inside(argv[1], [each for each in argv[2:] if each not in flags], flags)
        return
    parser = arguments("fuzz_guided", __doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--only", nargs="*", default=[], metavar="NAME")
    parser.add_argument("--corpus", type=Path)
    parser.add_argument("--seal", action="store_true", help="put the corpus into the tests when all is done")
    parser.add_argument("--output", type=Path)
    asked = parser.parse_args(argv)
    with tempfile.TemporaryDirectory(prefix="fprf-corpus-") as folder:
        corpus = asked.corpus or Path(folder)
        measure(asked.only or names(), corpus, asked.minutes, asked.output)
        if asked.seal:
            seal(corpus, SEALED)
