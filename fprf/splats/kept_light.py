"""The light on a scene as it was found, kept from one command to the next: surfaces, openness, the sky and the captured
sun, in the cache, by the content of Gaussians and views.
"""

import hashlib
import os
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path

import torch
from torch import Tensor

from ..errors import CheckpointError
from ..io.cache import forget_oldest
from ..io.tensorfiles import load_sealed, save_kept
from ..light.captured import CapturedSun
from ..light.surfaces import Surfaces
from ..rendering.cameras import Cameras
from .find_light import blockers_of, find_illumination
from .gaussians import Gaussians
from .relighting import Illumination

_LIGHT_CACHE_VERSION = 6
"""Of what is found: it counts up whenever the same scene gives something else."""
_MAX_KEPT_SCENES = 24
"""Scenes of which the cache keeps it, 56 bytes a Gaussian each."""
_PARTS = ("spread", "openness", "far", "sky", "heights", "up", "ahead")
"""Fields of an illumination that are kept beside its surfaces."""


def kept_illumination(
    folder: Path,
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    antialiased: bool,
    near: float,
    up: tuple[float, float, float] | None = None,
) -> Illumination:
    """Surfaces, openness, the sky and the captured sun from a folder of the cache, else found and kept there;
    arguments as those of `find_illumination`.
    """
    path = folder / f"{_key(gaussians, cameras, antialiased, near, up)}.safetensors"
    known = _read(path, gaussians)
    if known is not None:
        return known
    found = find_illumination(gaussians, cameras, antialiased=antialiased, near=near, up=up)
    found = replace(found, known_sun=(found.captured_sun,))
    tensors = {name: getattr(found, name) for name in _PARTS} | found.surfaces._asdict()
    if found.captured_sun is not None:
        sun = found.captured_sun
        tensors["sun"] = torch.tensor([sun.azimuth, sun.elevation, sun.explained, *sun.strength.tolist()])
    if save_kept(path, tensors):
        forget_oldest(folder, _MAX_KEPT_SCENES)
    return found


def _key(
    gaussians: Gaussians,
    cameras: Cameras,
    antialiased: bool,
    near: float,
    up: tuple[float, float, float] | None,
) -> str:
    """A name that follows from all that is looked at."""
    known = "" if up is None else f" {up}"
    digest = hashlib.sha256(f"{_LIGHT_CACHE_VERSION} {antialiased} {near!r}{known}".encode())
    shape = [
        gaussians.means,
        gaussians.quaternions,
        gaussians.log_scales,
        gaussians.logits,
        gaussians.colours,
    ]
    views = [getattr(cameras, field.name) for field in fields(Cameras)]
    for tensor in (*shape, *views):
        if isinstance(tensor, Tensor):
            digest.update(f"{tensor.dtype} {tuple(tensor.shape)}".encode())
            digest.update(tensor.detach().cpu().contiguous().numpy().data)
        else:
            digest.update(repr(tensor).encode())
    return digest.hexdigest()[:32]


def _read(path: Path, gaussians: Gaussians) -> Illumination | None:
    """Content of a file of the cache; None where there is none, or none sound."""
    if not os.path.isfile(path):  # False also where the folder is closed to us
        return None
    try:
        kept = load_sealed(path)
        surfaces = Surfaces(*(kept[name] for name in Surfaces._fields))
        spread, openness, far, sky, heights, up, ahead = (kept[name] for name in _PARTS)
    except (CheckpointError, KeyError):
        return None
    with suppress(OSError):  # another process may just have removed it
        os.utime(path)
    sun = None
    if "sun" in kept:
        azimuth, elevation, explained = kept["sun"][:3].tolist()
        sun = CapturedSun(azimuth, elevation, explained, kept["sun"][3:])
    return Illumination(
        surfaces,
        blockers_of(gaussians, far),
        spread,
        openness,
        far,
        sky,
        heights,
        up,
        ahead,
        gaussians.colours,
        known_sun=(sun,),
    )
