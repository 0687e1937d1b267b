"""The steps of COLMAP, one process each. A step that was done from the same images and settings is not done again.

Features and matches go into a database as they are found: a step that was cut off goes on where it stood.
"""

import contextlib
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import DataError, UsageError
from ..io.atomic import write_json, write_text
from . import pairs
from .config import SfmConfig
from .database import counts, descriptors
from .place import Place, State, key_of
from .vocabulary import vectors, words
from .worker import ABSENT, NOTHING

__all__ = ["find_features", "find_matches", "find_poses"]

_ALL_PAIRS = 120
"""Images up to which `auto` matches all with all."""
_WORDS = 64
_POLL = 0.2
"""Seconds between looks at a running step."""
_COMMAND = (sys.executable, "-m", "fprf.reconstruction.worker")

Progress = Callable[[int, int, str], None]


def find_features(place: Place, state: State, config: SfmConfig, progress: Progress) -> None:
    """Features of every image; those of an image that has changed or gone take all others with them."""
    settings = [config.lens, config.cameras, config.features, config.side, config.seed]
    hashes = {name: image["sha256"] for name, image in state.images.items()}
    before = _read(place.work / "features.json")
    grown = before.get("settings") == settings and before.get("hashes", {}).items() <= hashes.items()
    if not grown:
        for old in place.work.glob("database.db*"):
            old.unlink()
        write_json(place.work / "features.json", {"settings": settings, "hashes": hashes})
    key = key_of(settings, hashes)
    if state.done.get("features") == key and place.database.is_file():
        return
    write_json(place.work / "features.json", {"settings": settings, "hashes": hashes})
    groups: dict[str, list[str]] = {}
    for name, image in state.images.items():
        alike = [image["width"], image["height"], image["lens"]] if config.cameras == "shared" else name
        groups.setdefault(json.dumps(alike), []).append(name)
    job = {
        "step": "features",
        "groups": list(groups.values()),
        "lens": config.lens.upper().replace("-", "_"),
        "features": config.features,
        "side": config.side,
    }
    _run(place, state, config, job, _Watch(lambda: counts(place.database)[0], len(state.images), "finding features", progress))
    state.done["features"] = key
    state.save(place)


def find_matches(place: Place, state: State, config: SfmConfig, progress: Progress) -> str:
    """Matches of the pairs that `matching` says. Returns what it was decided to be."""
    names, video = list(state.images), "frames" in state.done
    kind = config.matching
    if kind == "auto":
        kind = "exhaustive" if len(names) <= _ALL_PAIRS else "similar"
    key = key_of(state.done["features"], kind, config.overlap, config.neighbours)
    if state.done.get("matches") == key and place.database.is_file():
        return kind
    if kind == "exhaustive":
        chosen = pairs.exhaustive(len(names))
    elif kind == "sequential":
        chosen = pairs.sequential(len(names), config.overlap)
    else:
        # Neighbours by name help where things look alike everywhere; in a video they are neighbours for certain.
        near = pairs.sequential(len(names), config.overlap if video else 2)
        chosen = pairs.merged(near, _alike(place, names, config))
    listed = place.work / "pairs.txt"
    write_text(listed, "".join(f"{names[a]} {names[b]}\n" for a, b in chosen))
    job = {"step": "matches", "pairs": str(listed)}
    _run(place, state, config, job, _Watch(lambda: counts(place.database)[1], len(chosen), "matching", progress))
    state.done["matches"] = key
    state.save(place)
    return kind


def find_poses(place: Place, state: State, config: SfmConfig, progress: Progress) -> list[dict[str, Any]]:
    """The largest model in `sparse/0`; all of them described. Raises DataError where no two images fit together."""
    key = key_of(state.done["matches"], "mapping")
    described = place.work / "models" / "models.json"
    if state.done.get("mapping") == key and (place.model / "images.bin").is_file() and described.is_file():
        return list(json.loads(described.read_text(encoding="utf-8")))
    shutil.rmtree(described.parent, ignore_errors=True)
    job = {"step": "mapping", "models": str(described.parent)}
    _run(place, state, config, job, _Watch(lambda: _registered(place), len(state.images), "finding poses", progress))
    fresh = place.root / "sparse" / ".fresh"
    shutil.rmtree(fresh, ignore_errors=True)
    shutil.copytree(described.parent / "best", fresh)
    shutil.rmtree(place.model, ignore_errors=True)
    fresh.rename(place.model)
    state.done["mapping"] = key
    state.save(place)
    return list(json.loads(described.read_text(encoding="utf-8")))


def _alike(place: Place, names: Sequence[str], config: SfmConfig) -> list[pairs.Pair]:
    """Pairs of images that look alike."""

    def read(image: int) -> Any:
        return descriptors(place.database, names[image])

    vocabulary = words(read, len(names), _WORDS, config.seed)
    return pairs.similar(vectors(read, len(names), vocabulary), config.neighbours)


class _Watch(NamedTuple):
    """How a step is seen from outside."""

    seen: Callable[[], int]
    total: int
    what: str
    progress: Progress


def _run(place: Place, state: State, config: SfmConfig, job: dict[str, Any], watch: _Watch) -> None:
    """One step in its process. Raises UsageError where pycolmap is absent, DataError where COLMAP fails."""
    name, start = job["step"], time.perf_counter()
    path = place.work / f"{name}.job.json"
    common = {
        "database": str(place.database),
        "images": str(place.images),
        "threads": -1 if config.threads is None else config.threads,
        "cpu": not config.gpu,
        "seed": config.seed,
    }
    write_json(path, {**common, **job})
    with place.log.open("ab") as log, _progress_file(place).open("wb") as out:
        process = subprocess.Popen([*_COMMAND, str(path)], stdout=out, stderr=log, stdin=subprocess.DEVNULL)
        try:
            while process.poll() is None:
                watch.progress(max(0, min(watch.total - 1, watch.seen())), watch.total, watch.what)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_POLL)
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()
    code = process.returncode
    if code == ABSENT:
        raise UsageError("fprf process: pycolmap 4 or newer is needed; install it with: pip install 'fprf[sfm]'")
    if code == NOTHING:
        raise DataError(
            f"{place.root}: no two images fit together; take more views with more overlap, of places with texture "
            f"({place.log} has COLMAP's words)"
        )
    if code:
        raise DataError(f"{place.root}: COLMAP's {name} ended with {code}: {_last(place.log)}; {place.log} has the rest")
    watch.progress(watch.total, watch.total, watch.what)
    state.seconds[name] = round(time.perf_counter() - start, 2)


def _progress_file(place: Place) -> Path:
    return place.work / "progress.jsonl"


def _registered(place: Place) -> int:
    """Images with a pose so far."""
    lines = [line for line in _progress_file(place).read_text(encoding="utf-8").splitlines() if line.startswith("{")]
    return len(lines) + 1 if lines else 0


def _last(log: Path) -> str:
    lines = [line.strip() for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    return lines[-1][-200:] if lines else "nothing was said"


def _read(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
