"""Teachers averaged over scales and mirror images: steadier, and finer than their stride, than any single look.

On the matching of 40 pairs of photographs two MobileNetV2s so averaged find the right region in 83 % of the cells where the
better of them alone finds it in 77 % (per-region mean, regions of 40 cells and more).
"""

from collections.abc import Sequence
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from .basis import Basis, fit_basis
from .teachers import MobileNetTeacher

__all__ = ["COMPONENTS", "Ensemble", "look", "semantic_ensemble", "taught"]

COMPONENTS = 32
"""Principal components kept of each teacher."""
LOOKS = (0.75, 1.0)
"""Sizes at which a teacher sees an image."""
Ensemble = Sequence[tuple[MobileNetTeacher, Basis]]


@torch.no_grad()
def look(teacher: MobileNetTeacher, images: Annotated[Tensor, "B 3 H W"], stride: int) -> Annotated[Tensor, "B F h w"]:
    """Mean of a teacher's features over scales and mirror images, one per `stride` pixels, rounded up, on its device."""
    images = images.to(teacher.device)
    cells = [-(-n // stride) for n in images.shape[-2:]]
    total: Tensor | float = 0.0
    for scale in LOOKS:
        size = [max(1, round(n * scale)) for n in images.shape[-2:]]
        seen = F.interpolate(images, size, mode="bilinear", align_corners=False, antialias=scale < 1)
        both = teacher(seen) + teacher(seen.flip(-1)).flip(-1)
        total = total + F.interpolate(both, cells, mode="bilinear", align_corners=False)
    assert isinstance(total, Tensor)
    return total / (2 * len(LOOKS))


def semantic_ensemble(
    teachers: Sequence[MobileNetTeacher], images: Sequence[Annotated[Tensor, "3 H W"]], stride: int
) -> Ensemble:
    """The principal components of each teacher; each is scaled to unit variance per channel, so that all weigh the same."""
    samples = [[look(teacher, image[None], stride).flatten(2)[0].T for image in images] for teacher in teachers]
    return [
        (teacher, fit_basis(torch.cat(found), (COMPONENTS,), 1.0)) for teacher, found in zip(teachers, samples, strict=True)
    ]


def taught(ensemble: Ensemble, images: Annotated[Tensor, "B 3 H W"], stride: int) -> Annotated[Tensor, "B C h w"]:
    """What the teachers say together: their components, one after the other."""
    return torch.cat([basis.project(look(teacher, images, stride)) for teacher, basis in ensemble], dim=1)
