"""Restyling of real pictures by true answers: fixed cameras, one place in many lights.

    python -m benchmarks light [--folder FOLDER] [--lights 8] [--seeds 0 1 2] [--output JSON] [--sheet PNG]

FOLDER holds the pictures of one camera, or a folder of them for each. A is the most usual light: the picture
that is nearest to all others. B are those that differ most from A and from each other, one after the other.
The protocol is that of `halves.py`. The scene is A with one point a pixel: colours as content, the default
semantics, as many regions as a capture of Gaussians has by default, times one and a half.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from fprf.checks import at_least
from fprf.cli.parsing import parse
from fprf.datamanagers.basis import fit_basis
from fprf.datamanagers.images import IMAGE_SUFFIXES, load_image
from fprf.interfaces import Encoder
from fprf.io.images import shrink
from fprf.ops.config import GuidedConfig
from fprf.plugins.encoders.config import SEMANTICS
from fprf.splats.restyle import ColourEncoder
from fprf.style.dictionary import Encoders
from fprf.style.scene_style import Membership

from .common import SHARED
from .halves import METHODS, Image, Judged, half_reference, judge_pair, report_halves
from .single_image import encoded, flat_landmarks, flat_look, flat_scene, render_flat

_THUMBNAIL_PIXELS = 32
"""Longer side at which lights are compared."""
_COMPONENTS = 31
"""Principal components of the semantics, as of a capture."""
_REGIONS = 24
"""Regions of A."""


@dataclass(frozen=True, kw_only=True)
class LightConfig:
    """Fixed cameras: the left half of another light restyles a picture, the right half judges it."""

    folder: Path = SHARED / "data/webcam"
    """Pictures of one camera, or folders of them."""
    cameras: tuple[str, ...] = ()
    """Folders that are looked at; none = all."""
    lights: int = 8
    """Lights of a camera that are asked for."""
    width: int = 320
    """Longer side of the pictures in pixels."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of the clusters, regions and codes."""
    output: Path | None = None
    """JSON file for the figures; none = only the tables."""
    sheet: Path | None = None
    """Picture of all pairs by every method; none = none."""

    def __post_init__(self) -> None:
        at_least("lights", self.lights, 1)
        at_least("width", self.width, 64)
        at_least("seeds", len(self.seeds), 1)


def pictures_of(folder: Path) -> list[Path]:
    """The pictures in a folder, by name."""
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)


def chosen_lights(thumbnails: Annotated[Tensor, "V X"], lights: int) -> tuple[int, list[int]]:
    """The picture nearest to all others, and `lights` others: each the farthest from all chosen before."""
    apart = torch.cdist(thumbnails.double(), thumbnails.double())
    usual = int(apart.mean(1).argmin())
    chosen = [usual]
    for _ in range(min(lights, len(thumbnails) - 1)):
        chosen.append(int(apart[chosen].amin(0).argmax()))
    return usual, chosen[1:]


def _loaded(path: Path, longest: int) -> Image:
    return torch.from_numpy(shrink(load_image(path), longest)).float() / 255


@torch.inference_mode()
def judge_camera(paths: Sequence[Path], semantic: Encoder, config: LightConfig, folder: Path) -> list[Judged]:
    """All pairs of one camera. `folder` takes the references' files."""
    small = torch.stack([_loaded(path, _THUMBNAIL_PIXELS).flatten() for path in paths])
    usual, others = chosen_lights(small, config.lights)
    plain = _loaded(paths[usual], config.width)
    size = (plain.shape[0], plain.shape[1])
    maps = semantic(plain.permute(2, 0, 1)[None])[0].float()
    basis = fit_basis(maps.flatten(1).T, _COMPONENTS)
    guided = GuidedConfig()
    features = encoded(plain, semantic, guided, basis)
    judged = []
    for seed in config.seeds:
        flat = flat_scene(plain.flatten(0, 1), features, size, regions=_REGIONS, seed=seed)
        encoders = Encoders(
            ColourEncoder(),
            semantic,
            basis,
            flat.style,
            longest=max(size),
            guided=guided,
            seed=seed,
            landmarks=flat_landmarks(plain, features),
        )
        belongs = Membership(flat.style.keys, flat.style.semantic_mean)(features).view(*size, -1)
        for other in others:
            light = _loaded(paths[other], config.width)
            dictionary = half_reference(light, encoders, folder, seed=seed)
            styled = {}
            for name, (stylizer, bold) in METHODS.items():
                styled[name] = render_flat(flat, flat_look(flat, dictionary, stylizer, None, bold), None)
            rows, pictures = judge_pair(plain, light, styled, belongs)
            place = paths[usual].parent.name
            judged.append(Judged(place, paths[usual].name, paths[other].name, seed, rows, pictures))
    return judged


def main(argv: list[str]) -> int:
    """`python -m benchmarks light`."""
    torch.set_num_threads(1)
    config = parse(LightConfig(), argv, prog="python -m benchmarks light", description=__doc__ or "")
    if not config.folder.is_dir():
        print(f"light: skipped, {config.folder} is no folder; name one with pictures of fixed cameras")
        return 0
    folders = [config.folder]
    if not pictures_of(config.folder):
        names = config.cameras or sorted(path.name for path in config.folder.iterdir() if path.is_dir())
        folders = [config.folder / name for name in names]
    semantic = SEMANTICS.build()
    judged: list[Judged] = []
    with tempfile.TemporaryDirectory(prefix="fprf-light-") as made:
        for folder in folders:
            judged += judge_camera(pictures_of(folder), semantic, config, Path(made))
    settings = {
        "cameras": [folder.name for folder in folders],
        "lights": config.lights,
        "width": config.width,
        "regions": _REGIONS,
        "seeds": list(config.seeds),
        "semantic_encoder": semantic.identity,
    }
    report_halves("light", judged, settings, config.output, config.sheet)
    return 0
