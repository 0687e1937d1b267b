"""The naive path: what everybody writes first. Plain torch for the planes, every sample through every network, every
term at every step. It is what speed is measured against, in the same run and on the same model.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import fields, replace
from typing import Annotated, Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..config import TrainConfig
from ..fields.planes import Planes
from ..ops import backend, triplane
from ..plugins import slots

__all__ = ["grid_sample_lookup", "plain_planes", "replaced", "without_skipping"]


def grid_sample_lookup(
    points: Annotated[Tensor, "N 3"], table: Annotated[Tensor, "rows F"], resolutions: Sequence[int]
) -> Annotated[Tensor, "N scales*F"]:
    """`triplane.lookup` by twelve calls of torch's grid_sample, as K-Planes has it."""
    scales = []
    for planes in triplane.split(table, resolutions):
        product: Tensor | None = None
        for plane, (a, b) in zip(planes, triplane.AXES, strict=True):
            at = torch.stack([points[:, a], points[:, b]], -1)[None, None]
            value = F.grid_sample(plane.permute(2, 0, 1)[None], at, align_corners=True, padding_mode="border")[0, :, 0].T
            product = value if product is None else product * value
        assert product is not None
        scales.append(product)
    return torch.cat(scales, -1)


@contextmanager
def replaced(module: nn.Module, name: str, around: Callable[[Callable[..., Any]], Callable[..., Any]]) -> Iterator[None]:
    """A method of one module wrapped for a while; its class, and every other module, stay as they are."""
    setattr(module, name, around(getattr(module, name)))
    try:
        yield
    finally:
        delattr(module, name)


@contextmanager
def plain_planes(*models: nn.Module) -> Iterator[None]:
    """No compiled kernels at all: grid_sample for lookups, slices for total variation."""
    with backend.plain(), ExitStack() as stack:
        for model in models:
            for module in model.modules():
                if isinstance(module, Planes):
                    stack.enter_context(replaced(module, "forward", _looked_up(module)))
                    stack.enter_context(replaced(module, "variation", _varied(module)))
        yield


def without_skipping(config: TrainConfig) -> TrainConfig:
    """The same training with nothing left out: every sample, every ray's semantics, every term at every step."""
    if any(field.name == "semantic_share" for field in fields(config.datamanager)):
        config = slots.replace(config, "datamanager.semantic_share", 1.0)
    return replace(
        config,
        render=replace(config.render, budget=0.0, train_budget=0.0),
        semantic=replace(config.semantic, samples=10**6),
        loss=replace(config.loss, penalty_every=1),
    )


def _looked_up(planes: Planes) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    return lambda ours: lambda points: grid_sample_lookup(points, planes.table, planes.resolutions)


def _varied(planes: Planes) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    return lambda ours: lambda: triplane.variation_reference(planes.table, planes.resolutions)
