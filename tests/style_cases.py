"""Points of three kinds, each with semantics and a style of its own: a scene of them, and references."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from fprf.plugins.stylizers.config import RegionToneConfig
from fprf.style.dictionary import Reference, StyleDictionary, build_dictionary
from fprf.style.scene_style import SceneStyle, scene_style


class Setting(NamedTuple):
    """Points, the scene that they make, and a dictionary of references."""

    content: Tensor
    semantic: Tensor
    scene: SceneStyle
    dictionary: StyleDictionary


def points(n: int = 300, *, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Content [n 6] and semantics [n 4], both far from 0."""
    g = torch.Generator().manual_seed(seed)
    kind = torch.randint(0, 3, (n,), generator=g)
    content = (
        torch.randn(3, 6, generator=g)[kind] * 2 + torch.randn(n, 6, generator=g) * (kind[:, None] + 1) + 5
    )
    return content, torch.eye(3, 4)[kind] * 3 + torch.randn(n, 4, generator=g) * 0.5 + 1


def scene_of(content: Tensor, semantic: Tensor | None, regions: int = 3) -> SceneStyle:
    return scene_style(content, semantic, torch.ones(len(content)), None, regions, 0)


def references(*weights: float) -> list[Reference]:
    return [Reference(f"r{i}", *points(seed=5 + i), weight) for i, weight in enumerate(weights)]


def setting(*weights: float, n: int = 300, clusters: int = 3) -> Setting:
    content, semantic = points(n)
    dictionary = build_dictionary(references(*weights or (1.0, 1.0)), clusters=clusters)
    return Setting(content, semantic, scene_of(content, semantic), dictionary)


def region_adain(**fields: Any) -> RegionToneConfig:
    """Each region's features channel by channel to those of its match, in full."""
    alone = {"features": 1.0, "colours": 0.0, "light": False, "temperature": 0.4, "smoothness": 0.0}
    return RegionToneConfig(**{**alone, **fields})
