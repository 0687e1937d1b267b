"""`fprf export RUN [ply splat cameras ...]`: a scene, plain or restyled, as files that other programs open."""

import hashlib
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ..errors import DataError, UsageError
from ..export.config import KINDS, ExportConfig, Look, Plan, look_file, make_looks, plan, styles_of
from ..progress import Display
from .style_flags import read_flags, say

if TYPE_CHECKING:
    from torch import Tensor

    from ..export.colours import BestViews, Coloured
    from ..export.depth_maps import DepthMaps
    from ..export.point_cloud import Cloud
    from ..interfaces import Scene
    from ..splats.initial import Points
    from ..style.files import StyleFile
    from ..training.loading import Trained
    from ..training.run import Known

_OF_GAUSSIANS = ("ply", "splat", "cameras")
"""Kinds that there are of Gaussians; the last one not unless it is asked for."""
_FEW = 0.5
"""A smaller share of what there was is worth a warning."""

_DESCRIPTION = f"""A scene as files that other programs open, in the capture's own frame.

Kinds may follow the run; several share one geometry, none = all of them:
{", ".join(f"{name} = {what}" for name, what in KINDS.items())}. A look of the scene is a file:
points.ply as it is, points.NAME.ply in a style, with the same points in the same order."""


def run(args: list[str]) -> int:
    """Render depths, fuse them, colour the points in every look, write the files."""
    config, file = read_flags(
        ExportConfig(), _kinds_as_flag(args), prog="fprf export", description=_DESCRIPTION, positional=("run",)
    )
    from ..training.run import Run

    kind = Run(config.run).load_config()[0].kind
    {"fields": export_fields, "gaussians": export_gaussians}.get(kind, _export_other)(config, file)
    return 0


def _export_other(config: ExportConfig, file: "StyleFile") -> None:
    """Write the cameras and pictures of a run of a kind that is neither of fields nor of Gaussians."""
    what = plan(config.kinds or ("cameras",), config.output or config.run / "exports")
    if what.kinds != ("cameras",):
        raise UsageError(f"fprf export: of this run there are cameras, not {', '.join(what.kinds)}")
    from ..training.loading import open_run

    opened = open_run(config.run, config.device)
    with Display() as display:
        export_cameras(
            opened.scene, opened.known, config, what, make_looks(opened.scene, styles_of(config, file, say)), display
        )
    print(f"cameras in {what.single or what.folder / 'transforms.json'}")


def export_fields(config: ExportConfig, file: "StyleFile") -> None:
    """Write a run of fields."""
    what = plan(config.kinds, config.output or config.run / "exports")
    styles = styles_of(config, file, say)
    if config.kinds and "lut" in what.kinds and not styles:
        raise UsageError("fprf export: a lut is the way into a style; name one with --references, --style or --styles")
    if what.single is not None and len(styles) > 1:
        raise UsageError(f"--output {what.single}: one file holds one style, {len(styles)} are asked for; name a folder")
    from ..io.atomic import write_json
    from ..training.loading import load_run

    start = time.perf_counter()
    trained = load_run(config.run, config.device)
    looks = make_looks(trained, styles)
    if what.single is not None:
        looks = looks[-1:]
    made: dict[str, Any] = {"run": trained.known.name, "step": trained.step, "styles": [s.name for s in styles]}
    with Display() as display:
        made |= _geometry(trained, config, what, looks, display)
        if "cameras" in what.kinds:
            made |= export_cameras(trained, trained.known, config, what, looks, display)
        if "lut" in what.kinds and styles:
            made |= _tables(trained, config, what, looks)
    made["seconds"] = time.perf_counter() - start
    if what.single is None:
        write_json(what.folder / "export.json", made)
    for line in _coverage(made):
        print(line)
    print(f"{', '.join(what.kinds)} in {what.single or what.folder}  ({made['seconds']:.1f} s)")


def _coverage(made: dict[str, Any]) -> list[str]:
    """Lines on how much of the scene the files hold, with what to do where that is little."""
    lines: list[tuple[str, float, str]] = []
    if "pixels" in made:
        every, seen, agreed = (made["pixels"][name] for name in ("all", "seen", "agreed"))
        text = f"depth maps of {made['views']} views: {seen / every:.0%} of the pixels see a surface within reach"
        lines.append((f"{text}, other views agree on {agreed / seen:.0%} of these", agreed / seen, "raise --tolerance"))
    if "points" in made:
        kept, total = made["points"], made["points"] + made["floating"]
        text = f"points: {kept} of {total} ({kept / total:.0%}) kept"
        lines.append((f"{text}, {made['floating']} float where the field has no surface", kept / total, "lower --presence"))
    if "vertices" in made:
        lines.append((f"mesh: {made['vertices']} vertices, {made['triangles']} triangles", 1.0, ""))
    return [text if share >= _FEW else f"warning: {text}: train longer, or {remedy}" for text, share, remedy in lines]


class _Place(NamedTuple):
    """Inputs of every file of surfaces."""

    trained: "Trained"
    config: ExportConfig
    what: Plan
    looks: Sequence[Look]
    maps: "DepthMaps"
    display: Display

    def paths(self, base: str, look: Look, ending: str) -> list[Path]:
        """The path of a look's file; none if a single file of another ending is wanted."""
        if self.what.single is None:
            return [self.what.folder / look_file(base, look.name, ending)]
        return [self.what.single] if self.what.single.suffix.lower() == ending else []

    def colours(self, point: "Tensor", seen: "BestViews", tolerance: float | None) -> "Coloured":
        """Every look's colours of points that views of the maps see."""
        from ..export.colours import point_colours

        return point_colours(
            self.trained.model,
            self.trained.known.facts,
            self.maps.cameras,
            point,
            seen,
            self.trained.config.render,
            [look.restyle for look in self.looks],
            tolerance=tolerance,
            report=partial(self.display.count, what="colouring"),
        )


def _geometry(trained: "Trained", config: ExportConfig, what: Plan, looks: Sequence[Look], display: Display) -> dict[str, Any]:
    """Everything that is made of surfaces."""
    if not {"ply", "splat", "glb"} & set(what.kinds):
        return {}
    from ..export.depth_maps import default_reach, render_depth_maps, spread_views
    from ..export.point_cloud import fuse

    maps = render_depth_maps(
        trained.model,
        trained.known.cameras,
        spread_views(trained.known.train, config.views),
        trained.config.render,
        side=config.side,
        reach=default_reach(trained.model.space) if config.reach is None else config.reach,
        report=partial(display.count, what="rendering depth"),
    )
    counts: dict[str, int] = {}
    cloud = fuse(
        maps,
        edge=config.edge,
        most=config.points,
        tolerance=config.tolerance,
        agree=config.agree,
        report=partial(display.count, what="fusing"),
        counts=counts,
    )
    place = _Place(trained, config, what, looks, maps, display)
    made: dict[str, Any] = {
        "origin": list(trained.origin),
        "views": len(maps.depth),
        "pixels": {"all": sum(depth.numel() for depth in maps.depth), **counts},
        "finest_edge": float(cloud.edge.amin()),
    }
    if {"ply", "splat"} & set(what.kinds):
        made |= _points(place, cloud)
    if "glb" in what.kinds:
        made |= _mesh(place, cloud)
    return made


def _points(place: _Place, cloud: "Cloud") -> dict[str, Any]:
    """Points and splats: one geometry, a colour set for each look."""
    import torch

    from ..export.colours import best_views, expected_presence, single_view
    from ..export.point_cloud import Cloud, concatenate, sky_dome, write_points
    from ..export.splats import surface_discs, write_gaussians, write_splat
    from ..splats.initial import Points

    config, kinds, origin = place.config, place.what.kinds, place.trained.origin
    seen = best_views(place.maps, cloud.point, cloud.normal, cloud.edge, config.witnesses)
    stored = place.colours(cloud.point, seen, config.tolerance)
    solid = stored.presence >= config.presence * expected_presence(place.maps, cloud.point, seen, config.tolerance)
    if not bool(solid.any()):
        raise DataError(f"export: no point is as present as {config.presence:g} in the field; lower --presence")
    cloud, colours = Cloud(*(column[solid] for column in cloud)), [colour[solid] for colour in stored.colours]
    above = sky_dome(place.maps, cloud) if config.sky and "splat" in kinds else None
    whole = cloud if above is None else concatenate(cloud, above)
    beyond = None if above is None else place.colours(above.point, single_view(above.view), None).colours
    splats = surface_discs(whole)
    made = {"points": len(cloud.point), "floating": int((~solid).sum()), "splats": len(whole.point)}
    if "splat" in kinds and config.fit > 0:
        first = colours[0] if beyond is None else torch.cat([colours[0], beyond[0]])
        made["splats"] = _fitted(place, Points(whole.point.numpy(), first.float().numpy()))
    for number, look in enumerate(place.looks):
        colour = colours[number]
        every = colour if beyond is None else torch.cat([colour, beyond[number]])
        if "ply" in kinds:
            for path in place.paths("points", look, ".ply"):
                write_points(path, cloud, colour, origin, local=config.local)
        if "splat" in kinds and config.fit == 0:
            for path in place.paths("splats", look, ".ply"):
                write_gaussians(path, splats, every, origin, local=config.local)
            for path in place.paths("splats", look, ".splat"):
                write_splat(path, splats, every, origin)
    return made


def _fitted(place: _Place, points: "Points") -> int:
    """Write splats that are trained against the field's renders; the number of them."""
    import torch

    from ..export.depth_maps import spread_views
    from ..export.fit import fit_gaussians
    from ..splats.files import write_gaussians

    config = place.config
    views = spread_views(place.trained.known.train, config.views)
    cameras = place.trained.known.cameras.select(torch.tensor(views))
    looks = [look.restyle for look in place.looks]
    fitted = fit_gaussians(
        place.trained, points, views, looks,
        minutes=config.fit, cap=config.fit_cap, report=place.display.count,
    )  # fmt: skip
    count = 0
    for look, gaussians in zip(place.looks, fitted, strict=True):
        for ending in (".ply", ".splat"):
            for path in place.paths("splats", look, ending):
                write_gaussians(
                    path,
                    gaussians,
                    antialiased=True,
                    views=cameras,
                    plain=config.plain,
                    origin=place.trained.origin,
                    local=config.local,
                )
        count = len(gaussians)
    return count


def _mesh(place: _Place, cloud: "Cloud") -> dict[str, Any]:
    """The mesh in both formats, a file for each look."""
    from ..export.colours import best_views
    from ..export.mesh import build_mesh, write_mesh_glb, write_mesh_ply

    config = place.config
    mesh = build_mesh(place.maps, cloud, edge=config.mesh_edge, report=partial(place.display.count, what="building the mesh"))
    seen = best_views(place.maps, mesh.point, mesh.normal, mesh.edge, config.witnesses)
    for look, colour in zip(place.looks, place.colours(mesh.point, seen, config.tolerance).colours, strict=True):
        for path in place.paths("mesh", look, ".ply"):
            write_mesh_ply(path, mesh, colour, place.trained.origin, local=config.local)
        for path in place.paths("mesh", look, ".glb"):
            write_mesh_glb(path, mesh, colour, place.trained.origin, local=config.local)
    return {"vertices": len(mesh.point), "triangles": len(mesh.face), "mesh_edge": mesh.edge}


def export_cameras(
    scene: "Scene", known: "Known", config: ExportConfig, what: Plan, looks: Sequence[Look], display: Display
) -> dict[str, Any]:
    """Write transforms.json, and the pictures that it names if they are wanted."""
    from ..export.transforms import transforms
    from ..io.atomic import write_json
    from ..io.images import to_uint8, write_image
    from ..rendering.local_frame import added_and_beside, write_offset

    folder, shown = what.folder, scene.restyled(looks[-1].restyle)
    files = [f"images/{name}.png" for name in known.names]
    if config.images:
        for view, file in enumerate(files):
            display.count(view, len(files), "rendering views")
            write_image(folder / file, to_uint8(shown.render(known.cameras, view).rgb))
        display.count(len(files), len(files), "rendering views")
    cloud = look_file("points", looks[-1].name, ".ply") if "ply" in what.kinds and what.single is None else None
    added, beside = added_and_beside(scene.origin, config.local)
    path = what.single or folder / "transforms.json"
    write_json(path, transforms(known.cameras.shifted(added), files, train=known.train, test=known.test, cloud=cloud))
    write_offset(path, beside)
    return {"cameras": len(files)}


def _tables(trained: "Trained", config: ExportConfig, what: Plan, looks: Sequence[Look]) -> dict[str, Any]:
    """Lookup tables of every style, for the whole scene and each region."""
    from ..export.lut import colour_pairs, fit_quality, write_cube
    from ..training.loading import load_style

    known, scene = trained.known, load_style(trained.run)[0]
    styled = [(look.name, look.restyle) for look in looks if look.restyle is not None]
    restyles = [restyle for _, restyle in styled]
    pairs = colour_pairs(trained.model, scene, known.cameras, known.train, trained.config.render, restyles)
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


def export_gaussians(config: ExportConfig, file: "StyleFile") -> None:
    """Write a run of Gaussians."""
    from ..plugins.captures import format_name
    from ..splats.files import write_gaussians, write_ply_parts
    from ..splats.loading import open_gaussians
    from ..training.checkpoint import digest
    from ..training.quality import QualityConfig
    from ..training.run import Run

    for kind in config.kinds:
        if kind not in _OF_GAUSSIANS:
            raise UsageError(
                f"fprf export: of Gaussians there are {', '.join(_OF_GAUSSIANS)}, not {kind}; a run of fields has all kinds, "
                "or `export RUN cameras --images` makes a scene folder that other programs reconstruct"
            )
    if config.fit:
        raise UsageError("--fit: the run is of Gaussians already; leave it out")
    output = config.output or config.run / "exports"
    kinds, gaussians = tuple(dict.fromkeys(config.kinds or _OF_GAUSSIANS[:2])), format_name(output) is not None
    table = output.suffix.lower() == ".json" and not gaussians
    single = (gaussians or table) and not output.is_dir()
    if single and config.kinds and table != ("cameras" in kinds):
        raise UsageError(f"--output {output}: cameras are written to a .json file, Gaussians to others; name a folder")
    styles = styles_of(config, file, say)
    if single and len(styles) > 1:
        raise UsageError(f"--output {output}: one file holds one style, {len(styles)} are asked for; name a folder")
    run = Run(config.run)
    opened = open_gaussians(run, run.load_config()[0], config.device, QualityConfig())
    scene, paths, losses = opened.scene, [], dict[str, None]()
    looks = make_looks(scene, styles)[-1 if single else 0 :]
    if table or "cameras" in kinds:
        what = Plan(("cameras",), output.parent if single else output, output if single else None)
        with Display() as display:
            export_cameras(scene, opened.known, config, what, looks, display)
        print(f"cameras in {what.single or what.folder / 'transforms.json'}")
    kinds = () if table else tuple(kind for kind in kinds if kind != "cameras")
    for look in looks if kinds else ():
        shown = scene.restyled(look.restyle)
        for kind in kinds:
            paths.append(path := output if single else output / look_file("splats", look.name, f".{kind}"))
            if path.suffix.lower() == ".ply" and not path.name.lower().endswith(".compressed.ply") and not config.plain:
                style = "" if look.restyle is None else look.restyle.digest
                key = f"{digest(opened.run.checkpoints)} {style}{' local' * config.local}"
                key = hashlib.sha256(key.encode()).hexdigest()
                write_ply_parts(
                    path,
                    shown.part,
                    len(scene.gaussians),
                    key,
                    antialiased=True,
                    origin=scene.origin,
                    local=config.local,
                )
            else:
                written = write_gaussians(
                    path,
                    shown.shown,
                    antialiased=True,
                    views=scene.views,
                    plain=config.plain,
                    origin=scene.origin,
                    local=config.local,
                )
                losses |= {f", {path.name}: {loss}": None for loss in written.losses()}
    if paths:
        print(f"{len(scene.gaussians)} Gaussians in {', '.join(str(path) for path in dict.fromkeys(paths))}{''.join(losses)}")
