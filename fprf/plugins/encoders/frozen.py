"""What every frozen encoder shares: padding that any size survives, and tensors that no optimiser sees."""

from collections.abc import Mapping, Sequence
from typing import Annotated

import torch.nn.functional as F
from torch import Tensor, nn

__all__ = ["FrozenTensors", "finest", "freeze", "reflect_pad", "replicate_to_multiple", "resize_to_multiple"]


class FrozenTensors(nn.Module):
    """Tensors by the names that they have in their file; they move with the module that holds them."""

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        super().__init__()
        for name, value in tensors.items():
            self.register_buffer(_undotted(name), value)

    def get(self, name: str) -> Tensor | None:
        """The tensor of that name, if there is one."""
        return self._buffers.get(_undotted(name))

    def __getitem__(self, name: str) -> Tensor:
        """Raises KeyError with the name where there is none."""
        value = self.get(name)
        if value is None:
            raise KeyError(name)
        return value

    def __contains__(self, name: str) -> bool:
        return _undotted(name) in self._buffers


def _undotted(name: str) -> str:
    """Modules keep the dot for themselves."""
    return name.replace(".", "/")


def finest(maps: Sequence[Annotated[Tensor, "B C h w"]]) -> list[Tensor]:
    """All at the size of the finest, the others interpolated."""
    size = tuple(max(int(each.shape[axis]) for each in maps) for axis in (2, 3))
    return [
        each if tuple(each.shape[2:]) == size else F.interpolate(each, size, mode="bilinear", align_corners=False)
        for each in maps
    ]


def freeze(module: nn.Module) -> None:
    """Evaluation mode, no gradients to the weights."""
    module.eval()
    module.requires_grad_(False)


def reflect_pad(x: Annotated[Tensor, "B C H W"], margin: int = 1) -> Annotated[Tensor, "B C H+2m W+2m"]:
    """Mirror at the borders; repeat them where an axis is too short to mirror."""
    mirrored = min(x.shape[-2:]) > margin
    return F.pad(x, (margin, margin, margin, margin), mode="reflect" if mirrored else "replicate")


def replicate_to_multiple(x: Annotated[Tensor, "B C H W"], stride: int) -> Tensor:
    """Repeat the last row and column until both axes are multiples of `stride`."""
    right, below = -x.shape[-1] % stride, -x.shape[-2] % stride
    return F.pad(x, (0, right, 0, below), mode="replicate") if right or below else x


def resize_to_multiple(image: Annotated[Tensor, "B 3 H W"], multiple: int) -> Tensor:
    """Resize so that cells of `multiple` pixels cover the image exactly; the image itself where they do."""
    height, width = (max(1, round(n / multiple)) * multiple for n in image.shape[-2:])
    if (height, width) == tuple(image.shape[-2:]):
        return image
    return F.interpolate(image, (height, width), mode="bilinear", align_corners=False)
