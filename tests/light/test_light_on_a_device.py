"""Surfaces and light of tensors on a device: what the CPU gives, on the device."""

import math
from collections.abc import Callable

import pytest
import torch
from pretend_cuda import pretend_cuda
from torch import Tensor

from fprf.light.surfaces import Surfaces, find_surfaces
from fprf.light.transport import Blockers, covariances_of, frame_of, openness, transport
from fprf.ops import backend
from fprf.ops.rasterise.rendering import Pinhole

UP = torch.tensor([0.0, 0.0, 1.0])
DEVICE = "cuda:0"


def above() -> Pinhole:
    """A camera three units above the origin, which looks straight down."""
    world = torch.eye(4, dtype=torch.float64)
    world[:3, :3] = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    world[2, 3] = 3.0
    return Pinhole(torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]), world, 48, 32, 0.1)


def surfaces(place: Callable[[Tensor], Tensor]) -> Surfaces:
    draw = torch.Generator().manual_seed(0)
    means = torch.rand(300, 3, generator=draw) * torch.tensor([3.0, 2.0, 0.1]) - torch.tensor([1.5, 1.0, 0.0])
    turns = torch.tensor([1.0, 0, 0, 0]).repeat(300, 1)
    sizes = torch.full((300, 3), math.log(0.06))
    parts = (means, turns, sizes, torch.full((300,), 3.0))
    return find_surfaces(*map(place, parts), [above()], up=place(UP))


def light(place: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
    draw = torch.Generator().manual_seed(1)
    means = torch.rand(200, 3, generator=draw)
    turns = torch.nn.functional.normalize(torch.randn(200, 4, generator=draw), dim=1)
    covariances = covariances_of(turns, torch.full((200, 3), math.log(0.05)))
    blockers = Blockers(*map(place, (means, covariances, torch.full((200,), 0.8))))
    points = place(torch.rand(50, 3, generator=draw))
    normals = place(UP.repeat(50, 1))
    near = place(torch.full((50,), 0.01))
    reached = transport(blockers, points, frame_of(torch.tensor([0.3, 0.1, 1.0])), near, near)
    return reached, openness(blockers, points, normals, place(UP), near, near)


@pytest.mark.parametrize("find", [surfaces, light])
def test_what_a_device_is_asked_is_what_the_cpu_says(find: Callable[..., tuple[Tensor, ...]]) -> None:
    with backend.plain():
        here = find(lambda x: x)
    with pretend_cuda():
        there = find(lambda x: x.to(DEVICE))
        for one, other in zip(here, there, strict=True):
            assert other.device == torch.device(DEVICE)
            assert torch.equal(one, other.cpu())
