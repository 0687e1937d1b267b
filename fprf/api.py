"""A trained run as a Python object: look, restyle, render.

    import fprf
    scene = fprf.load("runs/garden-fprf-lite")
    autumn = scene.stylize(["autumn.jpg"])
    shot = autumn.render(scene.camera("0015"))
    shot.save("autumn.png")

Scenes never change: what restyles one returns another, and both share the trained model. Tensors are on the
CPU.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

import torch
from PIL import Image
from torch import Tensor

from .checks import at_least, between
from .errors import UsageError
from .io.atomic import write_bytes
from .io.images import Picture, encode, to_uint8, write_image
from .io.memory_pictures import Photograph, is_temporary, photograph_files
from .io.overwriting import Origin
from .io.paths import PathLike, as_path, as_paths
from .light.config import LightName
from .plugins.conversion import three_numbers
from .plugins.registry import nearest
from .plugins.stylizers.config import RegionToneConfig, StylizerConfig
from .rendering.cameras import Cameras
from .rendering.local_frame import offset_file
from .rendering.paths import look_at, make_path, pinhole, upwards
from .scenes import Scene
from .splats.capture_light import light_alone
from .splats.captures import Captures, open_captures
from .splats.config import LookConfig
from .splats.files import Capture, write_capture
from .splats.gaussians import Gaussians
from .style.config import NO_MASK, StyleConfig, with_preset
from .style.dictionary import Encoders
from .style.files import StyleFile, check_photographs, read_style, write_style
from .style.look import Restyle
from .style.match_maps import MatchMap, match_map
from .style.restyle import Styled, apply_style, mixed
from .training.loading import LoadedRun

Split = Literal["train", "test", "all"]
_BY = "python"
"""The verb of what Python writes (`io.overwriting`)."""
_REMEDY = "give another path, or replace it with overwrite=True"


def _origin(*reads: Path) -> Origin:
    """Origin of what is made of files."""
    return Origin(by=_BY, reads=reads, remedy=_REMEDY)


def _texts(values: str | Sequence[str]) -> tuple[str, ...]:
    """One text, or several."""
    return (values,) if isinstance(values, str) else tuple(values)


@dataclass(frozen=True)
class Shot:
    """One rendered view."""

    rgb: Annotated[Tensor, "H W 3"]
    """sRGB in [0, 1], float32."""
    depth: Annotated[Tensor, "H W"]
    """Distance along the unit ray, in the capture's units."""
    opacity: Annotated[Tensor, "H W"]
    """Opacity of the ray, in [0, 1]."""
    origin: Origin = Origin(by=_BY, remedy=_REMEDY)
    """The run and the photographs that it was made of."""

    @property
    def pixels(self) -> Picture:
        """The colours as uint8 RGB, a numpy array [H W 3]."""
        return to_uint8(self.rgb)

    @property
    def image(self) -> Image.Image:
        """The colours as a picture of Pillow."""
        return Image.fromarray(self.pixels)

    def __repr__(self) -> str:
        height, width = self.rgb.shape[:2]
        return f"<Shot {width}x{height}>"

    def _repr_png_(self) -> bytes:
        """The picture in a notebook."""
        return encode(self.pixels, "png")

    def save(self, path: PathLike, *, overwrite: bool = False) -> None:
        """Write the colours: .png, .jpg or .webp. Raises DataError for another ending, UsageError where something
        else is there already, unless `overwrite` is true.
        """
        file = as_path(path)
        with replace(self.origin, overwrite=overwrite).writing([file]):
            write_image(file, self.pixels)


@dataclass(frozen=True)
class TrainedScene:
    """A scene, as it was captured or in a style. Make one with `fprf.load`."""

    trained: LoadedRun[Scene]
    """Scene, cameras and run folder, for what this class does not offer."""
    styled: Styled | None = None
    """The style with its dictionary and codes; None = as it was captured."""
    style_files: tuple[Path, ...] = ()
    """The style file that the style was read from."""
    encoders: Callable[[], Encoders] = field(kw_only=True, repr=False)
    """Encoders of the run, loaded at the first style and kept for the next; one function for all styles of a
    loaded scene.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the captured views."""
        return self.trained.known.names

    @property
    def cameras(self) -> Cameras:
        """Cameras of the captured views, in the order of `names`: as all cameras here, in the capture's
        coordinates.
        """
        return self.trained.known.cameras.shifted(self.trained.scene.origin)

    @property
    def references(self) -> tuple[str, ...]:
        """Names of the references of the style; those of a mix one after the other."""
        if self.styled is None:
            return ()
        return self.styled.codes.names

    def camera(self, view: int | str) -> Cameras:
        """One captured camera, by number or name. Raises UsageError where there is none."""
        if isinstance(view, str):
            if view not in self.names:
                raise UsageError(
                    f"camera {view!r}: no such view{nearest(view, list(self.names))}; `names` lists them"
                )
            view = self.names.index(view)
        if not 0 <= view < len(self.names):
            raise UsageError(f"camera {view}: no such view; numbers go from 0 to {len(self.names) - 1}")
        return self.cameras.select(torch.tensor([int(view)]))

    def camera_at(
        self,
        position: Sequence[float],
        target: Sequence[float],
        *,
        fov: float = 60.0,
        width: int = 640,
        height: int = 480,
    ) -> Cameras:
        """A pinhole camera at a place (capture's coordinates) that looks at another; `fov` is its vertical
        angle in degrees.

        Up is where the captured cameras have it. Raises UsageError where position and target are one,
        ConfigError for an angle or a size that no camera has.
        """
        between("fov", fov, 1e-3, 179.0)
        at_least("width", width, 1)
        at_least("height", height, 1)
        here = torch.tensor([three_numbers("position", position)], dtype=torch.float64)
        there = torch.tensor([three_numbers("target", target)], dtype=torch.float64)
        if bool(torch.equal(here, there)):
            raise UsageError(f"camera_at: position and target are both {position}; give two places")
        pose = look_at(here, there, upwards(self.cameras))
        return pinhole(pose, width=width, height=height, fov=fov)

    def path(self, motion: PathLike, frames: int = 120, split: Split = "all") -> Cameras:
        """Cameras of a flight: spiral, orbit, interpolate, dataset, or a camera-path JSON file. Raises
        UsageError.
        """
        return make_path(self.cameras, self.trained.known.split(split), os.fspath(motion), frames)

    def stylize(
        self,
        references: Photograph | Sequence[Photograph] = (),
        *,
        weights: Sequence[float] = (),
        masks: PathLike | Sequence[PathLike] = (),
        stylizer: StylizerConfig | None = None,
        clusters: int = 20,
        blend: float = 0.1,
        strength: float = 1.0,
        luminance: float = 0.0,
        bold: float = 0.65,
        pin: str | Sequence[str] = (),
        forbid: str | Sequence[str] = (),
        keep: str | Sequence[str] = (),
        region_strength: str | Sequence[str] = (),
        keep_below: float | None = None,
        between: PathLike | None = None,
        at: float = 0.5,
        light: LightName | None = None,
        sun: tuple[float, float] | Literal["auto"] | None = None,
        sun_from: Literal["north", "view"] = "north",
        sun_elevation: float | None = None,
        sun_over_sky: tuple[float, float, float] | None = None,
        sun_strength: float = 1.0,
        sun_colour: str | None = None,
        sky_colour: str | None = None,
        sun_size: float = 0.53,
        unlit: bool = False,
        preset: str | None = None,
    ) -> "TrainedScene":
        """The scene in the style of one photograph or several, or of all in a folder: files, pictures of Pillow or
        arrays. All arguments but `preset` are fields of `StyleConfig`, which explains them; under a
        `light` or a `sun` Gaussians need no photographs.

        A preset, such as "gentle", replaces what it sets (`fprf.style.config.PRESETS`).

        Raises UsageError for no references, an unknown preset or wishes that the scene does not know,
        DataError for unreadable photographs, WeightsError where the encoders at hand are not the scene's.
        """
        style = StyleConfig(
            references=photograph_files(references),
            weights=tuple(weights),
            masks=as_paths(masks),
            stylizer=RegionToneConfig() if stylizer is None else stylizer,
            clusters=clusters,
            blend=blend,
            strength=strength,
            luminance=luminance,
            bold=bold,
            pin=_texts(pin),
            forbid=_texts(forbid),
            keep=_texts(keep),
            region_strength=_texts(region_strength),
            keep_below=keep_below,
            between=None if between is None else as_path(between),
            at=at,
            light=light,
            sun=sun,
            sun_from=sun_from,
            sun_elevation=sun_elevation,
            sun_over_sky=sun_over_sky,
            sun_strength=sun_strength,
            sun_colour=sun_colour,
            sky_colour=sky_colour,
            sun_size=sun_size,
            unlit=unlit,
        )
        if preset is not None:
            style = with_preset(style, preset)
        return self.apply(style)

    def apply(self, style: StyleConfig | PathLike) -> "TrainedScene":
        """The scene in a style that is written down: a config, or a style.json of `fprf stylize`. Raises as
        `stylize`.
        """
        if isinstance(style, StyleConfig):
            styled = apply_style(self.trained.scene, StyleFile(style), self.encoders())
            return replace(self, styled=styled, style_files=())
        path = as_path(style)
        file = read_style(path)
        check_photographs(path, file)
        styled = apply_style(self.trained.scene, file, self.encoders(), (path.resolve(),))
        return replace(self, styled=styled, style_files=(path,))

    def towards(self, other: "TrainedScene", at: float) -> "TrainedScene":
        """On the way from this style (0) to that of `other` (1), point by point. Raises UsageError without
        two styles.
        """
        if self.styled is None or other.styled is None or self.encoders is not other.encoders:
            raise UsageError(
                "towards: both must be styles of one loaded scene; call `stylize` on the same scene for each"
            )
        mix = mixed(self.styled, other.styled, at)
        # What is between two styles already is no longer what its file says: `save_style` tells a mix by
        # this.
        saved = mix.controls.saved
        saved = saved._replace(style=replace(saved.style, between=None))
        return replace(self, styled=mix._replace(controls=mix.controls._replace(saved=saved)))

    def plain(self) -> "TrainedScene":
        """The scene as it was captured."""
        return replace(self, styled=None)

    def save_style(self, path: PathLike, *, overwrite: bool = False) -> None:
        """Write the style as a style.json; references that were pictures in memory go beside it, as PNG. Raises
        UsageError without a style, for a mix made by `towards`, and where something else is there already, unless
        `overwrite` is true.
        """
        styled = self._style("save_style")
        if len(styled.restyle.parts) > 1 and styled.controls.saved.style.between is None:
            raise UsageError(
                "save_style: a mix has no file of its own; save both styles, and give one `between` and `at`"
            )
        file = as_path(path)
        saved = styled.controls.saved
        beside = {}
        for number, reference in enumerate(saved.style.references):
            if is_temporary(reference):
                beside[reference] = file.with_name(f"{file.stem}-{number}.png")
        references = tuple(beside.get(each, each) for each in saved.style.references)
        with replace(self.origin, overwrite=overwrite).writing([file, *beside.values()]):
            for picture, copy in beside.items():
                write_bytes(copy, picture.read_bytes())
            write_style(file, saved._replace(style=replace(saved.style, references=references)))

    def __repr__(self) -> str:
        """The scene in one line: without the numbers of its tensors."""
        style = _style_name(self.references) if self.styled is not None else "as captured"
        return f"<TrainedScene {self.trained.known.name!r}: {len(self.names)} views, {style}>"

    def _repr_html_(self) -> str:
        """The scene in a notebook: a page to walk through, of Gaussians; a picture of a field."""
        from .page.writer import notebook_html

        known = self.trained.known
        styled = self.styled
        views = known.test or known.train
        look = None
        if styled is not None:
            look = (_style_name(self.references), self.trained.scene.restyled(styled.restyle))
        return notebook_html(self.trained.scene, known.name, views[len(views) // 2], look)

    def render(self, camera: Cameras | int | str) -> Shot:
        """One view: of a camera, or of a captured one by number or name. Raises UsageError for several
        cameras.
        """
        return next(self.film(self._single("render", camera)))

    def film(self, cameras: Cameras) -> Iterator[Shot]:
        """Views of many cameras, one after the other, each when it is asked for."""
        # Cameras are the capture's; the scene is drawn about its origin, where float32 is fine enough.
        scene = self.trained.scene.restyled(self.restyle)
        cameras = self._local(cameras)
        for view in range(len(cameras)):
            made = scene.render(cameras, view)
            yield Shot(made.rgb, made.depth, made.opacity, self.origin)

    def matches(self, camera: Cameras | int | str) -> MatchMap:
        """Style codes that each pixel of a view takes; `styled.codes` names them. Raises UsageError without a
        style.
        """
        styled = self._style("matches")
        one = self._single("matches", camera)
        return match_map(self.trained.scene, styled, 0, self._local(one))

    @property
    def origin(self) -> Origin:
        """The run and the files that the style is made of."""
        reads = [self.trained.run.root, *self.style_files]
        if self.styled is not None:
            style = self.styled.controls.saved.style
            for path in (*style.references, *style.masks):
                if path != NO_MASK:
                    reads.append(path)
        return _origin(*reads)

    @property
    def restyle(self) -> Restyle | None:
        """The look that is rendered; None = as captured."""
        if self.styled is None:
            return None
        return self.styled.restyle

    def _local(self, cameras: Cameras) -> Cameras:
        """Cameras about the scene's origin."""
        return cameras.shifted([-x for x in self.trained.scene.origin])

    def _style(self, what: str) -> Styled:
        if self.styled is None:
            raise UsageError(f"{what}: the scene is in no style; call `stylize` or `apply` first")
        return self.styled

    def _single(self, what: str, camera: Cameras | int | str) -> Cameras:
        if isinstance(camera, Cameras):
            one = camera
        else:
            one = self.camera(camera)
        if len(one) != 1:
            raise UsageError(f"{what}: {len(one)} cameras; give one, or render them all with `film`")
        return one


def _style_name(references: Sequence[Path | str]) -> str:
    """Name of a style on a page."""
    return " + ".join(Path(name).stem for name in references) or "style"


@dataclass(frozen=True, eq=False)
class FinishedCapture:
    """A finished capture of 3D Gaussians, as it was read or in a style. Make one with `fprf.read`."""

    capture: Capture
    """The file, with what it says beside the Gaussians."""
    look: LookConfig
    """Views that it is looked at from before it is restyled."""
    harmonics: Annotated[Tensor, "N K 3"] | None = None
    """New ones of all Gaussians that can be drawn, or of all; None = as they were read."""
    seen: Callable[[], Captures] | None = field(default=None, repr=False)
    """Views and semantics, found at the first style and kept for the next."""
    references: tuple[Path, ...] = ()
    """Photographs of the style that it is in."""

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians as the file has them, about `capture.origin`; `.numpy()` of its tensors is the same
        memory.
        """
        read = self.capture.gaussians
        if self.harmonics is None:
            return read
        finite = read.finite
        new = self.harmonics
        return read.recoloured(
            new if len(new) == len(read) else read.harmonics.index_copy(0, finite.nonzero()[:, 0], new)
        )

    def restyled(
        self,
        references: Photograph | Sequence[Photograph] = (),
        *,
        weights: Sequence[float] = (),
        masks: PathLike | Sequence[PathLike] = (),
        stylizer: StylizerConfig | None = None,
        clusters: int = 20,
        blend: float = 0.1,
        strength: float = 1.0,
        luminance: float = 0.0,
        bold: float = 0.65,
        pin: str | Sequence[str] = (),
        forbid: str | Sequence[str] = (),
        keep: str | Sequence[str] = (),
        region_strength: str | Sequence[str] = (),
        keep_below: float | None = None,
        between: PathLike | None = None,
        at: float = 0.5,
        light: LightName | None = None,
        sun: tuple[float, float] | Literal["auto"] | None = None,
        sun_from: Literal["north", "view"] = "north",
        sun_elevation: float | None = None,
        sun_over_sky: tuple[float, float, float] | None = None,
        sun_strength: float = 1.0,
        sun_colour: str | None = None,
        sky_colour: str | None = None,
        sun_size: float = 0.53,
        unlit: bool = False,
        preset: str | None = None,
        match_light: bool = False,
    ) -> "FinishedCapture":
        """The capture, as it was read, in the style of photographs; arguments as those of `stylize` of a trained
        scene. `match_light` takes exposure and white balance alone; a `light` or a `sun` needs no photographs.

        Raises UsageError for neither, DataError for unreadable photographs and where nothing can be
        seen.
        """
        seen = self.seen or cache(lambda: open_captures([self.capture.path], self.look, first=self.capture))
        style = StyleConfig(
            references=photograph_files(references),
            weights=tuple(weights),
            masks=as_paths(masks),
            stylizer=RegionToneConfig(centred=False) if stylizer is None else stylizer,
            clusters=clusters,
            blend=blend,
            strength=strength,
            luminance=luminance,
            bold=bold,
            pin=_texts(pin),
            forbid=_texts(forbid),
            keep=_texts(keep),
            region_strength=_texts(region_strength),
            keep_below=keep_below,
            between=None if between is None else as_path(between),
            at=at,
            light=light,
            sun=sun,
            sun_from=sun_from,
            sun_elevation=sun_elevation,
            sun_over_sky=sun_over_sky,
            sun_strength=sun_strength,
            sun_colour=sun_colour,
            sky_colour=sky_colour,
            sun_size=sun_size,
            unlit=unlit,
        )
        if preset is not None:
            style = with_preset(style, preset)
        styled = apply_style(seen().scene, StyleFile(style))
        styled = light_alone(styled) if match_light else styled
        harmonics = seen().harmonics(0, self.capture, seen().scene.restyled(styled.restyle))
        return replace(self, harmonics=harmonics, seen=seen, references=style.references)

    def recoloured(self, harmonics: Annotated[Tensor, "N K 3"]) -> "FinishedCapture":
        """The capture with harmonics of your own for all Gaussians. Raises DataError where they are of other
        shapes.
        """
        return replace(self, harmonics=self.capture.gaussians.recoloured(harmonics).harmonics, references=())

    def __repr__(self) -> str:
        """The capture in one line: without the numbers of its tensors."""
        if self.harmonics is None:
            style = "as read"
        elif self.references:
            style = _style_name(self.references)
        else:
            style = "recoloured"
        count = len(self.capture.gaussians)
        return f"<FinishedCapture {self.capture.path.name!r}: {count} Gaussians, {style}>"

    def _repr_html_(self) -> str:
        """The capture in a notebook: a page to walk through, which opens in its style."""
        from .page.writer import notebook_html

        seen = self.seen or cache(lambda: open_captures([self.capture.path], self.look, first=self.capture))
        scene = seen().scene
        name = self.capture.path.stem
        look = None
        if self.harmonics is not None:
            drawn = self.gaussians.select(self.capture.gaussians.finite)
            if len(drawn) == len(scene.gaussians):
                shown = replace(scene, gaussians=scene.gaussians.recoloured(drawn.harmonics))
                look = (_style_name(self.references), shown)
            else:
                name = f"{name}, as captured: a sample of {len(drawn)} Gaussians"
        return notebook_html(scene, name, 0, look)

    def write(self, path: PathLike, *, overwrite: bool = False) -> list[str]:
        """Write a file, whole or not at all; its ending says the format. Returns what the format does not
        hold, as phrases.

        In the format that was read everything but colours stays as it was, bit for bit. Raises UsageError where
        something else is there already, the file that was read among it, unless `overwrite` is true.
        """
        file = as_path(path)
        origin = replace(_origin(self.capture.path, *self.references), overwrite=overwrite)
        if self.harmonics is None:
            harmonics = self.capture.gaussians.harmonics
        else:
            harmonics = self.harmonics
        views = None
        if self.seen is not None:
            views = self.seen().scene.views
        with origin.writing([file, offset_file(file)]):
            return write_capture(file, self.capture, harmonics, views).losses()
