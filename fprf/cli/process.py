"""`fprf process IMAGES|VIDEO --output SCENE`: poses for images that have none, by COLMAP's Python package."""

import shlex
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import __version__
from ..errors import UsageError
from ..progress import Display
from ..reconstruction.config import SfmConfig
from .parsing import parse

if TYPE_CHECKING:
    from ..reconstruction.scene_folder import SceneFolder, State

MINUTES = 3
"""Minutes of the printed training command."""
_MAX_NAMED_IMAGES = 12
"""Images that a step lost that are named one by one, at most: by eye, half a screen."""

_PROCESS_HELP = """Find poses for a folder of images or for a video, and make a scene folder that `fprf train` reads.

Needs no other program. Run again, it goes on where it stopped."""


@dataclass(frozen=True, kw_only=True)
class ProcessConfig(SfmConfig):
    """Settings of `fprf process`."""

    source: Path = Path()
    """A folder of images, or a video."""
    output: Path | None = None
    """The scene folder to make; by default scenes/NAME."""


def run(args: list[str]) -> int:
    """Choose, match, reconstruct; report what was dropped; check that the scene can be read."""
    config = parse(
        ProcessConfig(), args, prog="fprf process", description=_PROCESS_HELP, positional=("source",)
    )
    if find_spec("pycolmap") is None:
        raise UsageError(
            "fprf process: pycolmap is not installed; install it with: pip install 'pycolmap>=4'"
        )
    config = replace(config, source=_source(config.source))
    from ..io.folder_lock import lock_folder
    from ..reconstruction.scene_folder import SceneFolder

    place = SceneFolder(
        config.output if config.output is not None else Path("scenes") / config.source.resolve().stem
    )
    with lock_folder(place.root, "is finding poses here"), Display() as display:
        content = _reconstruct(config, place, display)
    images = content["images"]
    print(
        f"{images['posed']} of {images['given']} images have a pose; {content['points']} points, "
        f"{content['error_pixels']:.2f} pixels off; {content['matching']} matching, "
        f"{sum(content['step_seconds'].values()):.0f} s"
    )
    # A step that lost many images is one line, with an example.
    for step in ("choosing", "features", "matching", "mapping"):
        dropped = []
        for drop in content["dropped"]:
            if drop["step"] == step:
                dropped.append(drop)
        for drop in dropped if len(dropped) <= _MAX_NAMED_IMAGES else dropped[:1]:
            if len(dropped) <= _MAX_NAMED_IMAGES:
                count = ""
            else:
                count = f"{len(dropped)} images, for example "
            print(f"lost in {step}: {count}{drop['image']}: {drop['reason']}")
    if content["dropped"]:
        print(f"all of them in {place.root / 'process.json'}")
    _check(place.root)
    return 0


def _source(given: Path) -> Path:
    """The folder or video that is given; of a folder that holds a video and no images that video.

    Raises UsageError where it holds several: a scene is made of one.
    """
    from ..datamanagers.images import IMAGE_SUFFIXES
    from ..io.video_reader import VIDEO_SUFFIXES

    if not given.is_dir():
        return given
    files = []
    for path in sorted(given.iterdir()):
        if path.is_file() and not path.name.startswith("."):
            files.append(path)
    videos = []
    for path in files:
        if path.suffix.lower() in VIDEO_SUFFIXES:
            videos.append(path)
    if not videos or any(path.suffix.lower() in IMAGE_SUFFIXES for path in given.rglob("*")):
        return given
    if len(videos) > 1:
        names = ", or ".join(str(path) for path in videos[:3])
        raise UsageError(f"{given}: {len(videos)} videos and no images; a scene is made of one: give {names}")
    return videos[0]


def _reconstruct(config: ProcessConfig, place: "SceneFolder", display: Display) -> dict[str, Any]:
    """Take all steps, and write what came of every image to process.json. Returns its content."""
    from ..io.atomic import write_json
    from ..reconstruction.colmap import find_features, find_matches, find_poses
    from ..reconstruction.images import gather_images, lost_files
    from ..reconstruction.masks import gather_masks
    from ..reconstruction.scene_folder import MatchTables, State, report

    state = State.load(place)
    models: list[dict[str, Any]] = []
    matching: str = config.matching
    gather_images(config.source, place, state, config, display.count)
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
        content = report(asdict(state), matching, MatchTables(place.database), models, __version__)
        write_json(place.root / "process.json", content)
    for note in _notes(state, "lenses"):
        display.say(note)
    return content


def _notes(state: "State", *steps: str) -> list[str]:
    """Decisions that some steps have made."""
    notes = []
    for step in steps:
        notes += state.notes.get(step, [])
    return notes


def _check(root: Path) -> None:
    """Read the scene as training will, and print the commands that come next. Raises DataError where it
    cannot be read.
    """
    from ..datamanagers.parsers.config import parse_scene
    from ..splats.config import GaussiansConfig
    from ..training.driver import default_output
    from ..training.prepare import planned
    from .train import DEFAULT_METHOD

    config = GaussiansConfig(data=root, minutes=MINUTES)
    delivered = parse_scene(root, 1, None)
    for note in delivered.notes:
        print(f"note: {note}")
    size = planned(config, delivered).downscale or 1
    width, height = delivered.cameras.scaled(size).size[0].tolist()
    run = default_output(config, DEFAULT_METHOD)
    print(f"{len(delivered.train)} + {len(delivered.test)} views, trained at {width}x{height}")
    print(f"fprf train --data {shlex.quote(str(root))} --minutes {MINUTES}")
    print(f"fprf stylize {shlex.quote(str(run))} --references PHOTO.jpg")
