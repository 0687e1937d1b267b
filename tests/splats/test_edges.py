"""Semantics of Gaussians at edges: thin things before the sky, and the sky between them."""

from typing import Annotated

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from fprf.interfaces import Encoder
from fprf.ops.harmonics import HARMONIC
from fprf.rendering.cameras import Cameras
from fprf.splats.gaussians import Gaussians
from fprf.splats.semantics import find_semantics
from fprf.style.scene_style import Membership

CELL = 16
"""Pixels of a side of the encoder's cells; bars are four wide, and as much sky lies between two."""
BRIGHT = (0.7, 0.8, 0.9)
DARK = (0.2, 0.15, 0.1)


class SkyShare(Encoder):
    """Share of a cell that is bright, and its complement: what a perfect encoder says of so large a cell."""

    @property
    def identity(self) -> str:
        return "sky-share"

    @property
    def channels(self) -> int:
        return 2

    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B C h w"]:
        bright = (image.mean(1, keepdim=True) > 0.45).float()
        share = F.avg_pool2d(bright, CELL)
        return torch.cat([share, 1 - share], 1)


def plane(x: Tensor, y: Tensor, depth: float, size: float, colour: tuple[float, float, float]) -> Gaussians:
    """Opaque Gaussians at x, y in units of the image's width at a depth, as many as there are."""
    count = len(x)
    means = torch.stack([x * depth, y * depth, torch.full_like(x, depth)], 1)
    scales = torch.full((count, 3), size * depth).log()
    harmonics = (torch.tensor(colour).expand(count, 1, 3) - 0.5) / HARMONIC
    turns = torch.tensor([1.0, 0, 0, 0]).expand(count, 4)
    return Gaussians(means, turns.clone(), scales, torch.full((count,), 6.0), harmonics.clone())


def grid(left: float, right: float, top: float, bottom: float, step: float) -> tuple[Tensor, Tensor]:
    """Positions of a regular grid, flattened."""
    x = torch.arange(left + step / 2, right, step)
    y = torch.arange(top + step / 2, bottom, step)
    across, down = torch.meshgrid(x, y, indexing="xy")
    return across.flatten(), down.flatten()


def crown() -> tuple[Gaussians, Tensor, Tensor]:
    """Dark bars in the left half before a bright sky far behind, a dark ground below: Gaussians, which are sky,
    and which lie far from any edge.
    """
    pixel = 1 / 128
    sky_x, sky_y = grid(-0.6, 0.6, -0.5, 0.5, 2 * pixel)
    parts = [plane(sky_x, sky_y, 40.0, pixel, BRIGHT)]
    for bar in range(-56, 0, 8):
        x, y = grid(bar * pixel, (bar + 4) * pixel, -0.3, 0.2, pixel)
        parts.append(plane(x, y, 4.0, 0.5 * pixel, DARK))
    ground_x, ground_y = grid(-0.6, 0.6, 0.2, 0.5, pixel)
    parts.append(plane(ground_x, ground_y, 4.0, 0.5 * pixel, DARK))
    every = joined(parts)
    sky = torch.arange(len(every)) < len(sky_x)
    x, y, depth = every.means.unbind(1)
    interior = (sky & (x / depth > 0.2) & (y / depth < 0.0)) | (~sky & (y / depth > 0.35))
    return every, sky, interior


def joined(parts: list[Gaussians]) -> Gaussians:
    """All Gaussians of several."""
    return Gaussians(
        means=torch.cat([part.means for part in parts]),
        quaternions=torch.cat([part.quaternions for part in parts]),
        log_scales=torch.cat([part.log_scales for part in parts]),
        logits=torch.cat([part.logits for part in parts]),
        harmonics=torch.cat([part.harmonics for part in parts]),
    )


def views(count: int = 5) -> Cameras:
    """Cameras side by side that look along +z, of 128 x 96 pixels."""
    pose = torch.eye(3, 4, dtype=torch.float64).repeat(count, 1, 1)
    pose[:, 1, 1] = -1
    pose[:, 2, 2] = -1
    pose[:, 0, 3] = torch.linspace(-0.3, 0.3, count)
    return Cameras(
        pose=pose,
        focal=torch.full((count, 2), 128.0, dtype=torch.float64),
        centre=torch.tensor([64.0, 48.0], dtype=torch.float64).repeat(count, 1),
        size=torch.tensor([128, 96]).repeat(count, 1),
        distortion=torch.zeros(count, 6, dtype=torch.float64),
        lens=torch.zeros(count, dtype=torch.int64),
    )


@pytest.fixture(scope="module")
def found() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Share of sky of each Gaussian, which are sky, which lie inside, and which are seen."""
    gaussians, sky, interior = crown()
    semantics = find_semantics(gaussians, False, SkyShare(), views(), 2, near=0.01)
    belongs = Membership(semantics.style.keys, semantics.style.semantic_mean)(semantics.features.float())
    return belongs, sky, interior, gaussians.means


def test_bars_are_their_own_region_and_the_sky_between_them_is_sky(
    found: tuple[Tensor, Tensor, Tensor, Tensor],
) -> None:
    belongs, sky, interior, means = found
    region = belongs.argmax(1)
    bright = int(region[sky & interior].mode().values)
    x, y = (means[:, :2] / means[:, 2:]).unbind(1)
    bars = ~sky & (y < 0.15)
    between = sky & (x > -0.4) & (x < -0.05) & (y > -0.25) & (y < 0.15)
    assert float((region[bars] != bright).float().mean()) > 0.97
    # What lies behind bars in all views takes what is near to it.
    assert float((region[between] == bright).float().mean()) > 0.9


def test_what_lies_inside_of_a_region_is_wholly_of_it(found: tuple[Tensor, Tensor, Tensor, Tensor]) -> None:
    belongs, sky, interior, _ = found
    bright = int(belongs[sky & interior].sum(0).argmax())
    assert float(belongs[sky & interior, bright].min()) > 0.99
    assert float(belongs[~sky & interior, 1 - bright].min()) > 0.99
