"""MobileNetV2 (Sandler et al.), trained by TensorFlow: what the semantic encoder's teachers are.

Where a feature looks depends on the parity that a network was trained with: on even sizes its filters have
learned to make up for the half pixel that a stride-2 convolution is off; on odd ones (DeepLab's 513) cells
are centred on every s-th pixel, so the image is shifted by half a cell and the first and last cells are
dropped. Measured by mirroring.
"""

import math
from collections.abc import Mapping
from typing import Annotated, NamedTuple

import torch.nn.functional as F
from torch import Tensor, nn

TENSORFLOW_EPS = 1e-3
"""Of batch normalisation."""


class Layout(NamedTuple):
    """Differences between the classifier and DeepLab's backbone."""

    strides: tuple[int, ...]
    """Of blocks 1 to 17."""
    dilated: int
    """First block whose depthwise convolution has holes."""
    odd: bool
    """Trained on odd sizes."""


CLASSIFIER = Layout((1, 2, 1, 2, 1, 1, 2, 1, 1, 1, 1, 1, 1, 2, 1, 1, 1), dilated=18, odd=False)
DEEPLAB = Layout((1, 2, 1, 2, 1, 1, 2, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1), dilated=15, odd=True)


class MobileNetV2(nn.Module):
    """Inverted residual blocks 0..`last` (at most 17) on folded weights `N.conv...{weight,bias}`.

    Takes multiples of the stride of `last`.
    """

    def __init__(self, folded: Mapping[str, Tensor], *, layout: Layout, last: int) -> None:
        super().__init__()
        self._layout = layout
        self._last = last
        for name, value in folded.items():
            if int(name.partition(".")[0]) <= last:
                self.register_buffer(name.replace(".", "/"), value)  # modules keep the dot for themselves

    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B F h w"]:
        """Features of sRGB images in [0, 1]: linear after a block, in [0, 6] after the first convolution."""
        x = (image - 0.5) / 0.5
        if self._layout.odd:
            stride = 2 * math.prod(self._layout.strides[: self._last])
            before = stride // 2
            after = stride // 2 + 1
            x = F.pad(x, (before, after, before, after), mode="replicate")
        x = self._convolve(x, "0.0", stride=2).clamp(0, 6)
        for block in range(1, self._last + 1):
            stride = self._layout.strides[block - 1]
            dilation = 2 if block >= self._layout.dilated else 1
            y = x
            at = 0
            if block > 1:
                y = self._convolve(y, f"{block}.conv.0.0").clamp(0, 6)
                at = 1
            y = self._convolve(
                y, f"{block}.conv.{at}.0", stride=stride, dilation=dilation, groups=y.shape[1]
            ).clamp(0, 6)
            y = self._convolve(y, f"{block}.conv.{at + 1}")
            x = x + y if stride == 1 and x.shape == y.shape else y
        return x[:, :, 1:-1, 1:-1] if self._layout.odd else x

    def _convolve(self, x: Tensor, name: str, stride: int = 1, dilation: int = 1, groups: int = 1) -> Tensor:
        """TensorFlow's padding: as little as gives every stride-th pixel an output, the odd one after."""
        weight, bias = (self.get_buffer(f"{name}.{part}".replace(".", "/")) for part in ("weight", "bias"))
        reach = (weight.shape[-1] - 1) * dilation
        pads = []
        for n in (x.shape[3], x.shape[2]):
            total = max((-(-n // stride) - 1) * stride + reach + 1 - n, 0)
            pads += [total // 2, total - total // 2]
        return F.conv2d(F.pad(x, pads), weight, bias, stride, 0, dilation, groups)


def fold(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Batch normalisation, one place after its convolution, into it; convolutions with a bias of their own
    stay.
    """
    folded = {}
    for key, weight in tensors.items():
        name = key.removeprefix(prefix).removesuffix(".weight")
        place, _, number = name.rpartition(".")
        if key != f"{prefix}{name}.weight" or weight.ndim != 4 or not (number + place[:1]).isdecimal():
            continue
        norm = f"{prefix}{place}.{int(number) + 1}"
        if f"{norm}.running_var" in tensors:
            gain = tensors[f"{norm}.weight"] / (tensors[f"{norm}.running_var"] + TENSORFLOW_EPS).sqrt()
            folded[f"{name}.weight"] = weight * gain.view(-1, 1, 1, 1)
            folded[f"{name}.bias"] = tensors[f"{norm}.bias"] - tensors[f"{norm}.running_mean"] * gain
        else:
            folded[f"{name}.weight"], folded[f"{name}.bias"] = weight, tensors[f"{prefix}{name}.bias"]
    return folded
