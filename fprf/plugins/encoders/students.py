"""The small networks that `fprf pretrain` trains and the package ships. Input is sRGB in [0, 1], output unbounded."""

from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .frozen import reflect_pad, replicate_to_multiple

__all__ = ["ContentStudent", "SemanticStudent"]


class ContentStudent(nn.Module):
    """2x2 pixels to channels, two 3x3 convolutions, a projection: stride 2, the 10 pixels that VGG-19 relu2_1 sees.

    Half the arithmetic of a slim VGG with its convolutions at full size, and as good after the same time of training.
    """

    def __init__(self, channels: int, widths: tuple[int, int] = (80, 96)) -> None:
        super().__init__()
        self.first = nn.Conv2d(12, widths[0], 3)
        self.second = nn.Conv2d(widths[0], widths[1], 3)
        self.project = nn.Conv2d(widths[1], channels, 1)

    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B C h w"]:
        """Features at half the size, rounded up."""
        x = F.pixel_unshuffle(4 * replicate_to_multiple(image, 2) - 2, 2)
        x = F.relu(self.first(reflect_pad(x)))
        x = F.relu(self.second(reflect_pad(x)))
        result: Tensor = self.project(x)
        return result


class SemanticStudent(nn.Module):
    """Inverted residuals at strides 8 and 16 with wide dilations and a view of the whole image, merged at stride 8."""

    def __init__(self, channels: int, widths: tuple[int, int, int, int] = (24, 48, 96, 160), rounds: int = 2) -> None:
        super().__init__()
        half, quarter, fine, coarse = widths
        self.stem = nn.Sequential(_ConvNorm(3, half, 3, stride=2), _ConvNorm(half, quarter, 3, stride=2))
        self.fine = nn.Sequential(_ConvNorm(quarter, fine, 3, stride=2), _Residual(fine, 1), _Residual(fine, 2))
        self.coarse = nn.Sequential(
            _ConvNorm(fine, coarse, 3, stride=2), *(_Residual(coarse, dilation) for dilation in rounds * (1, 2, 4))
        )
        self.whole = nn.Linear(coarse, coarse)
        self.merge = nn.Sequential(_ConvNorm(fine + coarse, fine, 1), _Residual(fine, 1))
        self.project = nn.Conv2d(fine, channels, 1)

    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B C h w"]:
        """Features at an eighth of the size, rounded up."""
        fine = self.fine(self.stem(4 * image - 2))
        coarse = self.coarse(fine)
        coarse = F.relu(coarse + self.whole(coarse.mean(dim=(2, 3)))[:, :, None, None])
        coarse = F.interpolate(coarse, fine.shape[-2:], mode="bilinear", align_corners=False)
        result: Tensor = self.project(self.merge(torch.cat([fine, coarse], dim=1)))
        return result


class _ConvNorm(nn.Module):
    """Convolution, batch normalisation, ReLU."""

    def __init__(self, inputs: int, outputs: int, size: int, *, stride: int = 1, dilation: int = 1, groups: int = 1) -> None:
        super().__init__()
        padding = dilation * (size // 2)
        self.conv = nn.Conv2d(inputs, outputs, size, stride, padding, dilation, groups, bias=False)
        self.norm = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.norm(self.conv(x)))


class _Residual(nn.Module):
    """Widen twofold, filter each channel in its own 3x3 window, narrow, add."""

    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.widen = _ConvNorm(width, 2 * width, 1)
        self.filter = _ConvNorm(2 * width, 2 * width, 3, dilation=dilation, groups=2 * width)
        self.narrow = nn.Conv2d(2 * width, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        result: Tensor = x + self.narrow(self.filter(self.widen(x)))
        return result
