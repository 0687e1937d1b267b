"""Files of network weights: read, written, known by their hash."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from ..errors import WeightsError
from ..io.atomic import write_bytes


def read_weights(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors (half precision widened to float32) and metadata. Raises WeightsError where the file is absent
    or damaged.
    """
    if not path.is_file():
        raise WeightsError(
            f"{path}: no such weights file; name an existing one or make it with `fprf pretrain`"
        )
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            halves = (torch.float16, torch.bfloat16)
            wide = {}
            for name, tensor in tensors.items():
                if tensor.dtype in halves:
                    wide[name] = tensor.float()
                else:
                    wide[name] = tensor
            return wide, dict(file.metadata() or {})
    except (SafetensorError, OSError) as error:
        raise WeightsError(
            f"{path}: not a readable safetensors file ({error}); copy or download it again"
        ) from error


def write_weights(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write all or nothing: a reader never meets half a file."""
    write_bytes(
        path,
        save({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}, dict(metadata)),
    )


def tensors_hash(tensors: Mapping[str, Tensor]) -> str:
    """First 12 hex digits of the SHA-256 over names, shapes and float32 values, in the order of the names."""
    # Values as float32, so that a file in half precision and its copy in full have one hash.
    digest = hashlib.sha256()
    for name in sorted(tensors):
        value = tensors[name].detach().to("cpu", torch.float32).contiguous()
        digest.update(f"{name}{tuple(value.shape)}".encode())
        digest.update(value.numpy().tobytes())
    return digest.hexdigest()[:12]


IMAGENET_MEAN = (0.485, 0.456, 0.406)
"""Mean red, green and blue of ImageNet, sRGB in [0, 1]: what networks trained on it expect to be taken off."""
IMAGENET_STD = (0.229, 0.224, 0.225)
"""Their standard deviations, by which these networks expect colours to be divided."""
