"""Settings of `fprf export`: kinds, resolution, looks (as it is, and each style with its name), names of files. No torch."""

import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ..checks import at_least, between, positive
from ..errors import UsageError
from ..plugins.registry import nearest
from ..style.config import StyleConfig
from ..style.files import StyleFile, check_photographs, read_style, with_folders

if TYPE_CHECKING:
    from ..interfaces import Scene
    from ..style.look import Restyle


@dataclass(frozen=True, kw_only=True)
class ExportConfig(StyleConfig):
    """Kinds of files, their resolution, and the styles."""

    run: Path = Path()
    """Run folder."""
    kinds: tuple[str, ...] = ()
    """Kinds of files; the same as words behind the run. None = everything."""
    output: Path | None = None
    """A folder, or a single file (.ply .splat .glb .json .cube); by default RUN/exports."""
    style: Path | None = None
    """A style file, such as the style.json of `fprf stylize`; flags come over it."""
    styles: tuple[str, ...] = ()
    """Further styles of the same geometry: NAME=PHOTO,PHOTO or NAME=STYLE.json each."""
    views: int = 120
    """Training views that the geometry is taken from, at most; spread evenly."""
    side: int = 400
    """Longest side of their depth maps, in pixels."""
    points: int = 500_000
    """Points, at most."""
    edge: float | None = None
    """Edge of the finest voxel in world units, above 0: one point each; none = the median pixel on the surface."""
    tolerance: float = 0.02
    """Views agree on a point where their depths differ by no more than this share, in (0, 0.5]."""
    agree: int = 2
    """Other views that must see a point, where so many look there."""
    witnesses: int = 6
    """Views that give a point its colour, at most: those that see it best."""
    presence: float = 0.6
    """Share of the light that a surface there would send which must come from a point, in [0, 1]: less, and it floats."""
    reach: float | None = None
    """Distance from a view, in world units, beyond which everything is sky; none = 20 times the scene's inner radius."""
    sky: bool = True
    """Put a dome round splats where views see nothing within reach."""
    fit: float = 0.0
    """Minutes of training splats against the field's own renders, and a third of it again for each style; 0 = flat discs on its
    surfaces, without training. For runs of fields."""
    fit_cap: int = 60_000
    """Splats that are trained, at most."""
    plain: bool = False
    """Trained Gaussians get the opacities that views show, for viewers that do not compensate opacities (Mip-Splatting), most
    among them; others show thin Gaussians too heavily. Not exact: leave it out where fprf reads the file again."""
    local: bool = False
    """Of a capture whose coordinates are too large for float32 (projected metres): write all files relative to the run's
    origin, each with NAME.offset.json beside it, for programs that do not read float64 positions or a node's translation."""
    mesh_edge: float | None = None
    """Edge of the mesh's lattice in world units, above 0; none = twice the finest voxel's."""
    lut_size: int = 33
    """Nodes a side of lookup tables, in [2, 129]; editors take 17, 33 or 65."""
    images: bool = False
    """With cameras: also render every view, in the style if there is one, so that other methods can train on them."""
    device: str = "auto"
    """cpu, cuda, mps, or auto."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least("views", self.views, 2)
        at_least("side", self.side, 8)
        at_least("points", self.points, 1)
        between("tolerance", self.tolerance, 1e-6, 0.5)
        at_least("agree", self.agree, 1)
        at_least("witnesses", self.witnesses, 1)
        between("presence", self.presence, 0.0, 1.0)
        between("lut_size", self.lut_size, 2, 129)
        at_least("fit", self.fit, 0.0)
        at_least("fit_cap", self.fit_cap, 1)
        for name in ("edge", "reach", "mesh_edge"):
            value = getattr(self, name)
            if value is not None:
                positive(name, value)


KINDS = {
    "ply": "coloured points with normals",
    "splat": "3D Gaussians: splats.ply and splats.splat",
    "glb": "mesh.glb and mesh.ply with vertex colours",
    "cameras": "transforms.json of Nerfstudio",
    "lut": "3D lookup tables of each style, for video editors",
}
"""Kinds of export."""
_ALSO = {"points": "ply", "splats": "splat", "gaussians": "splat", "mesh": "glb", "transforms": "cameras", "luts": "lut"}
"""Other words for the kinds."""

_ENDINGS = {".ply": ("ply", "splat", "glb"), ".splat": ("splat",), ".glb": ("glb",), ".json": ("cameras",), ".cube": ("lut",)}
"""Kinds that a single file can hold, by its ending; the first one where none is named."""


class Plan(NamedTuple):
    """Outputs and their files."""

    kinds: tuple[str, ...]
    folder: Path
    single: Path | None
    """The one file that is wanted; None = all files of the kinds, in the folder."""


def plan(kinds: Sequence[str], output: Path) -> Plan:
    """From kinds (none = all; also `points`, `splats`, `mesh`) and an output, which is a file if it ends like one.

    Raises UsageError for what does not fit.
    """
    for kind in kinds:
        if kind not in KINDS and kind not in _ALSO:
            near = nearest(kind, [*KINDS, *_ALSO])
            raise UsageError(f"fprf export: {kind!r} is nothing to export{near} (kinds: {', '.join(KINDS)})")
    kinds = [_ALSO.get(kind, kind) for kind in kinds]
    ending = output.suffix.lower()
    if ending not in _ENDINGS or output.is_dir():
        return Plan(tuple(dict.fromkeys(kinds)) or tuple(KINDS), output, None)
    allowed = _ENDINGS[ending]
    wanted = tuple(dict.fromkeys(kinds)) or allowed[:1]
    if len(wanted) > 1 or wanted[0] not in allowed:
        raise UsageError(
            f"--output {output}: a single {ending} file holds {' or '.join(allowed)}, not {' and '.join(wanted)}; "
            "name a folder, or one kind that fits"
        )
    return Plan(wanted, output.parent, output)


def look_file(base: str, look: str, ending: str) -> str:
    """points.ply for the scene as it is, points.dusk.ply in the look `dusk`."""
    return f"{base}.{look}{ending}" if look else f"{base}{ending}"


_LONGEST = 60
"""Characters of a name, which file names carry."""


class Named(NamedTuple):
    """A style before it is made."""

    name: str
    file: StyleFile


class Look(NamedTuple):
    """The scene as it is (no name, no restyle), or in a style."""

    name: str
    restyle: "Restyle | None"


def style_name(references: Sequence[Path], style: Path | None) -> str:
    """A style file's own name or its folder's, else the stems of the references joined."""
    if style is not None:
        own = style.resolve().parent.name if style.name == "style.json" else style.stem
    else:
        own = "+".join(path.stem for path in references)
    return _tidy(own) or "style"


def named_styles(texts: Sequence[str], base: StyleFile, report: Callable[[str], None] = warnings.warn) -> list[Named]:
    """Styles from NAME=STYLE.json or NAME=PHOTO[,PHOTO ...]; photographs go with the other settings of `base`.

    Folders stand for the images in them, and `report` is told which of these cannot be read. Raises UsageError for another
    form or a name that comes twice, and what reading a style file raises.
    """
    styles = []
    for text in texts:
        name, equals, what = text.partition("=")
        if not (equals and name and what) or name != _tidy(name):
            raise UsageError(
                f"--styles {text}: write NAME=PHOTO,PHOTO or NAME=STYLE.json, with a name of letters, digits, + - and _"
            )
        if what.lower().endswith(".json"):
            file = read_style(Path(what))
            check_photographs(Path(what), file)
        else:
            file = StyleFile(with_folders(_with(base.style, tuple(Path(part) for part in what.split(","))), report))
        styles.append(Named(name, file))
    return styles


def styles_of(config: ExportConfig, base: StyleFile, report: Callable[[str], None] = warnings.warn) -> list[Named]:
    """The styles that an export names: that of its photographs or style file first. Raises as `named_styles`."""
    styles = named_styles(config.styles, base, report)
    if config.references:
        styles.insert(0, Named(style_name(config.references, config.style), base))
    return styles


def make_looks(scene: "Scene", styles: Sequence[Named]) -> list[Look]:
    """The scene as it is, and each style. Raises UsageError for two of one name, and what `apply_style` raises."""
    from ..style.restyle import apply_style

    names = [style.name for style in styles]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"--styles {name}: two styles of this name; give each its own")
    encoders = scene.encoders() if styles else None
    return [Look("", None), *(Look(s.name, apply_style(scene, s.file, encoders).restyle) for s in styles)]


def _with(style: StyleConfig, references: tuple[Path, ...]) -> StyleConfig:
    """Other photographs under the same settings; what names photographs one by one does not carry over."""
    from dataclasses import replace

    return replace(style, references=references, weights=(), masks=(), pin=(), forbid=())


def _tidy(name: str) -> str:
    return re.sub(r"[^\w+-]+", "_", name, flags=re.ASCII).strip("_")[:_LONGEST]
