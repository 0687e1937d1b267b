"""The encoders that ship with the package, or others of the same making (`fprf pretrain content`, `... semantic`)."""

from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ...errors import WeightsError
from ...interfaces import Encoder
from ..weightfiles import read_weights, tensors_hash
from .frozen import freeze
from .students import ContentStudent, SemanticStudent

__all__ = ["CONTENT_KIND", "SEMANTIC_KIND", "BundledEncoder", "load_content_encoder", "load_semantic_encoder"]

CONTENT_KIND, SEMANTIC_KIND = "bundled-content", "bundled-semantic"
FOLDER = Path(__file__).parent / "weights"


class BundledEncoder(Encoder):
    """A trained student. The image is resized to multiples of `multiple`, so that cells cover it exactly."""

    def __init__(self, name: str, student: nn.Module, *, channels: int, multiple: int) -> None:
        super().__init__()
        self._identity = f"{name}:{tensors_hash(student.state_dict())}"
        self._channels, self._multiple = channels, multiple
        self.student = student
        freeze(self)

    @property
    def identity(self) -> str:
        """Name and a hash of the weights."""
        return self._identity

    @property
    def channels(self) -> int:
        """Channels of the features."""
        return self._channels

    @torch.no_grad()
    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B C h w"]:
        """Features, centred over photographs and O(1)."""
        height, width = (max(self._multiple, round(n / self._multiple) * self._multiple) for n in image.shape[-2:])
        if (height, width) != tuple(image.shape[-2:]):
            image = F.interpolate(image, (height, width), mode="bilinear", align_corners=False)
        features: Tensor = self.student(image)
        return features


def load_content_encoder(path: Path | None) -> BundledEncoder:
    """Stride 2. Raises WeightsError where the file is absent or of another kind."""
    path = path or FOLDER / "content.safetensors"
    tensors, channels = _read(path, CONTENT_KIND, "content")
    # At stride 2 an odd border is better mirrored than the whole image blurred by resizing it.
    student = ContentStudent(channels, (_outputs(tensors, "first.weight"), _outputs(tensors, "second.weight")))
    return _loaded(CONTENT_KIND, student, tensors, path, channels=channels, multiple=1)


def load_semantic_encoder(path: Path | None) -> BundledEncoder:
    """Stride 8. Raises WeightsError where the file is absent or of another kind."""
    path = path or FOLDER / "semantic.safetensors"
    tensors, channels = _read(path, SEMANTIC_KIND, "semantic")
    stages = ("stem.0", "stem.1", "fine.0", "coarse.0")
    half, quarter, fine, coarse = (_outputs(tensors, f"{stage}.conv.weight") for stage in stages)
    residuals = sum(name.startswith("coarse.") and name.endswith(".narrow.weight") for name in tensors)
    student = SemanticStudent(channels, (half, quarter, fine, coarse), rounds=residuals // 3)
    return _loaded(SEMANTIC_KIND, student, tensors, path, channels=channels, multiple=8)


def _read(path: Path, kind: str, verb: str) -> tuple[dict[str, Tensor], int]:
    tensors, metadata = read_weights(path)
    if metadata.get("kind") != kind or "project.weight" not in tensors:
        raise WeightsError(
            f"{path}: its metadata says {metadata.get('kind', 'nothing')!r}, wanted {kind!r}; "
            f"make one with `fprf pretrain {verb} --images DIR --teachers FILE --output {path.name}`"
        )
    return tensors, int(tensors["project.weight"].shape[0])


def _outputs(tensors: dict[str, Tensor], name: str) -> int:
    """Width of a layer of the file; 1 where it is missing, which no network fits."""
    return len(tensors[name]) if name in tensors else 1


def _loaded(
    name: str, student: nn.Module, tensors: dict[str, Tensor], path: Path, *, channels: int, multiple: int
) -> BundledEncoder:
    try:
        student.load_state_dict(tensors)
    except RuntimeError as error:
        first = str(error).splitlines()[-1].strip()
        raise WeightsError(f"{path}: does not fit this version's network ({first}); train it again") from error
    return BundledEncoder(name, student, channels=channels, multiple=multiple)
