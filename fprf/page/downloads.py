"""Files that the page's users save and open: Gaussians as they are shown, and styles with their photographs."""

import shutil
from dataclasses import replace
from pathlib import Path

from ..rendering.north import bearings_of
from ..splats.files import Capture, write_capture, write_gaussians
from ..splats.gaussians import GaussianRows, Gaussians
from ..splats.scene import SplatScene
from ..style.config import StyleConfig, find_reference, parse_region_value
from ..style.files import StyleFile, write_style
from .looks import Look

SAVED_FORMATS = (".ply", ".spz", ".sog", ".glb")
"""Endings of files of Gaussians that the page saves."""


def write_shown(path: Path, scene: SplatScene, capture: Capture | None, gaussians: Gaussians) -> None:
    """Write Gaussians of a scene, which was read from `capture` or is a run, in colours as they are shown."""
    # Of a capture all but the colours stays as it was in its file.
    if capture is not None:
        write_capture(path, capture, gaussians.harmonics, scene.views)
        return
    bearings = bearings_of(scene.views, scene.north, scene.up)
    rows = GaussianRows(len(gaussians), gaussians.select, scene.antialiased, bearings)
    write_gaussians(path, rows, views=scene.views, plain=True, origin=scene.origin)


def write_style_of(path: Path, look: Look, file: StyleFile) -> None:
    """Write a look as a style.json at `path`, whose folder is made, with copies of its photographs beside it:
    uploads go with the viewer.
    """
    path.parent.mkdir(parents=True)
    references = []
    for k, (photograph, _) in enumerate(look.mix):
        stem = photograph.name.rsplit(".", 1)[0]
        plain = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in stem)
        references.append(path.with_name(f"{k + 1}-{plain or 'photograph'}.png"))
        shutil.copyfile(photograph.path, references[-1])
    # References by their number: those of uploads have names of their own.
    style = file.style
    rules = {}
    for field, texts in (("pin", style.pin), ("forbid", style.forbid)):
        numbered = []
        for text in texts:
            region, named = parse_region_value(field, text)
            numbered.append(f"{region}={find_reference(named, style.references)}")
        rules[field] = tuple(numbered)
    style = replace(style, references=tuple(references), pin=rules["pin"], forbid=rules["forbid"])
    write_style(path, file._replace(style=style))


def controls_of(style: StyleConfig) -> StyleConfig:
    """A style without what a look holds itself, photographs and rules, and without what the page has no control
    for.
    """
    return replace(
        style,
        references=(),
        weights=(),
        masks=(),
        pin=(),
        forbid=(),
        keep=(),
        region_strength=(),
        between=None,
    )
