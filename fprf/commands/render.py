"""`fprf render RUN --path PATH --output X.mp4`: fly through a scene, plain or restyled."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ..checks import at_least
from ..engine.quality import QualityConfig, at_quality
from ..errors import ConfigError
from ..style.config import StyleConfig
from .keyframes import keyed_looks, read_keyframes
from .progress import Display
from .style_flags import read_flags

if TYPE_CHECKING:
    from ..engine.loading import Trained
    from ..output.images import Picture
    from ..rendering.cameras import Cameras
    from ..style.files import StyleFile
    from ..style.look import Restyle

__all__ = ["RenderVerbConfig", "camera_path", "frames_of", "run"]


@dataclass(frozen=True, kw_only=True)
class RenderVerbConfig(StyleConfig, QualityConfig):
    """What to film, and how."""

    run: Path = Path()
    """Run folder."""
    output: Path = Path("render.mp4")
    """A film (.mp4) or a folder for numbered PNG frames."""
    path: str = "interpolate"
    """spiral, orbit, interpolate, dataset, or a camera-path JSON file of Nerfstudio."""
    split: Literal["test", "train", "all"] = "all"
    """Views that `interpolate` and `dataset` go through."""
    frames: int = 120
    """Frames of a spiral or orbit; about as many of an interpolation."""
    fps: float = 24.0
    """Frames per second of a film."""
    style: Path | None = None
    """A style file, as `fprf stylize` writes it; flags come over it."""
    keyframes: Path | None = None
    """Styles along the path: a JSON file that gives frames their style files; between them one fades into the other."""
    depth: bool = False
    """Film depth instead of colour."""
    device: str = "auto"
    """cpu, cuda, mps, or auto."""

    def __post_init__(self) -> None:
        StyleConfig.__post_init__(self)
        QualityConfig.__post_init__(self)
        at_least("frames", self.frames, 1)
        at_least("fps", self.fps, 1)
        if self.keyframes is not None and (self.references or self.style):
            raise ConfigError("keyframes: names styles of its own; leave out --references and --style, or --keyframes")


def run(args: list[str]) -> int:
    """Make the path, render it, write the film or the frames."""
    description = "Fly through a trained scene, plain or restyled, to a film or frames."
    config, file = read_flags(RenderVerbConfig(), args, prog="fprf render", description=description, positional=("run",))
    from ..engine.loading import load_run
    from ..output.video import write_frames, write_video

    trained = at_quality(load_run(config.run, config.device, config.max_memory), config)
    cameras, names = camera_path(trained, config)
    looks = _looks(trained, config, file)
    start = time.perf_counter()
    with Display() as display:
        frames = frames_of(trained, cameras, looks, display, depth=config.depth)
        if config.output.suffix.lower() == ".mp4":
            codec = write_video(config.output, frames, config.fps)
            made = f"{config.output} ({codec})"
        else:
            write_frames(config.output, names, frames)
            made = str(config.output)
    seconds = time.perf_counter() - start
    print(f"{len(cameras)} frames in {made}, {seconds / len(cameras):.2f} s each")
    return 0


def _looks(trained: "Trained", config: RenderVerbConfig, file: "StyleFile") -> "Callable[[int], Restyle | None]":
    """The look of each frame: of the keyframes, of one style, or none."""
    if config.keyframes is not None:
        return keyed_looks(trained, read_keyframes(config.keyframes))
    if not config.references:
        return lambda frame: None
    from ..engine.restyle import apply_style

    styled = apply_style(trained, file)
    for note in styled.orders.notes:
        print(note)
    return lambda frame: styled.restyle


def camera_path(trained: "Trained", config: RenderVerbConfig) -> tuple["Cameras", list[str]]:
    """Cameras of the path and a name for each frame; captured views keep the stem of their image."""
    from ..rendering.motions import make_path

    known, views = trained.known, trained.known.split(config.split)
    cameras = make_path(known.cameras, views, config.path, config.frames)
    if config.path == "dataset":
        return cameras, [known.names[view] for view in views]
    return cameras, [f"{i:05d}" for i in range(len(cameras))]


def frames_of(
    trained: "Trained",
    cameras: "Cameras",
    looks: "Callable[[int], Restyle | None]",
    display: Display,
    *,
    depth: bool = False,
) -> Iterator["Picture"]:
    """Rendered frames one by one, each in its own look."""
    from ..engine.views import render_view
    from ..output.images import to_uint8
    from ..output.maps import depth_image

    for i in range(len(cameras)):
        display.count(i, len(cameras), "rendering")
        view = render_view(trained.model, trained.known.facts, cameras, i, trained.config.render, looks(i))
        yield depth_image(view.depth, view.opacity) if depth else to_uint8(view.rgb)
    display.count(len(cameras), len(cameras), "rendering")
