"""Settings of `fprf export`, and which files they mean. No torch."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from ..checks import at_least, positive
from ..errors import UsageError
from ..io.overwriting import OverwriteConfig
from ..plugins.captures import endings, format_name
from ..plugins.registry import nearest
from ..style.config import StyleConfig


@dataclass(frozen=True, kw_only=True)
class ExportConfig(StyleConfig, OverwriteConfig):
    """Kinds of files, their resolution, and the styles."""

    run: Path = Path()
    """Run folder."""
    kinds: tuple[str, ...] = ()
    """Kinds of files; none named = ply splat glb cameras."""
    output: Path | None = None
    """A folder, or a single file, whose ending says the kind; by default RUN/exports."""
    style: Path | None = None
    """A style file, such as the style.json of `fprf stylize`; flags come over it."""
    styles: tuple[str, ...] = ()
    """Further styles of the same geometry: NAME=PHOTO,PHOTO or NAME=STYLE.json each."""
    views: int = 120
    """Training views that are rendered for a mesh, or to fit Gaussians to, at most; spread evenly."""
    side: int = 400
    """Longest side in pixels of the renders that a mesh is made of."""
    reach: float | None = None
    """Distance from a view, in world units, beyond which everything is sky; none = 20 times the scene's inner
    radius.
    """
    fit: float | None = None
    """Minutes of fitting Gaussians to the scene's own renders, and a third of it again for each style; none =
    4. For scenes that are not made of Gaussians.
    """
    fit_cap: int = 60_000
    """Gaussians that are fitted, at most."""
    plain: bool = False
    """Gaussians get the opacities that views show, for viewers that do not compensate opacities
    (Mip-Splatting), most among them; others show thin Gaussians too heavily. Not exact: leave it out where
    fprf reads the file again.
    """
    local: bool = False
    """Of a capture whose coordinates are too large for float32 (projected metres): write all files relative
    to the run's origin, each with NAME.offset.json beside it, for programs that do not read float64 positions
    or a node's translation.
    """
    mesh_edge: float | None = None
    """Edge of the mesh's lattice in world units, above 0; none = twice the median pixel's on the surface."""
    images: bool = False
    """With cameras: also render every view, in the style if there is one, so that other methods can train on
    them.
    """
    device: str = "auto"
    """cpu, cuda, mps, or auto."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least("views", self.views, 2)
        at_least("side", self.side, 8)
        at_least("fit_cap", self.fit_cap, 1)
        for name in ("fit", "reach", "mesh_edge"):
            if getattr(self, name) is not None:
                positive(name, getattr(self, name))


KINDS = {
    "glb": "mesh.glb and mesh.ply with vertex colours",
    "cameras": "transforms.json of Nerfstudio",
}
"""Kinds of files but those of Gaussians, which are the formats installed. `glb` means the mesh, `gltf`
Gaussians.
"""
FIT_MINUTES = 4.0
"""Minutes of fitting Gaussians unless the user says otherwise: twice as many change little. By eye."""
_USUAL_KINDS = ("ply", "splat", "glb", "cameras")
"""Kinds that are written where none is named."""
_KINDS_BY_ENDING = {".glb": "glb", ".json": "cameras"}
"""Kinds of single files but those of Gaussians."""


class Plan(NamedTuple):
    """Outputs and their files."""

    kinds: tuple[str, ...]
    folder: Path
    single: Path | None
    """The one file that is wanted; None = all files of the kinds, in the folder."""

    @property
    def formats(self) -> tuple[str, ...]:
        """The formats of Gaussian files among the kinds."""
        return tuple(kind for kind in self.kinds if kind not in KINDS)

    def paths(self, base: str, look: str, *suffixes: str) -> list[Path]:
        """Name the files of a look: mesh.ply for the scene as it is, mesh.dusk.ply in the look `dusk`; or the
        single one.
        """
        if self.single is not None:
            return [self.single]
        found: list[Path] = []
        for suffix in suffixes:
            found.append(self.folder / f"{base}{f'.{look}' if look else ''}{suffix}")
        return found


def plan(kinds: Sequence[str], output: Path) -> Plan:
    """Plan the files of kinds (none = the usual ones); the output is a file if it ends like one.

    Raises UsageError for what does not fit.
    """
    formats = []
    for ending in endings():
        if ending[1:] not in KINDS:
            formats.append(ending[1:])
    known = [*formats, *KINDS]
    for kind in kinds:
        if kind not in known:
            raise UsageError(
                f"fprf export: {kind!r} is nothing to export{nearest(kind, known)} (kinds: {', '.join(known)})"
            )
    wanted = [*dict.fromkeys(kinds)]
    kind_of_file = format_name(output) or _KINDS_BY_ENDING.get(output.suffix.lower())
    if kind_of_file is None or output.is_dir():
        return Plan(tuple(wanted) or _USUAL_KINDS, output, None)
    # A .ply holds Gaussians or a mesh.
    if kind_of_file == "ply":
        allowed = [kind_of_file, "glb"]
    else:
        allowed = [kind_of_file]
    if len(wanted) > 1 or (wanted and wanted[0] not in allowed):
        raise UsageError(
            f"--output {output}: a single file of this ending holds {' or '.join(allowed)}, not {' and '.join(wanted)}; "
            "name a folder, or one kind that fits"
        )
    return Plan((wanted[0] if wanted else kind_of_file,), output.parent, output)
