"""Compare a device with the CPU on a tiny scene of seeded numbers: no files, no network, a few seconds.

The expected values are computed by plain torch on the CPU, so on the CPU its compiled kernels are compared
with them.
"""

import math
from collections.abc import Iterator
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..config import ContentConfig, RenderConfig, SemanticConfig, TrainConfig
from ..fields.config import PlanesConfig, SemanticPlanesConfig
from ..memory import free_memory
from ..ops import backend, dense, triplane
from ..ops.backend import double, float32_convolutions
from ..plugins.encoders.config import BundledContentConfig
from ..plugins.samplers.config import ProposalConfig
from ..plugins.stylizers.config import RegionToneConfig
from ..rendering.cameras import Cameras
from ..rendering.paths import look_at, pinhole
from ..rendering.renderer import TrainingStep, render_rays
from ..rendering.space import Space
from ..style.dictionary import Reference, build_dictionary
from ..style.look import Restyle, colour_maps
from ..style.scene_style import scene_style
from ..types import Want
from .facts import Facts, FieldFacts
from .model import Model, build_model
from .views import render_view, view_rays

_SEMANTIC_CHANNELS = 8
"""Of the tiny scene."""
_KINDS = 4
"""Kinds of things in it, each with semantics of its own."""
_MAX_ERRORS = {"encoder": 1e-4, "training step": 2e-3, "render": 1e-3, "restyle": 4e-3}
"""Of colours a quarter of an 8-bit step, of a style, which is made of what encoders say, a whole one; of the
others by eye.
"""


class Outcome(NamedTuple):
    """One result that was computed on both."""

    what: str
    error: float
    """Largest absolute difference of colours in [0, 1]; of features and gradients the relative L2 error."""
    allowed: float

    @property
    def right(self) -> bool:
        """True where the error is within the tolerance."""
        return self.error <= self.allowed


def compare(device: torch.device) -> list[Outcome]:
    """Features, gradients, a render and a restyle on a device, against plain torch on the CPU."""
    # Plain torch on the CPU is what everything else is measured by.
    with backend.plain():
        expected = _computed(torch.device("cpu"))
    computed = _computed(device)
    outcomes = []
    for what, allowed in _MAX_ERRORS.items():
        away = double(computed[what].cpu()) - double(expected[what])
        like = double(expected[what])
        error = float(away.abs().max() if what in ("render", "restyle") else away.norm() / like.norm())
        outcomes.append(Outcome(what, math.inf if math.isnan(error) else error, allowed))
    return outcomes


def fast_paths(device: torch.device) -> Iterator[tuple[str, str]]:
    """Name and description of the kernels and the precision that a device uses, and of its free memory."""
    # Where the networks are compiled, everything is.
    probe = torch.zeros(1, 3, device=device)
    with torch.no_grad():
        compiled = dense.usable(probe)
    if compiled:
        yield "kernels", "numba's: tri-planes, networks, guided filter"
    elif triplane.triton_usable(probe, probe):
        yield "kernels", "Triton's: tri-planes; all else by torch"
    else:
        yield "kernels", "none: everything by torch"
    if device.type == "cuda":
        if torch.get_float32_matmul_precision() == "highest":
            products = "float32"
        else:
            products = "TF32"
        yield "precision", f"matrix products in {products}, convolutions of encoders in float32"
    free = free_memory(device)
    if free is not None:
        yield "device memory", f"{free / 2**30:.1f} GiB free"


def _computed(device: torch.device) -> dict[str, Tensor]:
    """The results to compare, by name, computed on the device."""
    # A scene of seeded numbers with every part of a large one, and a camera in it.
    encoder = BundledContentConfig().build()
    config = TrainConfig(
        sampler=ProposalConfig(samples=(16,), final=8, resolutions=(8,)),
        content=ContentConfig(
            encoder=BundledContentConfig(),
            field=PlanesConfig(resolutions=(8, 16), channels=8, hidden=32, layers=1),
        ),
        semantic=SemanticConfig(
            field=SemanticPlanesConfig(resolutions=(8,), channels=8, hidden=16, layers=1),
            dim=_SEMANTIC_CHANNELS,
        ),
        render=RenderConfig(budget=0.0),
    )
    axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    space = Space(kind="contraction", centre=(0.0, 0.0, 0.0), rotation=axes, scale=1.0, near=0.1, far=100.0)
    of_field = FieldFacts(channels=encoder.channels, dim=_SEMANTIC_CHANNELS, content_encoder=encoder.identity)
    facts = Facts(space=space, field=of_field)
    model = build_model(config, facts).to(device)
    place = torch.tensor([(0.0, -0.4, 0.1)], dtype=torch.float64)
    target = torch.tensor([(0.1, 0.5, 0.0)], dtype=torch.float64)
    up = torch.tensor([(0.0, 0.0, 1.0)], dtype=torch.float64)
    cameras = pinhole(look_at(place, target, up[0]), width=32, height=24, fov=60.0)
    # Features of a picture, a step of training, and the view as it is and in the picture's style.
    encoder = encoder.to(device)
    image = _uniform(3, 48, 64).to(device)
    with torch.no_grad(), float32_convolutions(device):
        features: Tensor = encoder(image[None])[0]
    results = {"encoder": features, "training step": _gradients(model, cameras, image)}
    model.requires_grad_(False).eval()
    look = _restyle(model, features.flatten(1).T, image)
    for name, restyle in (("render", None), ("restyle", look)):
        results[name] = render_view(model, facts, cameras, 0, config.render, restyle).rgb
    return results


def _gradients(model: Model, cameras: Cameras, image: Annotated[Tensor, "3 H W"]) -> Annotated[Tensor, "P"]:
    """Flat gradients of colour, content and semantic terms after one step of gradient descent."""
    rays, _, _ = view_rays(model, cameras, 0)
    learned = model.learned()
    gradients: list[Tensor] = []
    for _ in range(2):
        out = render_rays(
            rays,
            model.parts,
            want=Want.COLOUR | Want.CONTENT | Want.SEMANTIC,
            budget=0.0,
            training=TrainingStep(step=0),
        )
        assert out.rgb is not None and out.content is not None and out.semantic is not None
        target = torch.nn.functional.interpolate(image[None], (24, 32))[0].flatten(1).T
        loss = (
            (out.rgb - target).square().mean()
            + (out.content - 0.1).square().mean()
            + (out.semantic - 0.1).square().mean()
        )
        gradients = list(torch.autograd.grad(loss, learned, allow_unused=True, materialize_grads=True))
        # A plain step, so that the second gradient depends on the first one.
        with torch.no_grad():
            for parameter, gradient in zip(learned, gradients, strict=True):
                parameter.sub_(gradient, alpha=0.1)
    parts = []
    for gradient in gradients:
        parts.append(gradient.reshape(-1))
    return torch.cat(parts)


@torch.no_grad()
def _restyle(model: Model, features: Annotated[Tensor, "N C"], image: Annotated[Tensor, "3 H W"]) -> Restyle:
    """The style of the picture for points with its features, scaled and shifted; both have a few distinct
    classes.
    """
    kinds = torch.arange(len(features), device=features.device) % _KINDS
    semantic = torch.nn.functional.one_hot(kinds, _SEMANTIC_CHANNELS).float() + 0.05 * _uniform(
        len(features), _SEMANTIC_CHANNELS
    ).to(features)
    colour = torch.nn.functional.interpolate(image[None], (24, 32), mode="area")[0].flatten(1).T
    dictionary = build_dictionary([Reference("picture", features, semantic, colour=colour)], clusters=_KINDS)
    scene = scene_style(0.5 * features + 0.2, semantic, torch.ones_like(features[:, 0]), None, _KINDS, 0)
    chosen = RegionToneConfig()
    stylizer = chosen.build(dictionary=dictionary, scene=scene).to(features.device)
    colours = colour_maps(
        stylizer, dictionary, scene, model.decoder, features=chosen.features, share=chosen.colours
    )
    return Restyle(
        stylizer, features=chosen.features, colours=None if colours is None else colours.to(features.device)
    )


def _uniform(*shape: int) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(3))
