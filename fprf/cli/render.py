"""`fprf render RUN --path PATH --output X.mp4`: fly through a scene, plain or restyled."""

import functools
import hashlib
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from ..checks import at_least
from ..errors import ConfigError, UsageError
from ..io.paths import as_path
from ..progress import Display
from ..style.files import read_keyframes
from .style_flags import StyledRunConfig, named_files, named_styles, origin_of, read_flags

if TYPE_CHECKING:
    from ..io.images import Picture
    from ..rendering.cameras import Cameras
    from ..scenes import Scene
    from ..style.files import StyleFile
    from ..style.restyle import Styled
    from ..training.loading import LoadedRun

_NO_FOLDERS = frozenset(
    {".avi", ".bmp", ".exr", ".jpeg", ".jpg", ".m4v", ".mkv", ".mov", ".mpg", ".png", ".tif", ".webm"}
)
"""Endings that nobody gives a folder."""
_PROBES = 4
"""Frames that the range of depths is taken from, one range for a whole film: by eye."""
_PROBE_RESOLUTION = 0.25
"""Share of their width and height at which these are rendered: percentiles need no more."""
_FPS = 24.0
"""Frames per second where neither flag nor path says: that of cinema."""


class Take(NamedTuple):
    """A look of the scene along a flight."""

    name: str
    scene: "Callable[[int], Scene]"
    """In its look of each frame."""
    styled: "Styled | None" = None
    """The style where it is one throughout, for match maps."""


@dataclass(frozen=True, kw_only=True)
class RenderVerbConfig(StyledRunConfig):
    """Settings of `fprf render`."""

    output: Path = Path("render.mp4")
    """A film (.mp4), an animated picture (.gif .webp .apng), or a folder for numbered frames. Frames that an
    interrupted render left are not made again.
    """
    path: str = "interpolate"
    """spiral, orbit, interpolate, dataset, or a camera-path JSON file of Nerfstudio."""
    split: Literal["test", "train", "all"] = "all"
    """Views that `interpolate` and `dataset` go through."""
    frames: int = 120
    """Frames of a spiral or orbit; about as many of an interpolation."""
    fps: float | None = None
    """Frames per second of a film, in [1, 1000]; by default 24, or those of a camera-path file."""
    style: Path | None = None
    """A style file, as `fprf stylize` writes it; flags come over it."""
    keyframes: Path | None = None
    """Styles along the path: a JSON file that gives frames their style files; between them one fades into the
    other.
    """
    styles: tuple[str, ...] = ()
    """Further looks beside it: NAME=PHOTO,PHOTO, NAME=STYLE.json, or the word plain for the scene as it
    is.
    """
    show: tuple[Literal["colour", "depth", "normals", "match"], ...] = ("colour",)
    """Layers of each frame, from left to right."""
    format: Literal["png", "jpg"] = "png"
    """Format of frames in a folder."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least("frames", self.frames, 1)
        at_least("fps", 24 if self.fps is None else self.fps, 1)
        if not self.show:
            raise ConfigError("show: name at least one of colour, depth, normals, match")
        if self.keyframes is not None and (self.references or self.style):
            raise ConfigError(
                "keyframes: names styles of its own; leave out --references and --style, or --keyframes"
            )


class _Flight(NamedTuple):
    """Cameras of a film, and the names of its frames."""

    cameras: "Cameras"
    names: list[str]
    fps: float


def run(args: list[str]) -> int:
    """Make the path, render it, write the film or the frames."""
    description = "Fly through a trained scene, plain or restyled, to a film or frames."
    config, file = read_flags(
        RenderVerbConfig(), args, prog="fprf render", description=description, positional=("run",)
    )
    from ..io.video import FILMS, missing_frames
    from ..training.loading import open_run

    film = config.output.suffix.lower() in FILMS
    _check_output(config)
    origin = origin_of("render", config, file, _named(config))
    if film:
        origin.check([config.output])
    opened = open_run(config.run, config.device, config)
    flight = _flight(opened, config)
    paths = _frame_paths(config, flight.names, film=film)
    outputs = [config.output] if film else paths
    origin.check(outputs)
    takes = _takes(opened.scene, config, file)
    start = time.perf_counter()
    with origin.writing(outputs):
        todo = missing_frames(paths[0].parent, _key(opened, config, flight.cameras), paths)
        if len(todo) < len(paths):
            print(f"{len(paths) - len(todo)} of {len(paths)} frames are there already")
        with Display() as display:
            _render_frames(opened.scene, flight.cameras, paths, todo, takes, config, display)
        if film:
            made = _write_film(config.output, paths, flight.fps)
        else:
            made = str(config.output)
    seconds = time.perf_counter() - start
    print(f"{len(paths)} frames in {made}, {seconds / max(1, len(todo)):.2f} s each")
    return 0


def _named(config: RenderVerbConfig) -> list[Path]:
    """Files that texts among the flags name: of further styles, and a camera path."""
    named = []
    for path in [as_path(config.path)]:
        if path.is_file():
            named.append(path)
    for text in config.styles:
        if text != "plain":
            named += named_files(text.partition("=")[2])
    return named


def _check_output(config: RenderVerbConfig) -> None:
    """Raise UsageError for an output that is neither a film nor a folder, and for frames that no film shows."""
    from ..io.video import FILMS, MAX_FPS

    if config.output.suffix.lower() in _NO_FOLDERS:
        raise UsageError(
            f"--output {config.output}: films end in {' '.join(FILMS)}; give such a name, or a folder for frames"
        )
    if config.fps is not None and config.fps > MAX_FPS:
        raise UsageError(f"--fps {config.fps:g}: a film has at most {MAX_FPS} frames a second")


def _flight(opened: "LoadedRun[Scene]", config: RenderVerbConfig) -> _Flight:
    """The cameras of the path that is asked for."""
    from ..rendering.paths import MOTIONS, make_path, read_camera_path

    known = opened.known
    # Spirals, orbits and camera paths bring frames of their own.
    if config.path in ("interpolate", "dataset"):
        views = known.views(config.split)
    else:
        views = []
    cameras = make_path(known.cameras, views, config.path, config.frames, opened.scene.origin)
    if config.fps is not None:
        fps = config.fps
    elif config.path in MOTIONS:
        fps = _FPS
    else:
        fps = read_camera_path(as_path(config.path))[1]
    # Captured views keep the stem of their image.
    if config.path == "dataset":
        names = []
        for view in views:
            names.append(known.names[view])
    else:
        names = []
        for i in range(len(cameras)):
            names.append(f"{i:05d}")
    return _Flight(cameras, names, fps)


def _frame_paths(config: RenderVerbConfig, names: Sequence[str], *, film: bool) -> list[Path]:
    """The frames' files. Those of a film wait in a folder beside it, hidden as nobody's own is, which goes when
    the film is whole.
    """
    folder = config.output
    ending: str = config.format
    if film:
        folder = config.output.with_name(f".{config.output.stem}.frames")
        ending = "png"
    found: list[Path] = []
    for name in names:
        found.append(folder / f"{name}.{ending}")
    return found


def _render_frames(
    scene: "Scene",
    cameras: "Cameras",
    paths: Sequence[Path],
    todo: Sequence[Path],
    takes: "list[Take]",
    config: RenderVerbConfig,
    display: Display,
) -> None:
    """Render and write the frames that are not there yet."""
    from ..io.images import write_image
    from ..io.maps import depth_limits, side_by_side

    start = time.perf_counter()
    limits = None
    if "depth" in config.show and todo:
        # One range of depths for the whole film, from a few small frames: else colours would flicker.
        some = sorted({k * (len(cameras) - 1) // (_PROBES - 1) for k in range(_PROBES)})
        probes = []
        for k in some:
            probes.append(scene.render(cameras, k, resolution=_PROBE_RESOLUTION))
        limits = depth_limits([view.depth for view in probes], [view.opacity for view in probes])
    numbers = {}
    for number, path in enumerate(paths):
        numbers[path] = number
    for done, path in enumerate(todo):
        left = None
        if done:
            left = (time.perf_counter() - start) / done * (len(todo) - done)
        display.count(done, len(todo), "rendering", seconds_left=left)
        # Each frame is written as soon as it is done, so that an interrupted film goes on.
        panels = _panels(scene, cameras, numbers[path], takes, config, limits)
        write_image(path, side_by_side(panels))
    display.count(len(todo), len(todo), "rendering")


def _write_film(output: Path, frames: Sequence[Path], fps: float) -> str:
    """Write the film of frames, remove their folder, and return what was made in words."""
    from ..datamanagers.images import load_image
    from ..io.video import write_video

    codec = write_video(output, (load_image(path) for path in frames), fps)
    shutil.rmtree(frames[0].parent)
    return f"{output} ({codec})"


def _panels(
    scene: "Scene",
    cameras: "Cameras",
    frame: int,
    takes: "list[Take]",
    config: RenderVerbConfig,
    limits: tuple[float, float] | None,
) -> "list[Picture]":
    """Panels of one frame in the order of `config.show`: colour and match maps once for each take, geometry
    once for all.
    """
    from ..io.images import to_uint8
    from ..io.maps import depth_image
    from ..rendering.cameras import normals
    from ..style.match_maps import match_map, match_picture

    # No style moves anything: depth and normals are those of any look that is rendered already.
    if "colour" in config.show:
        views = []
        for take in takes:
            views.append(take.scene(frame).render(cameras, frame))
    else:
        views = []
    geometry = views[0] if views else scene.render(cameras, frame)
    shown: list[Picture] = []
    for channel in config.show:
        if channel == "colour":
            for view in views:
                shown.append(to_uint8(view.rgb))
        elif channel == "depth":
            shown.append(depth_image(geometry.depth, geometry.opacity, limits))
        elif channel == "normals":
            # In camera axes: red to the right, green up, blue towards the viewer; grey where nothing is.
            turned = normals(cameras, frame, geometry.depth).double() @ cameras.pose[frame, :, :3]
            cover = geometry.opacity[..., None].clamp(0, 1).double() * (
                turned.norm(dim=-1, keepdim=True) > 0.5
            )
            shown.append(to_uint8(0.5 + 0.5 * turned * cover))
        else:
            styles = []
            for take in takes:
                if take.styled is not None:
                    styles.append(take.styled)
            for styled in styles:
                shown.append(match_picture(match_map(scene, styled, frame, cameras), styled.codes))
    return shown


def _key(opened: "LoadedRun[Scene]", config: RenderVerbConfig, cameras: "Cameras") -> str:
    """A hash of all that frames depend on: the run's state, the path, every setting, and every file that they
    name.
    """
    digest = hashlib.sha256(f"{opened.run.root.resolve()} {opened.step} {opened.seconds}".encode())
    settings = {}
    for name, value in vars(config).items():
        if name not in ("output", "overwrite", "device", "fps", "run"):
            settings[name] = value
    digest.update(repr(sorted(settings.items())).encode() + (opened.run.root / "config.json").read_bytes())
    for tensor in (
        cameras.pose,
        cameras.focal,
        cameras.centre,
        cameras.size,
        cameras.distortion,
        cameras.lens,
    ):
        digest.update(tensor.numpy().tobytes())
    # Files count by their content: a photograph that has changed under its name makes other frames.
    named = [*config.references, *config.masks, config.style, config.between, config.keyframes]
    if config.keyframes is not None:
        for key in read_keyframes(config.keyframes):
            named.append(key.style)
    for path in [*named, *_named(config)]:
        if path is not None and path.is_file():
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _takes(scene: "Scene", config: RenderVerbConfig, file: "StyleFile") -> "list[Take]":
    """The looks of a film, at least one. Raises UsageError for a match map without a style to match."""
    from ..style.restyle import keyed_looks

    takes = []
    if config.keyframes is not None:
        look = keyed_looks(scene, read_keyframes(config.keyframes))
        # While a look is held it is one scene, which recolours its Gaussians once.
        restyled = functools.lru_cache(maxsize=1)(scene.restyled)
        takes.append(Take("keyframes", lambda frame: restyled(look(frame))))
    elif config.references or config.light_asked:
        takes.append(_styled_take(scene, "style", file))
    for text in config.styles:
        if text == "plain":
            takes.append(Take("plain", lambda frame: scene))
        else:
            ((name, named),) = named_styles([text], file)
            takes.append(_styled_take(scene, name, named))
    takes = takes or [Take("plain", lambda frame: scene)]
    if "match" in config.show and not any(take.styled is not None for take in takes):
        raise UsageError(
            "--show match: needs a style that holds throughout; name one with --references, --style or --styles"
        )
    return takes


def _styled_take(scene: "Scene", name: str, file: "StyleFile") -> "Take":
    from ..style.restyle import apply_style

    styled = apply_style(scene, file)
    restyled = scene.restyled(styled.restyle)
    for note in (*styled.controls.notes, *restyled.light_notes):
        print(note)
    return Take(name, lambda frame: restyled, styled)
