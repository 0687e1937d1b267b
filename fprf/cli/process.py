"""`fprf process IMAGES|VIDEO --output SCENE`: poses for images that have none, by COLMAP's Python package."""

import shlex
from dataclasses import dataclass
from pathlib import Path

from ..progress import Display
from ..reconstruction.config import SfmConfig
from .parsing import parse

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
    from ..reconstruction.process import process

    with Display() as display:
        root, content = process(config.source, config.output, config, display)
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
        print(f"all of them in {root / 'process.json'}")
    _check(root)
    return 0


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
