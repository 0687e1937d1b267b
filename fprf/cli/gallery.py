"""`fprf gallery RUN --references DIR`: a run in every style, as one page that needs nothing else."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ..checks import at_least, positive
from ..errors import UsageError
from ..plugins.stylizers.config import StylizerConfig
from ..progress import Display
from ..style.config import StyleConfig
from ..style.files import StyleFile, check_photographs, read_style
from ..training.quality import QualityConfig
from .parsing import parse
from .showcase import frames_of, photographs_of, restyled, write_shown
from .style_flags import read_preset, say, with_presets_named

if TYPE_CHECKING:
    from ..training.run import Known

_DESCRIPTION = """A run in every style, as one page to walk through, with match maps, depth and figures. It loads nothing.

Each reference is a style of its own; with several of them all together are one more."""


@dataclass(frozen=True, kw_only=True)
class GalleryConfig(QualityConfig):
    """Views and styles of the page."""

    run: Path = Path()
    """Run folder."""
    references: tuple[Path, ...] = ()
    """Photographs, or folders of them."""
    styles: tuple[Path, ...] = ()
    """Style files (style.json), each one more style."""
    together: bool = True
    """Also show all photographs as one style."""
    strength: float = 1.0
    """0 leaves the scene as it is, 1 is the full style; of photographs."""
    luminance: float = 0.0
    """Share of the scene's own luminance that is kept, in [0, 1]; of photographs."""
    clusters: int = StyleConfig().clusters
    """Local styles per photograph, at least 1."""
    blend: float = StyleConfig().blend
    """Share of the overall style in each local one, in [0, 1]; of photographs."""
    stylizer: StylizerConfig = StyleConfig().stylizer
    """Method that moves the scene's features; of photographs."""
    split: Literal["covered", "test", "train", "all"] = "covered"
    """Views to choose from. covered: at most 8, those that training views surround; test: those held out from training."""
    most: int = 6
    """Views that are shown, evenly taken from the split."""
    views: tuple[str, ...] = ()
    """Views to show by name, instead."""
    frames: int = 0
    """Frames of a flight through the last style; 0 = none."""
    path: str = "interpolate"
    """Path of the flight: spiral, orbit, interpolate, or a camera-path file."""
    title: str = ""
    """Headline; empty = the scene's name."""
    megabytes: float = 16.0
    """Size of the page, at most; Gaussians that show least are left out of it."""
    output: Path | None = None
    """The page; by default RUN/gallery.html."""
    device: str = "auto"
    """cpu, cuda, mps, or auto."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.style_of()
        at_least("most", self.most, 1)
        at_least("frames", self.frames, 0)
        positive("megabytes", self.megabytes)

    def style_of(self, *references: Path) -> StyleFile:
        """The style of some photographs. Raises ConfigError for a value out of its range."""
        return StyleFile(
            StyleConfig(
                references=references,
                strength=self.strength,
                luminance=self.luminance,
                clusters=self.clusters,
                blend=self.blend,
                stylizer=self.stylizer,
            )
        )


def run(args: list[str]) -> int:
    """Render the views in every style, film, write the page."""
    default, args = read_preset(GalleryConfig(), args)
    config = parse(default, args, prog="fprf gallery", description=with_presets_named(_DESCRIPTION), positional=("run",))
    output = config.output if config.output is not None else config.run / "gallery.html"
    if output.suffix.lower() != ".html":
        raise UsageError(f"--output {output}: the page is an .html file; give such a name")
    from ..datamanagers.images import photographs as find_photographs
    from ..io.video import write_video
    from ..rendering.paths import make_path
    from ..training.loading import open_run

    photographs = find_photographs(config.references, say)
    opened = open_run(config.run, config.device, config)
    views, known, scene = _views(opened.known, config), opened.known, opened.scene
    chosen = _chosen(config, photographs)
    film = None
    with Display() as display:
        originals = []
        for i, view in enumerate(views):
            display.count(i, len(views), "rendering")
            originals.append(scene.render(scene.cameras, view))
        shown = restyled(scene, chosen, views, display)
        if config.frames:
            film = output.with_suffix(".mp4")
            flight = make_path(known.cameras, known.split("all"), config.path, config.frames, scene.origin)
            write_video(film, frames_of(scene, flight, lambda _: shown[-1].styled.restyle, display), fps=24)
    width, height = known.cameras.size[views[0]].tolist()
    write_shown(
        output,
        scene,
        title=config.title or known.name,
        facts={
            "Photographs": len(known.names),
            "Size": f"{width} × {height}",
            "Method": opened.method,
            "Styles": len(shown),
            "Trained for": f"{opened.seconds / 60:.1f} min",
        },
        views=views,
        originals=originals,
        photographs=photographs_of(opened.run, known, [view for view in views if view in known.test]),
        shown=shown,
        references=_named(photographs, [path for each in shown for path in each.sources]),
        metrics=_metrics(config.run),
        film=film,
        megabytes=config.megabytes,
    )
    print(f"{len(views)} views in {len(shown)} styles: {output} ({output.stat().st_size / 2**20:.1f} MiB)")
    return 0


def _chosen(config: GalleryConfig, photographs: list[Path]) -> list[tuple[str, StyleFile]]:
    """The styles with their names. Raises UsageError where there are none."""
    chosen = [(name, config.style_of(path)) for name, path in _named(photographs, ()).items()]
    for path in config.styles:
        file = read_style(path)
        check_photographs(path, file)
        own = path.resolve().parent.name if path.name == "style.json" else path.stem
        taken = {name for name, _ in chosen}
        chosen.append((own if own not in taken else f"{own} ({len(chosen) + 1})", file))
    if config.together and len(photographs) > 1:
        names = list(_named(photographs, ()))
        chosen.append((" + ".join(names) if len(names) <= 3 else f"all {len(names)}", config.style_of(*photographs)))
    if not chosen:
        raise UsageError("fprf gallery: name photographs with --references, or style files with --styles")
    return chosen


def _named(first: Sequence[Path], more: Sequence[Path]) -> dict[str, Path]:
    """Photographs by their stems; where two agree, by their whole names, with a number where these agree as well."""
    paths = list(dict.fromkeys([*first, *more]))
    named: dict[str, Path] = {}
    for path in paths:
        alike = sum(other.stem == path.stem for other in paths) > 1
        name = path.name if alike else path.stem
        named[name if name not in named else f"{name} ({len(named) + 1})"] = path
    return named


def _views(known: "Known", config: GalleryConfig) -> list[int]:
    """The views to show. Raises UsageError for a name that the run does not hold, or an empty split."""
    views = known.views(config.split, config.views)
    count = len(views) if config.views else min(config.most, len(views))
    return [views[k * len(views) // count] for k in range(count)]


def _metrics(run: Path) -> dict[str, Any]:
    """Metrics of `fprf eval` without the single views; empty where it has not run."""
    from ..plugins.codec import read_json

    path = run / "metrics.json"
    if not path.is_file():
        return {}
    content = read_json(path, "the metrics.json of `fprf eval`")
    told = content if isinstance(content, dict) else {}
    return {name: value for name, value in told.items() if name not in ("per_view", "method", "scene")}
