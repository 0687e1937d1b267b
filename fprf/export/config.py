"""What to export, how finely, and in which styles."""

from dataclasses import dataclass
from pathlib import Path

from ..checks import at_least, between, positive
from ..style.config import StyleConfig

__all__ = ["ExportConfig"]


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
