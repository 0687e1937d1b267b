"""Images or a video to a scene folder with camera poses: all steps, one after the other."""

from dataclasses import asdict
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ..datamanagers.images import IMAGE_SUFFIXES
from ..errors import UsageError
from ..io.atomic import write_json
from ..io.folder_lock import lock_folder
from ..io.video_reader import VIDEO_SUFFIXES
from ..progress import Display
from .colmap import find_features, find_matches, find_poses
from .config import SfmConfig
from .images import gather_images, lost_files
from .masks import gather_masks
from .scene_folder import MatchTables, SceneFolder, State, report


def process(
    source: Path, output: Path | None, config: SfmConfig, display: Display
) -> tuple[Path, dict[str, Any]]:
    """Find poses for images or a video; going on where an earlier start stopped. Returns the scene folder, by
    default scenes/NAME, and what came of every image: the content of its process.json.

    Raises UsageError where pycolmap or the source is missing, DataError where no poses can be found or another
    process works in the folder.
    """
    if find_spec("pycolmap") is None:
        raise UsageError(
            "fprf process: pycolmap is not installed; install it with: pip install 'pycolmap>=4'"
        )
    source = _video_within(source)
    if output is None:
        output = Path("scenes") / source.resolve().stem
    place = SceneFolder(output)
    with lock_folder(place.root, "is finding poses here"):
        return place.root, _reconstruct(source, config, place, display)


def _video_within(given: Path) -> Path:
    """The folder or video that is given; of a folder that holds a video and no images that video.

    Raises UsageError where it holds several: a scene is made of one.
    """
    if not given.is_dir():
        return given
    videos = []
    for path in sorted(given.iterdir()):
        if path.is_file() and not path.name.startswith(".") and path.suffix.lower() in VIDEO_SUFFIXES:
            videos.append(path)
    if not videos or any(path.suffix.lower() in IMAGE_SUFFIXES for path in given.rglob("*")):
        return given
    if len(videos) > 1:
        names = ", or ".join(str(path) for path in videos[:3])
        raise UsageError(f"{given}: {len(videos)} videos and no images; a scene is made of one: give {names}")
    return videos[0]


def _reconstruct(source: Path, config: SfmConfig, place: SceneFolder, display: Display) -> dict[str, Any]:
    """Take all steps, and write what came of every image to process.json. Returns its content."""
    state = State.load(place)
    models: list[dict[str, Any]] = []
    matching: str = config.matching
    gather_images(source, place, state, config, display.count)
    gather_masks(config.masks, place, state)
    for note in (lost_files(state), *_notes(state, "left out", "frames", "masks")):
        if note:
            display.say(note)
    # Each step is skipped where `state` says that it was done for the same files and settings.
    find_features(place, state, config, display.count)
    matching = find_matches(place, state, config, display.count)
    try:
        models = find_poses(place, state, config, display.count)
    finally:
        content = report(asdict(state), matching, MatchTables(place.database), models, version("fprf"))
        write_json(place.root / "process.json", content)
    for note in _notes(state, "lenses"):
        display.say(note)
    return content


def _notes(state: State, *steps: str) -> list[str]:
    """Decisions that some steps have made."""
    notes = []
    for step in steps:
        notes += state.notes.get(step, [])
    return notes
