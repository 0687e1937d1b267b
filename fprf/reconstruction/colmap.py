"""The steps of COLMAP, one process each. A step that was done from the same images and settings is not done
again.

Features and matches go into a database as they are found: a step that was cut off goes on where it stood.

Which images look alike is told before they are matched by one vector each (VLAD, Jégou et al., 2010), from a
vocabulary of the scene's own features: descriptors are assigned to visual words, k-means centres of a sample
of all; the differences to the centres are summed word by word, tamed by a square root and scaled to length 1,
word by word and altogether.
"""

import contextlib
import itertools
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, UsageError
from ..io.atomic import write_json, write_text
from .config import SfmConfig
from .images import lost_files
from .scene_folder import MatchTables, Progress, SceneFolder, State, count_rows, reading, step_key
from .worker import NO_MODEL, NO_PYCOLMAP

Pair: TypeAlias = tuple[int, int]
Descriptors = Annotated[NDArray[np.uint8], "N 128"]
Words = Annotated[NDArray[np.float32], "W 128"]
Reader = Callable[[int], Descriptors]

_SAMPLE = 40_000
_MOST = 2000
"""Descriptors that the words are made of, and evenly taken ones of an image that its vector is made of, at
most.
"""
_ROUNDS = 12
"""Rounds of k-means, at most."""
_ALL_PAIRS = 120
"""Images up to which `auto` matches all with all."""
_WORDS = 64
_POLL = 0.2
"""Seconds between looks at a running step."""
_TITLES = {"features": "finding features", "matches": "matching", "mapping": "finding poses"}
_COMMAND = (sys.executable, "-m", "fprf.reconstruction.worker")


def descriptors(path: Path, name: str) -> NDArray[np.uint8]:
    """SIFT descriptors [N 128] of an image; none for an image without."""
    with reading(path) as base:
        row = base.execute(
            "SELECT rows, cols, data FROM descriptors JOIN images USING (image_id) WHERE name = ?", (name,)
        ).fetchone()
    if row is None or not row[0]:
        return np.zeros((0, 128), np.uint8)
    return np.frombuffer(row[2], np.uint8).reshape(row[0], row[1])


def sequential_pairs(count: int, overlap: int) -> list[Pair]:
    """Each with the next `overlap` ones, and with those at distances 2, 4, 8, ... up to 2 ** overlap."""
    steps = sorted({*range(1, overlap + 1), *(2**k for k in range(overlap + 1))})
    found: list[Pair] = []
    for a in range(count):
        for step in steps:
            if a + step < count:
                found.append((a, a + step))
    return found


def similar_pairs(vectors: Annotated[NDArray[np.float32], "V X"], nearest: int) -> list[Pair]:
    """Each with those whose unit vectors are most like its own, by cosine; an image without a vector (all 0)
    with none.
    """
    # Cosines, without those of images with themselves and of images that nothing is known of.
    likeness = vectors @ vectors.T
    empty = ~vectors.any(axis=1)
    likeness[empty] = likeness[:, empty] = -np.inf
    np.fill_diagonal(likeness, -np.inf)
    count = min(nearest, max(0, len(vectors) - 1))
    best = np.argsort(-likeness, axis=1, kind="stable")[:, :count]
    pairs = set()
    for a, row in enumerate(best.tolist()):
        for b in row:
            if np.isfinite(likeness[a, b]):
                pairs.add((min(a, b), max(a, b)))
    return sorted(pairs)


def build_vocabulary(read: Reader, count: int, number: int, seed: int = 0) -> Words:
    """`number` visual words, or fewer where there are fewer descriptors; `read(i)` gives those of image i of
    `count`.
    """
    # A sample of all descriptors, as many of each image.
    rng = np.random.default_rng(seed)
    each = max(1, _SAMPLE // max(1, count))
    parts = []
    for image in range(count):
        features = read(image)
        parts.append(features[rng.permutation(len(features))[:each]])
    if parts:
        sample = np.concatenate(parts).astype(np.float32)
    else:
        sample = np.zeros((0, 128), np.float32)
    if len(sample) <= number:
        return sample
    # cv2 draws from a generator of its own.
    stop = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, _ROUNDS, 1e-3)
    cv2.setRNGSeed(seed)
    start = rng.permutation(len(sample))[:number]
    # k-means begins with some of the descriptors as centres: cv2 takes them as the labels of all.
    labels = np.argmin(_distances(sample, sample[start]), axis=1).astype(np.int32)[:, None]
    centres = cv2.kmeans(sample, number, labels, stop, 1, cv2.KMEANS_USE_INITIAL_LABELS)[2]
    return np.asarray(centres, dtype=np.float32)


def vlad_vectors(read: Reader, count: int, vocabulary: Words) -> Annotated[NDArray[np.float32], "V X"]:
    """A unit vector an image; 0 for an image without descriptors."""
    result = np.zeros((count, vocabulary.size), np.float32)
    for image in range(count):
        features = read(image)
        some = features[:: -(-len(features) // _MOST) or 1].astype(np.float32)
        if not len(some) or not len(vocabulary):
            continue
        # Differences to the nearest word, summed word by word, tamed, and scaled to length 1 word by word and
        # altogether.
        nearest = np.argmin(_distances(some, vocabulary), axis=1)
        sums = np.zeros_like(vocabulary)
        np.add.at(sums, nearest, some - vocabulary[nearest])
        sums = np.sign(sums) * np.sqrt(np.abs(sums))
        sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
        flat = sums.reshape(-1)
        result[image] = flat / max(float(np.linalg.norm(flat)), 1e-12)
    return result


def _distances(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """Squared distances less a constant of each row."""
    distances: NDArray[np.float32] = (b * b).sum(1)[None] - 2 * (a @ b.T)
    return distances


def find_features(place: SceneFolder, state: State, config: SfmConfig, progress: Progress) -> None:
    """Features of every image; those of an image that has changed or gone take all others with them."""
    settings = [config.lens, config.cameras, config.features, config.side, config.seed]
    hashes = {name: image["sha256"] for name, image in state.images.items()}
    # Images may be added to those of before; other settings, or an image that has changed, begin anew.
    before: Any = None
    with contextlib.suppress(OSError, ValueError):
        before = json.loads((place.work / "features.json").read_text(encoding="utf-8"))
    before = before if isinstance(before, dict) else {}
    grown = before.get("settings") == settings and before.get("hashes", {}).items() <= hashes.items()
    if not grown:
        for old in place.work.glob("database.db*"):
            old.unlink()
    key = step_key(settings, hashes)
    if state.done.get("features") == key and place.database.is_file():
        return
    # From now on the database is of these images: a step that is cut off goes on with them.
    write_json(place.work / "features.json", {"settings": settings, "hashes": hashes})
    # Images of one size and lens share a camera, unless each is to have its own.
    groups: dict[str, list[str]] = {}
    for name, image in state.images.items():
        shared = config.cameras == "shared"
        alike = [image["width"], image["height"], image["lens"]] if shared else name
        groups.setdefault(json.dumps(alike), []).append(name)
    job = {
        "step": "features",
        "groups": list(groups.values()),
        "lens": config.lens.upper().replace("-", "_"),
        "features": config.features,
        "side": config.side,
    }
    _run(place, state, config, job, lambda: count_rows(place.database)[0], len(state.images), progress)
    state.done["features"] = key
    state.save(place)


def find_matches(place: SceneFolder, state: State, config: SfmConfig, progress: Progress) -> str:
    """Matches of the pairs that `matching` says. Returns what it was decided to be."""
    names = list(state.images)
    video = "frames" in state.done
    kind = config.matching
    if kind == "auto":
        kind = "exhaustive" if len(names) <= _ALL_PAIRS else "similar"
    key = step_key(state.done["features"], kind, config.overlap, config.neighbours)
    if state.done.get("matches") == key and place.database.is_file():
        return kind
    # Pairs of numbers of images, each pair once.
    if kind == "exhaustive":
        chosen = list(itertools.combinations(range(len(names)), 2))
    elif kind == "sequential":
        chosen = sequential_pairs(len(names), config.overlap)
    else:
        # Neighbours by name help where things look alike everywhere; in a video they are neighbours for
        # certain.
        near = sequential_pairs(len(names), config.overlap if video else 2)

        def read(image: int) -> Descriptors:
            return descriptors(place.database, names[image])

        vectors = vlad_vectors(read, len(names), build_vocabulary(read, len(names), _WORDS, config.seed))
        chosen = sorted({*near, *similar_pairs(vectors, config.neighbours)})
    listed = place.work / "pairs.txt"
    write_text(listed, "".join(f"{names[a]} {names[b]}\n" for a, b in chosen))
    job = {"step": "matches", "pairs": str(listed)}
    _run(place, state, config, job, lambda: count_rows(place.database)[1], len(chosen), progress)
    state.done["matches"] = key
    state.save(place)
    return kind


def find_poses(
    place: SceneFolder, state: State, config: SfmConfig, progress: Progress
) -> list[dict[str, Any]]:
    """The largest model in `sparse/0`; all of them described. Raises DataError where no two images fit
    together.
    """
    key = step_key(state.done["matches"], "mapping")
    described = place.work / "models" / "models.json"
    if state.done.get("mapping") == key and (place.model / "images.bin").is_file() and described.is_file():
        return list(json.loads(described.read_text(encoding="utf-8")))
    shutil.rmtree(described.parent, ignore_errors=True)

    def registered() -> int:
        """Images with a pose so far: a line for each but the first."""
        lines = []
        for line in place.progress.read_text(encoding="utf-8").splitlines():
            if line.startswith("{"):
                lines.append(line)
        return len(lines) + 1 if lines else 0

    job = {"step": "mapping", "models": str(described.parent)}
    _run(place, state, config, job, registered, len(state.images), progress)
    # The model appears as a whole: copied beside its place, and renamed.
    fresh = place.root / "sparse" / ".fresh"
    shutil.rmtree(fresh, ignore_errors=True)
    shutil.copytree(described.parent / "best", fresh)
    shutil.rmtree(place.model, ignore_errors=True)
    fresh.rename(place.model)
    state.done["mapping"] = key
    state.save(place)
    return list(json.loads(described.read_text(encoding="utf-8")))


def _run(
    place: SceneFolder,
    state: State,
    config: SfmConfig,
    job: dict[str, Any],
    count: Callable[[], int],
    total: int,
    progress: Progress,
) -> None:
    """One step in its process, which is `count()` of `total` far. Raises UsageError where pycolmap is absent,
    DataError where COLMAP fails.
    """
    name = job["step"]
    start = time.perf_counter()
    what = _TITLES[name]
    path = place.work / f"{name}.job.json"
    common = {
        "database": str(place.database),
        "images": str(place.images),
        "threads": -1 if config.threads is None else config.threads,
        "cpu": not config.gpu,
        "seed": config.seed,
    }
    write_json(path, {**common, **job})
    with place.log.open("ab") as log, place.progress.open("wb") as out:
        process = subprocess.Popen([*_COMMAND, str(path)], stdout=out, stderr=log, stdin=subprocess.DEVNULL)
        try:
            while process.poll() is None:
                progress(max(0, min(total - 1, count())), total, what)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_POLL)
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()
    # Exit codes of the worker, in sentences.
    code = process.returncode
    if code == NO_PYCOLMAP:
        raise UsageError(
            "fprf process: pycolmap 4 or newer is needed; install it with: pip install 'pycolmap>=4'"
        )
    if code == NO_MODEL:
        # What the decoders lost comes first: it may be all that is wrong.
        unread = sorted(set(state.images) - set(MatchTables(place.database).features))
        if unread:
            missed = (
                f"COLMAP cannot decode {len(unread)} of {len(state.images)} images, for example {unread[0]}"
            )
        else:
            missed = ""
        lost = "; ".join(filter(None, [lost_files(state), missed]))
        if lost:
            rest = "no two of the other images fit together"
        else:
            rest = "no two images fit together"
        raise DataError(
            f"{place.root}: {f'{lost}; ' if lost else ''}{rest}; take more views with more overlap, of places with texture "
            f"({place.log} has COLMAP's words)"
        )
    if code:
        lines = []
        for line in place.log.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.strip():
                lines.append(line)
        last = lines[-1].strip()[-200:] if lines else "nothing was said"
        raise DataError(f"{place.root}: COLMAP's {name} ended with {code}: {last}; {place.log} has the rest")
    progress(total, total, what)
    state.seconds[name] = round(time.perf_counter() - start, 2)
