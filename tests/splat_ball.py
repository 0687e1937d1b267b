"""A capture that a test can make: a ball of Gaussians, its upper half of another colour."""

import torch

from fprf.splats.files.ply import Ply
from fprf.splats.gaussians import HARMONIC, Gaussians


def equal(a: Gaussians, b: Gaussians) -> bool:
    """True where all numbers are the same."""
    return all(map(torch.equal, vars(a).values(), vars(b).values()))


def ball(count: int, degree: int = 1, seed: int = 0) -> Gaussians:
    """Opaque Gaussians within a unit ball; y points down. Green and rough above, grey and even below."""
    draw = torch.Generator().manual_seed(seed)
    means = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw), dim=1)
    means = means * torch.rand(count, 1, generator=draw) ** (1 / 3)
    above = (means[:, 1:2] < 0).float()
    colour = above * torch.tensor([0.2, 0.6, 0.1]) + (1 - above) * torch.tensor([0.5, 0.5, 0.55])
    colour = colour + 0.1 * (1 + 2 * above) * (torch.rand(count, 3, generator=draw) - 0.5)
    harmonics = 0.02 * torch.randn(count, (degree + 1) ** 2, 3, generator=draw)
    harmonics[:, 0] = (colour - 0.5) / HARMONIC
    turns = torch.randn(count, 4, generator=draw)
    sizes = -1.8 + 0.3 * torch.rand(count, 3, generator=draw)
    return Gaussians(means, turns, sizes, torch.full((count,), 3.0), harmonics)


def plain_ply(gaussians: Gaussians) -> bytes:
    """The INRIA file of Gaussians."""
    return b"".join(Ply().pack(gaussians, False, (0.0, 0.0, 0.0)))
