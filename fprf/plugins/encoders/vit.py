"""DINO, DINOv2 and DINOv3 through `transformers` (extra `encoders`): final-norm tokens of any block, at any
stride.

The stride is reached by resizing: one patch of the resized image covers `stride` pixels of the one given.
Blocks after the chosen one are never loaded.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ...errors import WeightsError
from ...io.cache import files_in, refusal, say_uncached, temporary_folder
from ..weights import IMAGENET_MEAN, IMAGENET_STD, tensors_hash
from .config import hub_folder
from .frozen import FrozenEncoder, freeze, patch_grid

# ViT interpolates its position table on demand, DINOv2 always does, DINOv3 turns its tokens by where they
# lie.
CALLS: Mapping[str, Mapping[str, bool]] = {
    "dino": {"interpolate_pos_encoding": True},
    "dinov2": {},
    "dinov3": {},
}
TYPES: Mapping[str, tuple[str, ...]] = {
    "dino": ("vit",),
    "dinov2": ("dinov2", "dinov2_with_registers"),
    "dinov3": ("dinov3_vit",),
}
"""Model types of each family in transformers."""


class VitEncoder(FrozenEncoder):
    """Patch tokens of a vision transformer `model` with patches of `patch` pixels."""

    def __init__(
        self, family: str, model: nn.Module, *, name: str, patch: int, channels: int, stride: int | None
    ) -> None:
        used = {}
        for key, value in model.state_dict().items():
            if not key.startswith("pooler."):
                used[key] = value
        super().__init__(f"{family}:{name}:stride{stride}:{tensors_hash(used)}", channels)
        self._call = CALLS[family]
        self._patch = patch
        self._stride = stride
        self.model = model
        freeze(self)

    @torch.no_grad()
    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B C h w"]:
        """Features, one per `stride` pixels, cells covering the whole image evenly."""
        height, width = patch_grid(image.shape[-2:], self._stride)
        size = (height * self._patch, width * self._patch)
        # A patch of the model for every cell.
        if size != tuple(image.shape[-2:]):
            image = F.interpolate(image, size, mode="bilinear", align_corners=False, antialias=True)
        mean = image.new_tensor(IMAGENET_MEAN).view(1, 3, 1, 1)
        std = image.new_tensor(IMAGENET_STD).view(1, 3, 1, 1)
        tokens: Tensor = self.model(pixel_values=(image - mean) / std, **self._call).last_hidden_state
        # Class and register tokens come first.
        return tokens[:, -height * width :].transpose(1, 2).reshape(len(image), self._channels, height, width)


def build_vit(family: str, name: str, *, layer: int, stride: int | None) -> VitEncoder:
    """The encoder from the hub's cache, the hub or a folder. Raises WeightsError where one of its parts is
    absent.
    """
    try:
        from transformers import AutoConfig, AutoModel
        from transformers.utils import logging
    except ImportError as error:
        raise WeightsError(
            f"{family}: needs the package transformers ({error}); pip install 'fprf[encoders]', "
            "or choose one that ships: --semantic.encoder dinov2"
        ) from error
    # The model up to the block alone: transformers loads only as many as the config says.
    # Without a home the hub's library would take a folder named ~ in the working directory.
    hub = hub_folder()
    reason = "" if files_in(hub, "models--*") else refusal(hub)
    elsewhere = None
    if reason and not Path(name).is_dir():
        say_uncached(hub, reason)
        elsewhere = temporary_folder("huggingface")
    verbosity = logging.get_verbosity()
    logging.set_verbosity_error()  # else it lists the blocks that are left out
    try:
        config = AutoConfig.from_pretrained(name, cache_dir=elsewhere)  # nosec B615  # `name` says which revision; the identity hashes the weights
        if config.model_type not in TYPES[family]:
            raise ValueError(f"it is of type {config.model_type}, not {' or '.join(TYPES[family])}")
        blocks = int(config.num_hidden_layers)
        config.num_hidden_layers = _block(layer, blocks, name)
        model = AutoModel.from_pretrained(name, config=config, cache_dir=elsewhere)  # nosec B615
    except (OSError, ValueError, KeyError) as error:
        reason = str(error).strip().splitlines()[0]
        raise WeightsError(
            f"{family}: {name} cannot be loaded ({reason}); with a network run `hf download {name}` once, "
            "or name a folder with its config.json and model.safetensors by --semantic.encoder.model FOLDER, "
            "or choose an encoder that ships: --semantic.encoder dinov2"
        ) from error
    finally:
        logging.set_verbosity(verbosity)
    return VitEncoder(
        family,
        model,
        name=f"{name.rstrip('/').rpartition('/')[2]}:block{config.num_hidden_layers}",
        patch=int(config.patch_size),
        channels=int(config.hidden_size),
        stride=stride,
    )


def _block(layer: int, blocks: int, name: str) -> int:
    block = layer if layer > 0 else blocks + 1 + layer
    if not 1 <= block <= blocks:
        raise WeightsError(f"{name}: has no block {layer}; allowed are 1 to {blocks}, or -1 to -{blocks}")
    return block
