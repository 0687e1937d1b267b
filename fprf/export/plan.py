"""What is exported, and what its files are called. No torch."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ..errors import UsageError
from ..plugins.registry import nearest

__all__ = ["KINDS", "Plan", "look_file", "plan"]

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
