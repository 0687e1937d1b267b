"""Scenes and pages that tests of the page share."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from fprf.io.images import to_uint8
from fprf.page.writer import Page, PageView, Reference, Style, write_page
from fprf.plugins.encoders.config import BundledSemanticConfig
from fprf.splats.captures import look_at_capture
from fprf.splats.config import LookConfig
from fprf.splats.gaussians import Gaussians
from fprf.splats.scene import SplatScene


def seen(gaussians: Gaussians, antialiased: bool = True, views: int = 4) -> SplatScene:
    config = LookConfig(views=views, size=(96, 72), inside=False)
    return look_at_capture(gaussians, antialiased, BundledSemanticConfig().build(), config)


def street(count: int = 4000) -> Gaussians:
    """Flat and long Gaussians from a tenth of a unit to a thousand units away, faint and opaque."""
    draw = torch.Generator().manual_seed(1)
    around = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw), dim=1)
    far = torch.exp(torch.rand(count, 1, generator=draw) * 6 - 1)
    sizes = far.log() - 3.2 + torch.randn(count, 3, generator=draw) * torch.tensor([0.5, 0.5, 1.5])
    harmonics = 0.1 * torch.randn(count, 9, 3, generator=draw)
    harmonics[:, 0] += 1.2 * torch.rand(count, 3, generator=draw) - 0.4
    return Gaussians(
        around * far,
        torch.randn(count, 4, generator=draw),
        sizes,
        2 * torch.randn(count, generator=draw),
        harmonics,
    )


def recoloured(gaussians: Gaussians) -> torch.Tensor:
    """Harmonics after two affine maps of colours, above and below."""
    maps = torch.tensor(
        [
            [[0.2, 0.1, 0.6], [0.1, 0.2, 0.3], [0.5, 0.3, 0.2]],
            [[0.9, 0.0, 0.1], [0.2, 0.7, 0.0], [0.0, 0.1, 1.1]],
        ]
    )
    return torch.einsum("nkc,ncd->nkd", gaussians.harmonics, maps[(gaussians.means[:, 1] > 0).long()])


def page_of(scene: SplatScene, **changes: Any) -> Page:
    drawn = [to_uint8(scene.render(scene.cameras, view).rgb) for view in range(2)]
    gaussians = scene.gaussians
    filled: dict[str, Any] = {
        "title": "Ball",
        "facts": {"Gaussians": len(gaussians)},
        "views": [PageView("00", drawn[0]), PageView("01", drawn[1], drawn[0])],
        "styles": [
            Style("dusk", drawn[:1], recoloured(gaussians), ["city"]),
            Style("plain", drawn[:1], gaussians.harmonics),
        ],
        "references": [Reference("city", np.full((30, 40, 3), 90, np.uint8))],
        "scene": scene,
    }
    return Page(**{**filled, **changes})


def written(path: Path, scene: SplatScene, **changes: Any) -> Path:
    write_page(path, page_of(scene, **changes))
    return path
