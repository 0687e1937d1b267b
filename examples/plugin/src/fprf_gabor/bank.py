"""The filters. Letters as in `fprf.types`; F filters, one per wavelength and orientation."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from fprf.interfaces import Encoder

if TYPE_CHECKING:
    from . import GaborConfig

__all__ = ["GaborEncoder", "gabor_pair"]


def gabor_pair(wavelength: float, angle: float, size: int) -> Annotated[Tensor, "2 size size"]:
    """Even and odd filter without response to a flat image, of unit energy; `angle` in radians from the x
    axis.
    """
    reach = torch.arange(size, dtype=torch.float64) - size // 2
    y, x = torch.meshgrid(reach, reach, indexing="ij")
    along = x * math.cos(angle) + y * math.sin(angle)
    envelope = torch.exp(-(x**2 + y**2) / (2 * (0.5 * wavelength) ** 2))
    wave = torch.stack(
        [torch.cos(2 * math.pi * along / wavelength), torch.sin(2 * math.pi * along / wavelength)]
    )
    mean = (envelope * wave).sum((1, 2), keepdim=True) / envelope.sum()
    pair = envelope * (wave - mean)
    return (pair / pair.square().sum((1, 2), keepdim=True).sqrt()).float()


class GaborEncoder(Encoder):
    """The energy of each filter on the image's light, its log for even steps, then the three colours."""

    def __init__(self, config: GaborConfig) -> None:
        super().__init__()
        self._config = config
        size = 2 * math.ceil(1.5 * max(config.wavelengths)) + 1
        angles = [math.pi * k / config.orientations for k in range(config.orientations)]
        bank = [gabor_pair(wavelength, angle, size) for wavelength in config.wavelengths for angle in angles]
        self.register_buffer("bank", torch.cat(bank)[:, None])
        self.eval()

    @property
    def identity(self) -> str:
        """Name and settings: they fix the filters."""
        bands = "-".join(f"{wavelength:g}" for wavelength in self._config.wavelengths)
        return f"gabor:{self._config.orientations}:{bands}:stride{self._config.stride}"

    @property
    def channels(self) -> int:
        """One a filter, and three colours."""
        return len(self._config.wavelengths) * self._config.orientations + 3

    @torch.no_grad()
    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B F+3 h w"]:
        """Log energies in [-1, 1] and centred colours, one cell per stride x stride pixels."""
        bank = self.get_buffer("bank").to(image)
        (height, width) = image.shape[2:]
        margin = bank.shape[-1] // 2
        light = F.pad(image.mean(1, keepdim=True), (margin,) * 4, mode="replicate")
        even, odd = F.conv2d(light, bank).unflatten(1, (-1, 2)).unbind(2)
        # 1e-2 is the response to the noise of an 8-bit image: below it, energy says nothing.
        energy = torch.log10((even.square() + odd.square()).sqrt() + 1e-2).clamp(-2, 0) + 1
        features = torch.cat([energy, 2 * image - 1], 1)
        cells = (math.ceil(height / self._config.stride), math.ceil(width / self._config.stride))
        return F.interpolate(features, cells, mode="area")
