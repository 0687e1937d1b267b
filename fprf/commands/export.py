"""`fprf export RUN [ply splat cameras ...]`: a scene, plain or restyled, as files that other programs open."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ..checks import at_least, between, positive
from ..errors import UsageError
from ..export.looks import Look, Named, make_looks, named_styles, style_name
from ..export.plan import KINDS, Plan, look_file, plan
from ..style.config import StyleConfig
from .progress import Display
from .style_flags import read_flags

if TYPE_CHECKING:
    from torch import Tensor

    from ..engine.loading import Trained
    from ..export.fusion import Cloud
    from ..export.sights import Sights

__all__ = ["ExportConfig", "run"]

_DESCRIPTION = f"""A scene as files that other programs open, in the capture's own frame.

Kinds may follow the run, none = all of them: {", ".join(f"{name} = {what}" for name, what in KINDS.items())}. A look
of the scene is a file: points.ply as it is, points.NAME.ply in a style, with the same points in the same order."""


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
        between("lut_size", self.lut_size, 2, 129)
        for name in ("edge", "reach", "mesh_edge"):
            value = getattr(self, name)
            if value is not None:
                positive(name, value)


def run(args: list[str]) -> int:
    """Render depths, fuse them, colour the points in every look, write the files."""
    config, file = read_flags(
        ExportConfig(), _kinds_as_flag(args), prog="fprf export", description=_DESCRIPTION, positional=("run",)
    )
    what = plan(config.kinds, config.output or config.run / "exports")
    styles = named_styles(config.styles, file)
    if config.references:
        styles.insert(0, Named(style_name(config.references, config.style), file))
    if config.kinds and "lut" in what.kinds and not styles:
        raise UsageError("fprf export: a lut is the way into a style; name one with --references, --style or --styles")
    if what.single is not None and len(styles) > 1:
        raise UsageError(f"--output {what.single}: one file holds one style, {len(styles)} are asked for; name a folder")
    from ..engine.loading import load_run
    from ..output.atomic import write_json

    start = time.perf_counter()
    trained = load_run(config.run, config.device)
    looks = make_looks(trained, styles)
    if what.single is not None:
        looks = looks[-1:]
    made: dict[str, Any] = {"run": trained.known.name, "step": trained.step, "styles": [s.name for s in styles]}
    with Display() as display:
        made |= _geometry(trained, config, what, looks, display)
        if "cameras" in what.kinds:
            made |= _cameras(trained, config, what, looks, display)
        if "lut" in what.kinds and styles:
            made |= _tables(trained, config, what, looks)
    made["seconds"] = time.perf_counter() - start
    if what.single is None:
        write_json(what.folder / "export.json", made)
    print(f"{', '.join(what.kinds)} in {what.single or what.folder}  ({made['seconds']:.1f} s)")
    return 0


class _Place(NamedTuple):
    """What every file of surfaces needs."""

    trained: "Trained"
    what: Plan
    looks: Sequence[Look]
    sights: "Sights"
    origin: "Tensor"
    display: Display

    def paths(self, base: str, look: Look, ending: str) -> list[Path]:
        """Where the file of a look goes; nowhere if a single file of another ending is wanted."""
        if self.what.single is None:
            return [self.what.folder / look_file(base, look.name, ending)]
        return [self.what.single] if self.what.single.suffix.lower() == ending else []

    def colours(self, point: "Tensor", view: "Tensor") -> "Iterator[tuple[Look, Tensor]]":
        """Each look with the colours of points that views of the sights see."""
        from ..export.colours import seen_colours

        found = seen_colours(
            self.trained.model,
            self.trained.known.facts,
            self.sights.cameras,
            point,
            view,
            self.trained.config.render,
            [look.restyle for look in self.looks],
            lambda done, total: self.display.count(done, total, "colouring"),
        )
        return zip(self.looks, found, strict=True)


def _geometry(trained: "Trained", config: ExportConfig, what: Plan, looks: Sequence[Look], display: Display) -> dict[str, Any]:
    """Everything that is made of surfaces."""
    if not {"ply", "splat", "glb"} & set(what.kinds):
        return {}
    from ..export.fusion import fuse
    from ..export.points import origin_of

    sights = _sights(trained, config, display)
    cloud = fuse(
        sights,
        edge=config.edge,
        most=config.points,
        tolerance=config.tolerance,
        agree=config.agree,
        report=lambda done, total: display.count(done, total, "fusing"),
    )
    place = _Place(trained, what, looks, sights, origin_of(cloud), display)
    made = {"origin": place.origin.tolist(), "views": len(sights.depth), "finest_edge": float(cloud.edge.amin())}
    if {"ply", "splat"} & set(what.kinds):
        made |= _points(place, cloud, sky=config.sky)
    if "glb" in what.kinds:
        made |= _mesh(place, cloud, config.mesh_edge)
    return made


def _sights(trained: "Trained", config: ExportConfig, display: Display) -> "Sights":
    from ..export.depths import chosen, reach_of, render_sights

    known = trained.known
    return render_sights(
        trained.model,
        known.cameras,
        chosen(known.train, config.views),
        trained.config.render,
        side=config.side,
        reach=reach_of(trained.model.space) if config.reach is None else config.reach,
        report=lambda done, total: display.count(done, total, "rendering depth"),
    )


def _points(place: _Place, cloud: "Cloud", *, sky: bool) -> dict[str, Any]:
    """Points and splats: one geometry, a colour set for each look."""
    from ..export.fusion import joined
    from ..export.points import write_points
    from ..export.sky import dome
    from ..export.splats import discs, write_gaussians, write_splat

    kinds = place.what.kinds
    above = dome(place.sights, cloud) if sky and "splat" in kinds else None
    whole = cloud if above is None else joined(cloud, above)
    count, splats = len(cloud.point), discs(whole)
    for look, colour in place.colours(whole.point, whole.view):
        if "ply" in kinds:
            for path in place.paths("points", look, ".ply"):
                write_points(path, cloud, colour[:count], place.origin)
        if "splat" in kinds:
            for path in place.paths("splats", look, ".ply"):
                write_gaussians(path, splats, colour, place.origin)
            for path in place.paths("splats", look, ".splat"):
                write_splat(path, splats, colour, place.origin)
    return {"points": count, "splats": len(whole.point)}


def _mesh(place: _Place, cloud: "Cloud", edge: float | None) -> dict[str, Any]:
    """The mesh in both formats, a file for each look."""
    from ..export.mesh import build_mesh, write_mesh_glb, write_mesh_ply

    mesh = build_mesh(
        place.sights, cloud, edge=edge, report=lambda done, total: place.display.count(done, total, "building the mesh")
    )
    for look, colour in place.colours(mesh.point, mesh.view):
        for path in place.paths("mesh", look, ".ply"):
            write_mesh_ply(path, mesh, colour, place.origin)
        for path in place.paths("mesh", look, ".glb"):
            write_mesh_glb(path, mesh, colour, place.origin)
    return {"vertices": len(mesh.point), "triangles": len(mesh.face), "mesh_edge": mesh.edge}


def _cameras(trained: "Trained", config: ExportConfig, what: Plan, looks: Sequence[Look], display: Display) -> dict[str, Any]:
    """transforms.json, and the pictures that it names if they are wanted."""
    from ..engine.views import render_view
    from ..export.transforms import transforms
    from ..output.atomic import write_json
    from ..output.images import to_uint8, write_image

    known, folder = trained.known, what.folder
    files = [f"images/{name}.png" for name in known.names]
    if config.images:
        for view, file in enumerate(files):
            display.count(view, len(files), "rendering views")
            picture = render_view(trained.model, known.facts, known.cameras, view, trained.config.render, looks[-1].restyle)
            write_image(folder / file, to_uint8(picture.rgb))
        display.count(len(files), len(files), "rendering views")
    cloud = look_file("points", looks[-1].name, ".ply") if "ply" in what.kinds and what.single is None else None
    document = transforms(known.cameras, files, train=known.train, test=known.test, cloud=cloud)
    write_json(what.single or folder / "transforms.json", document)
    return {"cameras": len(files)}


def _tables(trained: "Trained", config: ExportConfig, what: Plan, looks: Sequence[Look]) -> dict[str, Any]:
    """Lookup tables of every style, for the whole scene and each region."""
    from ..engine.loading import load_style
    from ..export.lut import fit_quality, look_pairs, write_cube

    known, scene = trained.known, load_style(trained.run)[0]
    styled = [(look.name, look.restyle) for look in looks if look.restyle is not None]
    pairs = look_pairs(
        trained.model, scene, known.cameras, known.train, trained.config.render, [restyle for _, restyle in styled]
    )
    made: dict[str, Any] = {}
    for number, (name, _) in enumerate(styled):
        weights = {"all": pairs.share.sum(1)}
        if what.single is None and pairs.share.shape[1] > 1:
            weights |= {f"region{k}": pairs.share[:, k] for k in range(pairs.share.shape[1])}
        for region, weight in weights.items():
            table, made[f"{name}/{region}"] = fit_quality(pairs, number, weight, config.lut_size)
            write_cube(what.single or what.folder / "luts" / name / f"{region}.cube", table, f"{name} {region}")
    return {"luts": made}


def _kinds_as_flag(args: list[str]) -> list[str]:
    """Words behind the run name kinds: RUN ply splat ... is RUN --kinds ply splat ..."""
    end = 1
    while end < len(args) and not args[end].startswith("-"):
        end += 1
    if end == 1 or args[0].startswith("-"):
        return args
    return [args[0], "--kinds", *args[1:end], *args[end:]]
