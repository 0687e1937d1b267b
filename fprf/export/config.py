"""What to export, how finely, in which styles, and the names of the files. No torch."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from ..checks import at_least, between, positive
from ..errors import UsageError
from ..plugins.registry import nearest
from ..style.config import StyleConfig

__all__ = ["KINDS", "ExportConfig", "Plan", "look_file", "plan"]


@dataclass(frozen=True, kw_only=True)
class ExportConfig(StyleConfig):
    """What to export, how finely, and in which styles."""

    run: Path = Path()
    """Run folder."""
    kinds: tuple[str, ...] = ()
    """What to export; the same as words behind the run. None = everything."""
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
    """What is farther from its view, in world units, is sky; none = 20 times the scene's inner radius."""
    sky: bool = True
    """Put a dome round splats where views see nothing within reach."""
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
"""What can be exported."""
_ALSO = {"points": "ply", "splats": "splat", "gaussians": "splat", "mesh": "glb", "transforms": "cameras", "luts": "lut"}
"""Other words for the kinds."""

_ENDINGS = {".ply": ("ply", "splat", "glb"), ".splat": ("splat",), ".glb": ("glb",), ".json": ("cameras",), ".cube": ("lut",)}
"""Kinds that a single file can hold, by its ending; the first one where none is named."""


class Plan(NamedTuple):
    """What is to be written where."""

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
