"""The steps of COLMAP, one process each. A step that was done from the same images and settings is not done
again.

Features and matches go into a database as they are found: a step that was cut off goes on where it stood.
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
from typing import Any

from ..errors import DataError, UsageError
from ..io.atomic import write_json, write_text
from .config import SfmConfig
from .images import lost_files
from .lenses import (
    MIN_IMAGES_OF_LENS,
    MIN_LOST_SHARE,
    Grouping,
    Trial,
    better_models,
    choose_trial,
    clustered_groupings,
    hinted_groupings,
    lens_sentence,
    own_lenses,
    shared_lenses,
    unsaid_lenses,
)
from .motion import still_share
from .pairs import (
    LARGEST_FEATURES,
    Descriptors,
    Pair,
    largest_features,
    sequential_pairs,
    shared_features,
    similar_pairs,
)
from .scene_folder import MatchTables, Progress, SceneFolder, State, count_rows, step_key, tried_pairs
from .worker import NO_MODEL, NO_PYCOLMAP

_MAX_EXHAUSTIVE_IMAGES = 30
"""Images up to which `auto` matches all with all: 435 pairs, a quarter of a minute on two cores."""
_MAX_LOST_PAIRS = 7140
"""Pairs by which `auto` looks for partners of images without a pose, at most: all of 120 images, minutes on two
cores."""
_ORDER_NEIGHBOURS = 2
"""Neighbours by name that photographs are matched with beside those that look alike: where things look alike
everywhere they help."""
_WORKER_POLL_SECONDS = 0.2
"""Seconds between looks at a running step."""
_MAX_LAST_WORDS = 200
"""Characters of COLMAP's last line that an error repeats."""
_MIN_STILL_SHARE = 0.5
"""Share of the matched pairs that stand still from which on it is said: of a turntable before a background nearly
all do, of a walk none. By eye."""
_TITLES = {
    "features": "finding features",
    "matches": "matching",
    "mapping": "finding poses",
    "lenses": "comparing lenses",
}
_COMMAND = (sys.executable, "-m", "fprf.reconstruction.worker")


class _NothingFitsError(DataError):
    """No two images fit together."""


def find_features(place: SceneFolder, state: State, config: SfmConfig, progress: Progress) -> None:
    """Features of every image; those of an image that has changed or gone take all others with them."""
    settings: list[Any] = [config.lens, config.cameras, config.features, config.side, config.seed]
    if state.masks:
        settings.append(state.masks)
    hashes = {}
    for name, image in state.images.items():
        hashes[name] = image["sha256"]
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
    lenses = shared_lenses(state.images)
    groups: dict[str, list[str]] = {}
    for name in state.images:
        alike = name if config.cameras == "each" else lenses[name]
        groups.setdefault(alike, []).append(name)
    job = {
        "step": "features",
        "groups": list(groups.values()),
        "lens": config.lens.upper().replace("-", "_"),
        "features": config.features,
        "side": config.side,
        "masks": str(place.masks) if state.masks else "",
    }
    state.seconds.pop("features", None)
    _run(place, state, config, job, lambda: count_rows(place.database)[0], len(state.images), progress)
    state.done["features"] = key
    state.save(place)


def find_matches(place: SceneFolder, state: State, config: SfmConfig, progress: Progress) -> str:
    """Matches of the pairs that `matching` says. Returns what it was decided to be."""
    names = list(state.images)
    video = "frames" in state.done
    kind = config.matching
    if kind == "auto":
        if len(names) <= _MAX_EXHAUSTIVE_IMAGES:
            kind = "exhaustive"
        else:
            kind = "similar"
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
        near = sequential_pairs(len(names), config.overlap if video else _ORDER_NEIGHBOURS)
        largest: list[Descriptors] = []
        for name in names:
            largest.append(largest_features(place.database, name, LARGEST_FEATURES))
        shared = shared_features(largest, lambda done, total: progress(done, total, "comparing images"))
        chosen = sorted({*near, *similar_pairs(shared, config.neighbours)})
    state.seconds.pop("matches", None)
    _match(place, state, config, progress, names, chosen)
    state.done["matches"] = key
    state.save(place)
    return kind


def _match(
    place: SceneFolder,
    state: State,
    config: SfmConfig,
    progress: Progress,
    names: list[str],
    chosen: list[Pair],
) -> None:
    """Match pairs of images that are listed by number; those in the database are left as they are."""
    listed = place.work / "pairs.txt"
    write_text(listed, "".join(f"{names[a]} {names[b]}\n" for a, b in chosen))
    tried = tried_pairs(place.database)
    fresh = sum(frozenset((names[a], names[b])) not in tried for a, b in chosen)
    before = len(chosen) - fresh
    job = {"step": "matches", "pairs": str(listed)}
    _run(
        place,
        state,
        config,
        job,
        lambda: before + count_rows(place.database)[1] - len(tried),
        len(chosen),
        progress,
    )


def find_poses(
    place: SceneFolder, state: State, config: SfmConfig, progress: Progress
) -> list[dict[str, Any]]:
    """The largest model in `sparse/0`; all of them described. Raises DataError where no two images fit
    together.
    """
    # With `auto` lost images are matched once more: the same pairs may end in other poses.
    key = step_key(state.done["matches"], "mapping" if config.matching == "auto" else "mapping as matched")
    described = place.work / "models" / "models.json"
    if state.done.get("mapping") == key and (place.model / "images.bin").is_file() and described.is_file():
        return list(json.loads(described.read_text(encoding="utf-8")))
    for old in (
        described.parent,
        place.work / "models_each",
        place.work / "models_lenses",
        place.work / "models_again",
    ):
        shutil.rmtree(old, ignore_errors=True)
    state.seconds.pop("mapping", None)
    state.seconds.pop("lenses", None)
    state.notes.pop("lenses", None)
    models = _map_with_lost(place, state, config, progress, described.parent)
    if config.cameras == "shared":
        models = _with_lenses_told_apart(place, state, config, progress, models)
    # The model appears as a whole: copied beside its place, and renamed.
    fresh = place.root / "sparse" / ".fresh"
    shutil.rmtree(fresh, ignore_errors=True)
    shutil.copytree(described.parent / "best", fresh)
    shutil.rmtree(place.model, ignore_errors=True)
    fresh.rename(place.model)
    state.done["mapping"] = key
    state.save(place)
    return models


def _map(
    place: SceneFolder,
    state: State,
    config: SfmConfig,
    progress: Progress,
    out: Path,
    trial: Trial | None = None,
) -> list[dict[str, Any]]:
    """Reconstruct into a folder, with the lenses of a trial where one is given; the models described, the
    largest first.
    """

    def registered() -> int:
        """Images with a pose so far: a line for each but the first."""
        lines = 0
        for line in place.progress.read_text(encoding="utf-8").splitlines():
            lines += line.startswith("{")
        return lines + 1 if lines else 0

    lenses: dict[str, str] = {}
    focal: dict[str, float] = {}
    if trial is not None:
        lenses = trial.grouping.lenses
        for name, value in trial.focal.items():
            focal[lenses[name]] = value
    known = not unsaid_lenses(state.images)
    job = {"step": "mapping", "models": str(out), "lenses": lenses, "focal": focal, "focal_known": known}
    _run(place, state, config, job, registered, len(state.images), progress)
    return list(json.loads((out / "models.json").read_text(encoding="utf-8")))


def _with_lenses_told_apart(
    place: SceneFolder,
    state: State,
    config: SfmConfig,
    progress: Progress,
    models: list[dict[str, Any]],
) -> list[dict[str, Any]]:
    """The models, or better ones with more lenses where residuals tell that images of one size have several.

    A reconstruction that is there is kept, whatever happens here.
    """
    if not unsaid_lenses(state.images):
        return models
    main = place.work / "models"
    each = place.work / "models_each"
    told = place.work / "models_lenses"
    try:
        # A lens that is far from the others' is not posed at all by theirs: then each image gets its own first,
        # which is no result (focal lengths run away) but tells them apart.
        start = main
        if _lost_by_lens(place, state, models):
            own = Trial(grouping=own_lenses(state.images), error=0.0, focal={})
            if better_models(models, _map(place, state, config, progress, each, own)):
                start = each
        trial = _compare_lenses(place, state, config, progress, start)
        if trial.grouping.lenses == shared_lenses(state.images):
            return models
        finer = _map(place, state, config, progress, told, trial)
        if not better_models(models, finer):
            return models
        shutil.rmtree(main)
        told.rename(main)
        state.notes["lenses"] = [lens_sentence(trial, models[0], finer[0])]
        return finer
    except DataError as error:
        state.notes["lenses"] = [f"lenses could not be compared, images of one size share one: {error}"]
        return models
    finally:
        shutil.rmtree(each, ignore_errors=True)
        shutil.rmtree(told, ignore_errors=True)


def _map_with_lost(
    place: SceneFolder, state: State, config: SfmConfig, progress: Progress, out: Path
) -> list[dict[str, Any]]:
    """Reconstruct into a folder; with `auto` once more where images without a pose find partners among all."""
    try:
        models = _map(place, state, config, progress, out)
    except _NothingFitsError:
        if config.matching != "auto" or not _match_lost(place, state, config, progress, []):
            raise
        return _map(place, state, config, progress, out)
    if config.matching == "auto" and _match_lost(place, state, config, progress, models):
        return _better_map(place, state, config, progress, models)
    return models


def _match_lost(
    place: SceneFolder, state: State, config: SfmConfig, progress: Progress, models: list[dict[str, Any]]
) -> bool:
    """Match images without a pose in the main model, if there is one, with all others. True where one has found
    a partner.
    """
    names = list(state.images)
    lost = set(names)
    if models:
        lost -= set(models[0]["images"])
    tried = tried_pairs(place.database)
    chosen = []
    for a, b in itertools.combinations(range(len(names)), 2):
        pair = frozenset((names[a], names[b]))
        if pair & lost and pair not in tried:
            chosen.append((a, b))
    # The nearest in order come first where they are too many.
    chosen = sorted(sorted(chosen, key=lambda pair: pair[1] - pair[0])[:_MAX_LOST_PAIRS])
    if not chosen:
        return False
    before = MatchTables(place.database).partners.total()
    _match(place, state, config, progress, names, chosen)
    state.save(place)
    return MatchTables(place.database).partners.total() > before


def _better_map(
    place: SceneFolder, state: State, config: SfmConfig, progress: Progress, models: list[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Reconstruct again, from more matches; the models of before where these pose as many images or more."""
    main = place.work / "models"
    again = place.work / "models_again"
    try:
        more = _map(place, state, config, progress, again)
        if not better_models(models, more):
            return models
        shutil.rmtree(main)
        again.rename(main)
        return more
    finally:
        shutil.rmtree(again, ignore_errors=True)


def _lost_by_lens(place: SceneFolder, state: State, models: list[dict[str, Any]]) -> bool:
    """True where many images find matches but no pose, and their lenses may be others."""
    posed = set(models[0]["images"])
    partners = MatchTables(place.database).partners
    lost = 0
    for name in unsaid_lenses(state.images):
        lost += name not in posed and partners[name] > 0
    return lost >= max(MIN_IMAGES_OF_LENS, MIN_LOST_SHARE * len(state.images))


def _compare_lenses(
    place: SceneFolder, state: State, config: SfmConfig, progress: Progress, models: Path
) -> Trial:
    """Best grouping by lens of the images of the main one of some models."""
    result = place.work / "lenses.result.json"

    def solved() -> int:
        return place.progress.read_text(encoding="utf-8").count("{")

    def tried(groupings: list[Grouping]) -> list[Trial]:
        """Groupings after bundle adjustment."""
        job = {
            "step": "lenses",
            "model": str(models / "best"),
            "groupings": [grouping.lenses for grouping in groupings],
            "result": str(result),
        }
        _run(place, state, config, job, solved, len(groupings), progress)
        trials = []
        found = json.loads(result.read_text(encoding="utf-8"))
        for grouping, row in zip(groupings, found, strict=True):
            trials.append(Trial(grouping=grouping, error=row["error"], focal=row["focal"]))
        return trials

    shared = Grouping(lenses=shared_lenses(state.images), reason="size")
    trials = tried([shared, own_lenses(state.images)])
    groupings = hinted_groupings(state.images) + clustered_groupings(state.images, trials[1].focal)
    if groupings:
        trials += tried(groupings)
    return choose_trial(trials)


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
                    process.wait(_WORKER_POLL_SECONDS)
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
        raise _nothing_fits(place, state)
    if code:
        lines = []
        for line in place.log.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.strip():
                lines.append(line)
        if lines:
            last = lines[-1].strip()[-_MAX_LAST_WORDS:]
        else:
            last = "nothing was said"
        raise DataError(f"{place.root}: COLMAP's {name} ended with {code}: {last}; {place.log} has the rest")
    progress(total, total, what)
    before = state.seconds.get(name, 0.0)
    state.seconds[name] = round(before + time.perf_counter() - start, 2)


def _nothing_fits(place: SceneFolder, state: State) -> _NothingFitsError:
    """Error for images of which no two fit together, with what is known of the reason."""
    # What the decoders lost comes first: it may be all that is wrong.
    unread = sorted(set(state.images) - set(MatchTables(place.database).features))
    lost = []
    if told := lost_files(state):
        lost.append(told)
    if unread:
        lost.append(
            f"COLMAP cannot decode {len(unread)} of {len(state.images)} images, for example {unread[0]}"
        )
    if not lost and still_share(place.database) >= _MIN_STILL_SHARE:
        return _NothingFitsError(
            f"{place.root}: all images fit together, but what they share stands still: seen from the background "
            "the camera never moved, as with an object on a turntable; give masks that are black on the background with "
            "--masks FOLDER (and another --output), or walk around with the camera"
        )
    if lost:
        rest = "no two of the other images fit together"
    else:
        rest = "no two images fit together"
    return _NothingFitsError(
        f"{place.root}: {'; '.join([*lost, rest])}; take more views with more overlap, of places with texture "
        f"({place.log} has COLMAP's words)"
    )
