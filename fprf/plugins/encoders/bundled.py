"""The encoders that ship, others distilled by `tools.distil` of the repository, and untrained
convolutions.
"""

from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from ...errors import WeightsError
from ..weights import read_weights, tensors_hash
from .frozen import FrozenEncoder, freeze, reflect_pad, replicate_to_multiple


class ContentStudent(nn.Module):
    """2x2 pixels to channels, two 3x3 convolutions, a projection: stride 2, the 10 pixels that VGG-19 relu2_1
    sees.

    Half the arithmetic of a slim VGG with its convolutions at full size, and as good after the same time of
    training.
    """

    def __init__(self, channels: int, widths: tuple[int, int] = (80, 96)) -> None:
        super().__init__()
        self.first = nn.Conv2d(12, widths[0], 3)
        self.second = nn.Conv2d(widths[0], widths[1], 3)
        self.project = nn.Conv2d(widths[1], channels, 1)

    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B C h w"]:
        """Features at half the size, rounded up."""
        # 2x2 pixels become channels, colours of about [-2, 2].
        x = F.pixel_unshuffle(4 * replicate_to_multiple(image, 2) - 2, 2)
        x = F.relu(self.first(reflect_pad(x)))
        x = F.relu(self.second(reflect_pad(x)))
        result: Tensor = self.project(x)
        return result


class SemanticStudent(nn.Module):
    """Inverted residuals at strides 8 and 16 with wide dilations and a view of the whole image, merged at
    stride 8.
    """

    def __init__(
        self, channels: int, widths: tuple[int, int, int, int] = (24, 48, 96, 160), rounds: int = 2
    ) -> None:
        super().__init__()
        half, quarter, fine, coarse = widths
        self.stem = nn.Sequential(_ConvNorm(3, half, 3, stride=2), _ConvNorm(half, quarter, 3, stride=2))
        self.fine = nn.Sequential(
            _ConvNorm(quarter, fine, 3, stride=2), _Residual(fine, 1), _Residual(fine, 2)
        )
        self.coarse = nn.Sequential(
            _ConvNorm(fine, coarse, 3, stride=2),
            *(_Residual(coarse, dilation) for dilation in rounds * (1, 2, 4)),
        )
        self.whole = nn.Linear(coarse, coarse)
        self.merge = nn.Sequential(_ConvNorm(fine + coarse, fine, 1), _Residual(fine, 1))
        self.project = nn.Conv2d(fine, channels, 1)

    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B C h w"]:
        """Features at an eighth of the size, rounded up."""
        fine = self.fine(self.stem(4 * image - 2))
        # Stride 16, with the mean over the whole image added; then both strides together.
        coarse = self.coarse(fine)
        coarse = F.relu(coarse + self.whole(coarse.mean(dim=(2, 3)))[:, :, None, None])
        coarse = F.interpolate(coarse, fine.shape[-2:], mode="bilinear", align_corners=False)
        result: Tensor = self.project(self.merge(torch.cat([fine, coarse], dim=1)))
        return result


class _ConvNorm(nn.Module):
    """Convolution, batch normalisation, ReLU."""

    def __init__(
        self, inputs: int, outputs: int, size: int, *, stride: int = 1, dilation: int = 1, groups: int = 1
    ) -> None:
        super().__init__()
        padding = dilation * (size // 2)
        self.conv = nn.Conv2d(inputs, outputs, size, stride, padding, dilation, groups, bias=False)
        self.norm: nn.BatchNorm2d | nn.Identity = nn.BatchNorm2d(outputs)

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


CONTENT_KIND = "bundled-content"
SEMANTIC_KIND = "bundled-semantic"
FOLDER = Path(__file__).parent / "weights"


class NetworkEncoder(FrozenEncoder):
    """A student of one feature per `stride` pixels. Images are resized to multiples of these, so that cells
    cover them.
    """

    def __init__(self, name: str, network: nn.Module, *, stride: int) -> None:
        freeze(network)
        with torch.no_grad():
            channels = int(network(torch.zeros(1, 3, stride, stride)).shape[1])
        super().__init__(f"{name}:{tensors_hash(network.state_dict())}", channels)
        self._stride = stride
        # Once its identity is known: normalisation as part of the convolutions before it, and channels last,
        # as they are computed on the CPU. 1.5 times as fast on two threads, and the same features up to
        # rounding.
        for module in network.modules():
            if isinstance(module, _ConvNorm) and isinstance(module.norm, nn.BatchNorm2d):
                module.conv = fuse_conv_bn_eval(module.conv, module.norm)
                module.norm = nn.Identity()
        for parameter in network.parameters():
            if parameter.ndim == 4:
                parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
        self.network = network
        freeze(self)

    @torch.no_grad()
    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B C h w"]:
        """Features, one per `stride` pixels, at least one along each axis."""
        height, width = (max(1, round(n / self._stride)) * self._stride for n in image.shape[-2:])
        if (height, width) != tuple(image.shape[-2:]):
            image = F.interpolate(image, (height, width), mode="bilinear", align_corners=False)
        features: Tensor = self.network(image)
        return features


def load_content_encoder(path: Path | None) -> NetworkEncoder:
    """Stride 2. Raises WeightsError where the file is absent or of another kind."""
    path = path or FOLDER / "content.safetensors"
    tensors, channels = _read(path, CONTENT_KIND, "content")
    student = ContentStudent(
        channels, (_outputs(tensors, "first.weight"), _outputs(tensors, "second.weight"))
    )
    # Stride 1: an odd border is better mirrored than the whole image blurred by resizing it.
    return NetworkEncoder(CONTENT_KIND, _filled(student, tensors, path), stride=1)


def load_semantic_encoder(path: Path | None) -> NetworkEncoder:
    """Stride 8. Raises WeightsError where the file is absent or of another kind."""
    path = path or FOLDER / "semantic.safetensors"
    tensors, channels = _read(path, SEMANTIC_KIND, "semantic")
    # Widths and the number of residuals are those of the file.
    stages = ("stem.0", "stem.1", "fine.0", "coarse.0")
    half, quarter, fine, coarse = (_outputs(tensors, f"{stage}.conv.weight") for stage in stages)
    residuals = sum(name.startswith("coarse.") and name.endswith(".narrow.weight") for name in tensors)
    student = SemanticStudent(channels, (half, quarter, fine, coarse), rounds=residuals // 3)
    return NetworkEncoder(SEMANTIC_KIND, _filled(student, tensors, path), stride=8)


def _read(path: Path, kind: str, verb: str) -> tuple[dict[str, Tensor], int]:
    tensors, metadata = read_weights(path)
    if metadata.get("kind") != kind or "project.weight" not in tensors:
        raise WeightsError(
            f"{path}: its metadata says {metadata.get('kind', 'nothing')!r}, wanted {kind!r}; "
            f"make one with `python -m tools.distil {verb} --images DIR --teachers FILE --output {path.name}` in a clone"
        )
    return tensors, int(tensors["project.weight"].shape[0])


def _outputs(tensors: dict[str, Tensor], name: str) -> int:
    """Width of a layer of the file; 1 where it is missing, which no network fits."""
    return len(tensors[name]) if name in tensors else 1


def _filled(student: nn.Module, tensors: dict[str, Tensor], path: Path) -> nn.Module:
    try:
        student.load_state_dict(tensors)
    except RuntimeError as error:
        first = str(error).splitlines()[-1].strip()
        raise WeightsError(
            f"{path}: does not fit this version's network ({first}); train it again"
        ) from error
    return student


class RandomEncoder(FrozenEncoder):
    """Means over cells of `stride` pixels, then a 3x3 convolution with weights ~ N(0, 1/27), then tanh."""

    def __init__(self, *, channels: int, stride: int, seed: int) -> None:
        super().__init__(f"random:{channels}:stride{stride}:seed{seed}", channels)
        self._stride = stride
        generator = torch.Generator().manual_seed(seed)
        self.register_buffer("weight", torch.randn(channels, 3, 3, 3, generator=generator) / 27**0.5)
        freeze(self)

    @torch.no_grad()
    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B C h w"]:
        """Features in (-1, 1), one per cell of stride x stride pixels (the last may reach over the
        border).
        """
        cells = F.avg_pool2d(replicate_to_multiple(image, self._stride), self._stride)
        return torch.tanh(F.conv2d(reflect_pad(4 * cells - 2), self.get_buffer("weight").to(cells)))
