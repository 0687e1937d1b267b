"""`fprf export RUN [ply splat glb cameras ...]`: a scene, plain or restyled, as files that other programs
open.
"""

import contextlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ..errors import UsageError
from ..export.config import FIT_MINUTES, KINDS, ExportConfig, Plan, plan
from ..io.overwriting import Origin
from ..plugins.captures import endings
from ..progress import Display
from ..style.files import StyleFile
from .parsing import read_paths
from .style_flags import named_styles, origin_of, read_flags, style_name, tidy

if TYPE_CHECKING:
    from ..export.mesh import Maps
    from ..rendering.cameras import Cameras
    from ..scenes import Scene
    from ..splats.gaussians import GaussianRows
    from ..style.look import Restyle
    from ..training.loading import LoadedRun

# Endings come from the formats that are installed, those of packages too.
_EXPORT_HELP = f"""A scene as files that other programs open, in the capture's own frame.

Kinds may follow the run: {
    ", ".join(ending[1:] for ending in endings() if ending[1:] not in KINDS)
} = 3D Gaussians; {"; ".join(f"{name} = {what}" for name, what in KINDS.items())}.
A look of the scene is a file: splats.ply as it is, splats.NAME.ply in a style, with the same Gaussians in the same order."""


def run(args: list[str]) -> int:
    """Render views, fit Gaussians to them or mesh them where that is wanted, write the files."""
    words = ("run", "kinds")
    config, file = read_flags(
        ExportConfig(), args, prog="fprf export", description=_EXPORT_HELP, positional=words
    )
    # What is to be written, and under which names, is settled before the run is opened: mistakes cost no
    # time.
    what = plan(config.kinds, config.output or config.run / "exports")
    _check_formats(what)
    styles = _styles(config, what, file)
    origins = _origins(config, file, styles)
    for name, origin in origins.items():
        origin.check(_files(what, name, last=name == [*origins][-1]))
    from ..io.atomic import write_json
    from ..training.loading import open_run

    start = time.perf_counter()
    opened = open_run(config.run, config.device)
    looks = _looks(opened.scene, styles)
    looks = looks[-1 if what.single else 0 :]
    made: dict[str, Any] = {
        "run": opened.known.name,
        "step": opened.step,
        "styles": [name for name, _ in styles],
        "origin": list(opened.scene.origin),
    }
    with contextlib.ExitStack() as stack:
        for look in looks:
            files = _files(what, look.name, last=look is looks[-1])
            if look is looks[-1]:
                pictures = _pictures(config, what, opened.scene.names)
            else:
                pictures = []
            stack.enter_context(origins[look.name].writing([*files, *pictures]))
        display = stack.enter_context(Display())
        export = _Export(config, what, opened, looks, display)
        made |= {**export.gaussians(), **export.meshes(), **export.cameras()}
        made["seconds"] = time.perf_counter() - start
        if what.single is None:
            write_json(what.folder / "export.json", made)
    if "gaussians" in made:
        print(f"{made['gaussians']} Gaussians{''.join(f', {loss}' for loss in made['losses'])}")
    if "vertices" in made:
        print(f"mesh: {made['vertices']} vertices, {made['triangles']} triangles")
    print(f"{', '.join(what.kinds)} in {what.single or what.folder}  ({made['seconds']:.1f} s)")
    return 0


def _check_formats(what: Plan) -> None:
    """Raise UsageError for a format that is read alone, DataError where a package is missing."""
    from ..splats.files.base import check_needs, format_of

    for kind in what.formats:
        form = format_of(Path(f"splats.{kind}"))
        if not form.writes:
            raise UsageError(f"fprf export: {kind} is read, not written; name ply, splat, spz, sog or glb")
        check_needs(form)


def _styles(config: ExportConfig, what: Plan, file: StyleFile) -> list[tuple[str, StyleFile]]:
    """The styles with their names in those of files, that of the flags first. Raises UsageError for names that
    do not do.
    """
    styles = named_styles(config.styles, file)
    if config.references or config.light_asked:
        name = style_name(config.style, config.references) or config.light_name
        styles.insert(0, (tidy(name) or "style", file))
    names = []
    for name, _ in styles:
        names.append(name.casefold())
    for name, _ in styles:
        if names.count(name.casefold()) > 1:
            raise UsageError(f"--styles {name}: two styles of this name; give each its own")
        if any(ending.startswith(f".{name.lower()}.") for ending in endings()):
            raise UsageError(
                f"--styles {name}: splats.{name}.ply is the name of another format; give the style another one"
            )
    if what.single is not None and len(styles) > 1:
        raise UsageError(
            f"--output {what.single}: one file holds one style, {len(styles)} are asked for; name a folder"
        )
    return styles


def _origins(
    config: ExportConfig, file: StyleFile, styles: Sequence[tuple[str, StyleFile]]
) -> dict[str, Origin]:
    """Origin of the files of each look, the scene as it is first: each is made of the run and its own style."""
    whole = origin_of("export", config, file, [path for _, each in styles for path in read_paths(each.style)])
    origins = {"": replace(whole, reads=(config.run,), beside=whole.reads)}
    for name, style in styles:
        own = read_paths(style.style)
        if config.style is not None and style is file:
            own = (*own, config.style)
        origins[name] = replace(whole, reads=(config.run, *own), beside=whole.reads)
    return origins


def _files(what: Plan, look: str, *, last: bool) -> list[Path]:
    """The files of a look, but pictures of views. What holds for all looks belongs to the scene as it is."""
    from ..rendering.local_frame import offset_file  # imports torch

    if what.single is not None:
        if last:
            return [what.single, offset_file(what.single)]
        return []
    files: list[Path] = []
    if what.formats:
        files += what.paths("splats", look, *(f".{each}" for each in what.formats))
    if "glb" in what.kinds:
        files += what.paths("mesh", look, ".ply", ".glb")
    if "cameras" in what.kinds and not look:
        files.append(what.folder / "transforms.json")
    offsets = []
    for path in files:
        offsets.append(offset_file(path))
    return [*files, *offsets, *([] if look else [what.folder / "export.json"])]


def _pictures(config: ExportConfig, what: Plan, views: Sequence[str]) -> list[Path]:
    """Pictures of views, which show the last look."""
    if not (config.images and "cameras" in what.kinds):
        return []
    found: list[Path] = []
    for name in views:
        found.append(what.folder / f"images/{name}.png")
    return found


def _looks(scene: "Scene", styles: Sequence[tuple[str, StyleFile]]) -> "list[_Look]":
    """The scene as it is and in each style; encoders are loaded once."""
    from ..style.restyle import apply_style

    looks = [_Look("", None)]
    encoders = scene.encoders() if styles else None
    for name, file in styles:
        looks.append(_Look(name, apply_style(scene, file, encoders).restyle))
        for note in scene.restyled(looks[-1].restyle).light_notes:
            print(note)
    return looks


class _Look(NamedTuple):
    """The scene as it is (no name, no restyle), or in a style."""

    name: str
    restyle: "Restyle | None"


@dataclass(frozen=True, eq=False)
class _Export:
    """Source of every kind of file. Methods write the files of one kind, if it is wanted, and return
    their counts.
    """

    config: ExportConfig
    what: Plan
    opened: "LoadedRun[Scene]"
    looks: Sequence[_Look]
    display: Display

    @cached_property
    def views(self) -> "Cameras":
        """Training views, at most as many as are asked for, spread evenly over their order."""
        import torch

        train = self.opened.known.train
        most = self.config.views
        if len(train) > most:
            train = tuple(train[round(k * (len(train) - 1) / (most - 1))] for k in range(most))
        return self.opened.scene.cameras.select(torch.tensor(train))

    def maps(self, look: _Look) -> "Maps":
        """Depth and colours of the views."""
        from ..export.mesh import default_reach, render_maps

        if self.config.reach is None:
            reach = default_reach(self.opened.known.facts.space)
        else:
            reach = self.config.reach
        scene = self.opened.scene.restyled(look.restyle)
        report = partial(self.display.count, what="rendering depth")
        return render_maps(scene, self.views, side=self.config.side, reach=reach, report=report)

    @cached_property
    def plain(self) -> "Maps":
        """The same of the scene as it is: all geometry comes from these."""
        return self.maps(_Look("", None))

    def gaussians(self) -> dict[str, Any]:
        """Gaussians as they are, or fitted to the scene's own renders; the same in each look, but for their
        colours.
        """
        from ..splats.files import write_gaussians

        config = self.config
        scene = self.opened.scene
        paths = []
        losses = dict[str, None]()
        count = 0
        own = scene.gaussian_rows() is not None
        if not self.what.formats:
            return {}
        # Gaussians are written as they are, and never fitted to renders of themselves.
        if own and config.fit:
            raise UsageError("--fit: the run is of Gaussians already; leave it out")
        rows: Iterator[GaussianRows | None] = self._fitted()
        if own:
            rows = (scene.restyled(look.restyle).gaussian_rows() for look in self.looks)
        for look, gaussians in zip(self.looks, rows, strict=True):
            assert gaussians is not None
            count = gaussians.count
            # One set of rows serves every format: a look of a fitted field is minutes of work.
            for path in self.what.paths("splats", look.name, *(f".{each}" for each in self.what.formats)):
                written = write_gaussians(
                    path,
                    gaussians,
                    views=scene.cameras if own else self.views,
                    plain=config.plain,
                    origin=scene.origin,
                    local=config.local,
                )
                paths.append(path)
                losses |= dict.fromkeys(f"{path.name}: {loss}" for loss in written.losses())
        return {"gaussians": count, "losses": [*losses]}

    def _fitted(self) -> Iterator["GaussianRows"]:
        from ..export.fit import Limits, fit_gaussians
        from ..rendering.north import bearings_of
        from ..splats.gaussians import GaussianRows

        scene = self.opened.scene
        bearings = bearings_of(scene.cameras, scene.north, scene.up)
        limits = Limits(
            minutes=self.config.fit or FIT_MINUTES,
            cap=self.config.fit_cap,
            background=self.opened.known.facts.background,
        )
        looks = []
        for look in self.looks:
            looks.append(look.restyle)
        fitted = fit_gaussians(scene, self.views, self.plain, looks, limits, report=self.display.count)
        return (GaussianRows(len(gaussians), gaussians.select, True, bearings) for gaussians in fitted)

    def meshes(self) -> dict[str, Any]:
        """One mesh of the scene as it is, in the colours of each look."""
        if "glb" not in self.what.kinds:
            return {}
        from ..export.mesh import build_mesh, vertex_colours, write_mesh

        report = partial(self.display.count, what="building the mesh")
        # Geometry comes from the scene as it is, whatever the style: meshes of all looks have the same
        # vertices.
        mesh = build_mesh(self.plain, edge=self.config.mesh_edge, report=report)
        for look in self.looks:
            colour = vertex_colours(self.plain if look.restyle is None else self.maps(look), mesh)
            for path in self.what.paths("mesh", look.name, ".ply", ".glb"):
                write_mesh(path, mesh, colour, self.opened.scene.origin, local=self.config.local)
        return {"vertices": len(mesh.point), "triangles": len(mesh.face), "mesh_edge": mesh.edge}

    def cameras(self) -> dict[str, Any]:
        """transforms.json, and the pictures that it names if they are wanted, in the last look."""
        if "cameras" not in self.what.kinds:
            return {}
        from ..io.atomic import write_json
        from ..io.images import to_uint8, write_image
        from ..rendering.local_frame import added_and_beside, write_offset
        from ..rendering.paths import transforms

        known = self.opened.known
        scene = self.opened.scene.restyled(self.looks[-1].restyle)
        files = []
        for name in scene.names:
            files.append(f"images/{name}.png")
        # Names are those of the captured views, so that a scene folder of renders can be compared with the
        # captured one.
        for view, file in enumerate(files if self.config.images else ()):
            self.display.count(view, len(files), "rendering views")
            write_image(self.what.folder / file, to_uint8(scene.render(scene.cameras, view).rgb))
        # Poses in the capture's coordinates, or about the origin with an offset file beside them.
        added, beside = added_and_beside(scene.origin, self.config.local)
        path = self.what.single or self.what.folder / "transforms.json"
        write_json(path, transforms(scene.cameras.shifted(added), files, train=known.train, test=known.test))
        write_offset(path, beside)
        return {"cameras": len(files)}
