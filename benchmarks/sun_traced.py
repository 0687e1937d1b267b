"""Scenes of primitives, captured under clouds and lit by suns, against pictures of another renderer's paths.

    python -m benchmarks sun_traced [--scenes yard arcade stairs] [--steps 3000] [--seed 0] [--keep FOLDER] [--output JSON]

Mitsuba 3 (package `mitsuba`) shows each scene with light that bounces: first under an overcast sky of the CIE (three
times as bright overhead as at the horizon), which `fprf-splats` is trained on; then under its own `sunsky`, as held-out
views show it. The light that Gaussians are put in is that of `--sun AZIMUTH ELEVATION` alone: nothing of the other
renderer's sun and sky is told. Each picture is exposed so that 95 % of its scene are darker than 0.8 in linear light.

Judged are things, not the sky, each row after the best factor a channel in linear light over all views, as the
first row has it alone.
"""

import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from fprf.checks import at_least
from fprf.cli.parsing import load_method, parse
from fprf.errors import UsageError
from fprf.light.config import SunConfig
from fprf.light.relight import encoded
from fprf.light.sky import light_of
from fprf.splats.find_light import find_illumination
from fprf.splats.pinholes import covering
from fprf.splats.scene import SplatScene
from fprf.training.driver import train
from fprf.training.loading import open_run

from .common import report
from .sun import Judged, light_rows

_SUNS = ((35.0, 20.0), (160.0, 35.0), (280.0, 50.0))
"""Azimuth from +x towards +y, and elevation in degrees."""
_SIZE = (160, 120)
"""Pixels of a picture."""
_FIELD_OF_VIEW = 60.0
"""Horizontal, in degrees."""
_HELD_OUT_EVERY = 8
"""Views of which one is judged, and not trained on."""
_MAX_DEPTH = 5
"""Surfaces on a path of light, and the lamp."""
_TRAIN_SAMPLES = 16
"""Paths a pixel of the pictures that are trained on."""
_TRUTH_SAMPLES = 48
"""Of those that are judged by."""
_TEXELS = 72
"""Of a texture, a side."""
_POINTS = 256
"""Surface points kept per view, as a reconstruction would have them."""
_WHITE_SHARE = 0.95
"""Of a scene's pixels that are darker than `_WHITE`."""
_WHITE = 0.8
"""Linear light."""
_VARIANT = "scalar_rgb"
"""Of the renderer: needs no compiler."""

Triple = tuple[float, float, float]


class Primitive(NamedTuple):
    """A solid that stands in a scene."""

    kind: str
    """cube, sphere or cylinder (upright)."""
    centre: Triple
    half: Triple
    """Half its extent along x, y and z."""
    colour: Triple
    """Linear reflectance."""
    turn: float = 0.0
    """Degrees about z."""


def yard() -> list[Primitive]:
    """Boxes and balls."""
    return [
        Primitive("cube", (0.0, 0.0, 0.8), (0.8, 0.8, 0.8), (0.62, 0.24, 0.18), 25.0),
        Primitive("cube", (0.2, 0.1, 1.95), (0.35, 0.35, 0.35), (0.6, 0.55, 0.25), 60.0),
        Primitive("cube", (-2.4, 1.2, 1.3), (0.35, 1.4, 1.3), (0.55, 0.55, 0.52), -15.0),
        Primitive("cube", (2.4, -1.5, 0.4), (0.9, 0.4, 0.4), (0.25, 0.42, 0.6), 40.0),
        Primitive("sphere", (1.7, 1.5, 0.9), (0.9, 0.9, 0.9), (0.3, 0.5, 0.28)),
        Primitive("sphere", (-1.1, -1.9, 0.6), (0.6, 0.6, 0.6), (0.65, 0.5, 0.4)),
        Primitive("sphere", (0.9, -2.6, 0.35), (0.35, 0.35, 0.35), (0.6, 0.6, 0.62)),
    ]


def arcade() -> list[Primitive]:
    """Columns that carry a beam, before a wall."""
    stone = (0.58, 0.52, 0.42)
    solids = [Primitive("cube", (0.0, 2.2, 1.5), (3.6, 0.2, 1.5), (0.6, 0.38, 0.28))]
    for k in range(5):
        x = -3.0 + 1.5 * k
        solids.append(Primitive("cylinder", (x, 0.0, 1.1), (0.2, 0.2, 1.1), stone))
        solids.append(Primitive("cube", (x, 0.0, 0.12), (0.34, 0.34, 0.12), stone))
    solids.append(Primitive("cube", (0.0, 0.0, 2.4), (3.6, 0.35, 0.2), stone))
    solids.append(Primitive("cube", (0.0, 1.1, 2.7), (3.6, 1.45, 0.1), (0.5, 0.24, 0.17)))
    solids.append(Primitive("sphere", (1.2, -1.8, 0.5), (0.5, 0.5, 0.5), (0.3, 0.45, 0.55)))
    return solids


def stairs() -> list[Primitive]:
    """Steps up to a wall, and a tree."""
    solids = [Primitive("cube", (-0.5, 2.7, 1.4), (2.6, 0.2, 1.4), (0.56, 0.5, 0.4))]
    for k in range(6):
        height = 0.11 * (k + 1)
        solids.append(
            Primitive("cube", (-0.5, 0.2 + 0.36 * k, height), (1.5, 0.18, height), (0.5, 0.5, 0.48))
        )
    solids.append(Primitive("cylinder", (2.4, 0.4, 0.8), (0.14, 0.14, 0.8), (0.35, 0.24, 0.16)))
    draw = np.random.default_rng(5)
    for _ in range(24):
        away = draw.normal(size=3) * (0.5, 0.5, 0.4)
        size = float(draw.uniform(0.2, 0.36))
        at = (2.4 + away[0], 0.4 + away[1], 2.1 + away[2])
        green = (0.16 + 0.12 * float(draw.random()), 0.36 + 0.14 * float(draw.random()), 0.12)
        solids.append(Primitive("sphere", at, (size, size, size), green))
    solids.append(Primitive("cube", (-2.6, -1.2, 0.35), (0.35, 0.9, 0.35), (0.55, 0.3, 0.2), 20.0))
    return solids


SCENES: dict[str, Callable[[], list[Primitive]]] = {"yard": yard, "arcade": arcade, "stairs": stairs}


@dataclass(frozen=True, kw_only=True)
class SunTracedConfig:
    """Scenes of primitives under clouds, lit."""

    scenes: tuple[str, ...] = tuple(SCENES)
    """Of yard, arcade and stairs."""
    steps: int = 3000
    """Steps that Gaussians are trained."""
    views: int = 40
    """Views, of which every eighth is judged."""
    suns: int = len(_SUNS)
    """Suns of three: at 20, 35 and 50 degrees."""
    samples: int = _TRUTH_SAMPLES
    """Paths a pixel of the pictures that are judged by."""
    seed: int = 0
    """Of textures, views, paths and training."""
    keep: Path | None = None
    """Folder that keeps pictures and runs, for another time; none = they are thrown away."""
    output: Path | None = None
    """JSON file for the figures; none = only the table."""

    def __post_init__(self) -> None:
        at_least("steps", self.steps, 1)
        at_least("views", self.views, 8)
        at_least("suns", self.suns, 1)
        at_least("samples", self.samples, 1)
        unknown = [name for name in self.scenes if name not in SCENES]
        if unknown:
            raise UsageError(f"--scenes: {unknown[0]} is none of {', '.join(SCENES)}")


def main(argv: list[str]) -> int:
    """`python -m benchmarks sun_traced`."""
    config = parse(SunTracedConfig(), argv, prog="python -m benchmarks sun_traced", description=__doc__ or "")
    rows = []
    for name in config.scenes:
        with tempfile.TemporaryDirectory(prefix="fprf-sun-traced-") as made:
            known = f"{name}-{config.seed}-{config.steps}-{config.views}-{config.suns}-{config.samples}"
            rows += _scene_rows(config, name, (config.keep or Path(made)) / known)
    numbers = [name for name in rows[0] if name != "scene"]
    mean = {name: float(np.mean([row[name] for row in rows])) for name in numbers}
    report(config.output, {"seed": config.seed, "steps": config.steps, "suns": rows, "mean": mean})
    return 0


def _scene_rows(config: SunTracedConfig, name: str, folder: Path) -> list[dict[str, Any]]:
    """A row for each sun."""
    held_out = list(range(0, config.views, _HELD_OUT_EVERY))
    training = [k for k in range(config.views) if k not in held_out]
    if not (folder / "truth.npz").is_file():
        _trace(config, name, folder, held_out)
    if not (folder / "run" / "config.json").is_file():
        method, method_name = load_method("fprf-splats")
        method = replace(method, data=folder / "capture", output=folder / "run")
        train(replace(method, steps=config.steps, seed=config.seed), method_name)
    scene = open_run(folder / "run", device="cpu").scene
    if not isinstance(scene, SplatScene):
        raise UsageError("fprf-splats: no run of Gaussians")
    views = scene.views.select(torch.tensor(training))
    known = find_illumination(scene.gaussians, views, antialiased=scene.antialiased, near=scene.near)
    with np.load(folder / "truth.npz") as kept:
        things = torch.from_numpy(kept["things"])
        radiance = kept["radiance"]
    judged = Judged([covering(scene.views, k, scene.near) for k in held_out], things)
    rows = []
    for (azimuth, elevation), seen in zip(_SUNS[: config.suns], radiance, strict=True):
        toward = torch.from_numpy(direction_of(azimuth, elevation)).float()
        truth = torch.from_numpy(exposed(seen, things.numpy()))
        light = light_of(SunConfig(sun=known.degrees_of(toward)))
        row = light_rows(scene, known, judged, light, toward, truth.flatten(1, 2))
        rows.append({"scene": name, "azimuth": azimuth, "elevation": elevation} | row)
        print("  ".join(f"{key} {_short(value)}" for key, value in rows[-1].items()), flush=True)
    return rows


def _short(value: object) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)


def direction_of(azimuth: float, elevation: float) -> Annotated[NDArray[np.float64], "3"]:
    """Unit vector at degrees from +x towards +y, and above the horizon."""
    turn = np.radians(azimuth)
    rise = np.radians(elevation)
    return np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])


def orbit(views: int, seed: int) -> list[Annotated[NDArray[np.float64], "3 4"]]:
    """Camera to world, OpenGL's axes, all around at three heights, and a bit at random."""
    draw = np.random.default_rng([seed, 1])
    poses = []
    for k in range(views):
        turn = 2 * np.pi * (k + draw.uniform(-0.2, 0.2)) / views
        distance = draw.uniform(5.5, 7.5)
        place = np.array([distance * np.cos(turn), distance * np.sin(turn), (1.3, 2.4, 4.2)[k % 3]])
        ahead = np.array([*draw.uniform(-0.6, 0.6, 2), 0.9]) - place
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        poses.append(np.stack([right, np.cross(right, ahead), -ahead, place], 1))
    return poses


def cie_overcast(rows: int = 64) -> Annotated[NDArray[np.float32], "rows 2*rows 3"]:
    """Radiance of the overcast sky of the CIE, (1 + 2 sin h) / 3 by the height h, of which a level plane
    receives pi; from the zenith down to the nadir, below the horizon nothing.
    """
    height = np.sin(np.pi / 2 - np.pi * (np.arange(rows) + 0.5) / rows)
    sky = np.where(height > 0, (1 + 2 * height) / 3, 0) * 9 / 7
    return np.broadcast_to(sky[:, None, None], (rows, 2 * rows, 3)).astype(np.float32).copy()


def exposed(
    radiance: Annotated[NDArray[np.float32], "V H W 3"], things: Annotated[NDArray[np.bool_], "V P"]
) -> Annotated[NDArray[np.float32], "V H W 3"]:
    """sRGB of linear light, at the exposure at which `_WHITE_SHARE` of things are darker than `_WHITE`."""
    shown = radiance.reshape(*things.shape, 3)[things].max(-1)
    bright = float(np.quantile(shown, _WHITE_SHARE))
    return np.asarray(encoded(torch.from_numpy(radiance * (_WHITE / bright)).clamp(0, 1)).numpy())


def texture(seed: int) -> Annotated[NDArray[np.float32], "T T"]:
    """Noise at three scales in [0.6, 1]: what matching and training hold on to."""
    draw = np.random.default_rng([seed, 2])
    total = np.zeros((_TEXELS, _TEXELS), np.float32)
    for cells in (4, 12, 36):
        noise = draw.random((cells, cells), np.float32)
        total += cv2.resize(noise, (_TEXELS, _TEXELS), interpolation=cv2.INTER_LINEAR) / 3
    return np.asarray(0.6 + 0.4 * (total - total.min()) / np.ptp(total), np.float32)


class Tracer:
    """A scene of primitives on a ground, as Mitsuba shows it."""

    def __init__(self, solids: Sequence[Primitive], seed: int) -> None:
        import mitsuba as mi

        mi.set_variant(_VARIANT)
        self._mi = mi
        self._seed = 10_000 * seed
        self._noise = texture(seed)
        self._shapes = {"ground": self._ground()}
        for k, solid in enumerate(solids):
            self._shapes[f"solid{k}"] = self._shape(solid)

    def overcast(self) -> dict[str, Any]:
        """The overcast sky of the CIE."""
        # Its pole is y.
        upright = self._mi.ScalarTransform4f().rotate([1, 0, 0], 90)
        return {"type": "envmap", "bitmap": self._mi.Bitmap(cie_overcast()), "to_world": upright}

    def sunsky(self, sun: NDArray[np.float64]) -> dict[str, Any]:
        """Sun and sky of clear air."""
        return {"type": "sunsky", "sun_direction": sun.tolist()}

    def picture(
        self, pose: NDArray[np.float64], lamp: dict[str, Any], samples: int
    ) -> Annotated[NDArray[np.float32], "H W 3"]:
        """Radiance through the pixels of a view."""
        integrator = {"type": "path", "max_depth": _MAX_DEPTH}
        return self._rendered(pose, integrator, lamp, samples)[..., :3]

    def points(
        self, pose: NDArray[np.float64]
    ) -> tuple[Annotated[NDArray[np.float32], "H W 3"], Annotated[NDArray[np.bool_], "H W"]]:
        """Surface points at the pixels of a view, and where there is any."""
        integrator = {"type": "aov", "aovs": "at:position,far:depth"}
        found = self._rendered(pose, integrator, {"type": "constant"}, 1)
        return found[..., -4:-1], found[..., -1] > 0

    def _rendered(
        self, pose: NDArray[np.float64], integrator: dict[str, Any], lamp: dict[str, Any], samples: int
    ) -> NDArray[np.float32]:
        scene = {"type": "scene", "integrator": integrator, "lamp": lamp, "camera": self._camera(pose)}
        loaded = self._mi.load_dict(scene | self._shapes)
        self._seed += 1
        drawn = self._mi.render(loaded, spp=samples, seed=self._seed)
        return np.nan_to_num(np.array(drawn, np.float32))

    def _camera(self, pose: NDArray[np.float64]) -> dict[str, Any]:
        place = pose[:, 3]
        view = self._mi.ScalarTransform4f().look_at(
            origin=place.tolist(), target=(place - pose[:, 2]).tolist(), up=[0, 0, 1]
        )
        film = {
            "type": "hdrfilm",
            "width": _SIZE[0],
            "height": _SIZE[1],
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
        }
        return {
            "type": "perspective",
            "fov": _FIELD_OF_VIEW,
            "to_world": view,
            "film": film,
            "sampler": {"type": "independent"},
        }

    def _ground(self) -> dict[str, Any]:
        flat = self._mi.ScalarTransform4f().scale([14, 14, 1])
        return {"type": "rectangle", "to_world": flat, "bsdf": self._matt((0.34, 0.32, 0.28), 5.0)}

    def _shape(self, solid: Primitive) -> dict[str, Any]:
        place = self._mi.ScalarTransform4f().translate(list(solid.centre)).rotate([0, 0, 1], solid.turn)
        size = self._mi.ScalarTransform4f().scale(list(solid.half))
        shape: dict[str, Any] = {"type": solid.kind, "bsdf": self._matt(solid.colour, 1.0)}
        if solid.kind == "cylinder":
            shape |= {"p0": [0, 0, -1], "p1": [0, 0, 1], "radius": 1.0}
        return shape | {"to_world": place @ size}

    def _matt(self, colour: Triple, times: float) -> dict[str, Any]:
        """A matt surface from both sides, with the texture so many times a side."""
        pixels = self._noise[..., None] * np.array(colour, np.float32)
        image = {
            "type": "bitmap",
            "bitmap": self._mi.Bitmap(pixels.astype(np.float32)),
            "raw": True,
            "to_uv": self._mi.ScalarTransform4f().scale([times, times, 1]),
        }
        return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": image}}


def _trace(config: SunTracedConfig, name: str, folder: Path, held_out: Sequence[int]) -> None:
    """Write the capture, and `truth.npz` of the held-out views: `radiance` [L V H W 3] under each sun, and
    `things` [V P], where there is no sky.
    """
    tracer = Tracer(SCENES[name](), config.seed)
    poses = orbit(config.views, config.seed)
    _write_capture(folder / "capture", tracer, poses, held_out, config.seed)
    radiance = []
    for sun in _SUNS[: config.suns]:
        lamp = tracer.sunsky(direction_of(*sun))
        radiance.append([tracer.picture(poses[k], lamp, config.samples) for k in held_out])
    things = [tracer.points(poses[k])[1].ravel() for k in held_out]
    np.savez_compressed(folder / "truth.npz", radiance=np.array(radiance), things=np.stack(things))


def _write_capture(
    folder: Path,
    tracer: Tracer,
    poses: Sequence[NDArray[np.float64]],
    held_out: Sequence[int],
    seed: int,
) -> None:
    """Pictures under clouds, their cameras and surface points, as a scene folder."""
    (folder / "images").mkdir(parents=True)
    lamp = tracer.overcast()
    radiance = np.stack([tracer.picture(pose, lamp, _TRAIN_SAMPLES) for pose in poses])
    seen = [tracer.points(pose) for pose in poses]
    there = np.stack([each[1].ravel() for each in seen])
    pictures = np.rint(255 * exposed(radiance, there)).astype(np.uint8)
    draw = np.random.default_rng([seed, 3])
    places = []
    colours = []
    finders = []
    names = [f"images/{k:04d}.png" for k in range(len(poses))]
    for k, (name, picture) in enumerate(zip(names, pictures, strict=True)):
        cv2.imwrite(str(folder / name), picture[..., ::-1])
        if k in held_out:
            continue
        at = draw.permutation(np.flatnonzero(there[k]))[:_POINTS]
        places.append(seen[k][0].reshape(-1, 3)[at])
        colours.append(picture.reshape(-1, 3)[at])
        finders += [k] * len(at)
    rows = np.stack([finders, np.arange(len(finders))], 1)
    np.savez_compressed(
        folder / "points.npz", xyz=np.concatenate(places), rgb=np.concatenate(colours), seen=rows
    )
    focal = _SIZE[0] / 2 / np.tan(np.radians(_FIELD_OF_VIEW / 2))
    frames = []
    for name, pose in zip(names, poses, strict=True):
        frames.append({"file_path": name, "transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]})
    cameras = {
        "camera_model": "PINHOLE",
        "fl_x": focal,
        "fl_y": focal,
        "cx": _SIZE[0] / 2,
        "cy": _SIZE[1] / 2,
        "w": _SIZE[0],
        "h": _SIZE[1],
        "frames": frames,
        "train_filenames": [name for k, name in enumerate(names) if k not in held_out],
        "test_filenames": [names[k] for k in held_out],
    }
    (folder / "transforms.json").write_text(json.dumps(cameras), encoding="utf-8")
