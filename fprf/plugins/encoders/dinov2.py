"""DINOv2-small, the vision transformer ViT-S/14 (Oquab et al. 2023, arXiv:2304.07193), in plain torch with
weights that ship.

The file holds matrices as int8 with a scale for each output row (cosine to the features of float32: 0.9996 at
block 9), and blocks 1 to 11: whether the origin of the weights changed the last one is not known, and it
tells regions apart worse.

Letters: B images, T = 1 + h w tokens of 384 channels, the class token first.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ...errors import WeightsError
from ..weights import IMAGENET_MEAN, IMAGENET_STD, read_weights, tensors_hash
from .frozen import CELLS, FrozenEncoder, freeze, patch_grid

PATCH = 14
"""Pixels of a patch's side, as in training."""
WIDTH = 384
"""Channels of the smallest DINOv2 (ViT-S)."""
HEADS = 6
"""Heads of attention of the smallest DINOv2."""
GRID = 37
"""Rows and columns of the learned positions."""
HELD = 11
"""Blocks in the file that ships."""
BLOCKS = 12
"""Blocks of the network."""
EPS = 1e-6
"""Of layer norms, as in training."""
COVER = 0.02
"""Mean opacity of a patch from which on it is encoded."""
GREY = 0.5
"""Backdrop of patches that show something in part: the mean colour of what is shown hides its outline, and
matches worse.
"""
WEIGHTS = Path(__file__).parent / "weights" / "dinov2-small.safetensors"


class Block(nn.Module):
    """Self-attention and a perceptron, each after a layer norm and scaled by channel before it is added."""

    def __init__(self) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(WIDTH, eps=EPS)
        self.norm2 = nn.LayerNorm(WIDTH, eps=EPS)
        self.qkv = nn.Linear(WIDTH, 3 * WIDTH)
        self.proj = nn.Linear(WIDTH, WIDTH)
        self.fc1 = nn.Linear(WIDTH, 4 * WIDTH)
        self.fc2 = nn.Linear(4 * WIDTH, WIDTH)
        self.scale1 = nn.Parameter(torch.empty(WIDTH))
        self.scale2 = nn.Parameter(torch.empty(WIDTH))

    def forward(self, x: Annotated[Tensor, "B T 384"], keys: bool = False) -> Annotated[Tensor, "B T 384"]:
        """The tokens after the block, or the keys of all its heads side by side."""
        # [B T 3 heads 64] to three of [B heads T 64].
        query, key, value = self.qkv(self.norm1(x)).unflatten(2, (3, HEADS, -1)).permute(2, 0, 3, 1, 4)
        if keys:
            x = key.transpose(1, 2).flatten(2)
        else:
            x = x + self.scale1 * self.proj(
                F.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2)
            )
            x = x + self.scale2 * self.fc2(F.gelu(self.fc1(self.norm2(x))))
        return x


class Dinov2(nn.Module):
    """The first `blocks` blocks on patches of 14 pixels."""

    def __init__(self, blocks: int) -> None:
        super().__init__()
        self.patch_embed = nn.Conv2d(3, WIDTH, PATCH, PATCH)
        self.cls_token = nn.Parameter(torch.empty(WIDTH))
        self.pos_embed = nn.Parameter(torch.empty(WIDTH, GRID, GRID))
        self.blocks = nn.ModuleList(Block() for _ in range(blocks))

    def forward(
        self,
        image: Annotated[Tensor, "B 3 14h 14w"],
        keys: bool,
        shown: Annotated[Tensor, "h w"] | None = None,
    ) -> Annotated[Tensor, "B 384 h w"]:
        """Patch tokens after the last block without a norm, or that block's keys. Colours are normalised.

        Only patches that are `shown` (bool, at least one) attend to each other; the others take the features
        of the nearest.
        """
        # Tokens are patches with their learned positions, interpolated to this grid.
        patches = self.patch_embed(image)
        shape = patches.shape[-2:]
        positions = F.interpolate(self.pos_embed[None], shape, mode="bicubic", align_corners=False)
        tokens = (patches + positions).flatten(2).transpose(1, 2)
        if shown is not None:
            tokens = tokens[:, shown.flatten()]
        # The class token attends and is attended to, and is dropped at the end.
        x = torch.cat([self.cls_token.expand(len(image), 1, -1), tokens], 1)
        for index, block in enumerate(self.blocks, start=1):
            x = block(x, keys and index == len(self.blocks))
        x = x[:, 1:]
        if shown is not None:
            # So that no filter over cells mixes in what is not there.
            cells = torch.ones_like(shown).nonzero().float()
            x = x[:, torch.cdist(cells, cells[shown.flatten()]).argmin(1)]
        return x.transpose(1, 2).reshape(len(image), WIDTH, *shape)


class Dinov2Encoder(FrozenEncoder):
    """Tokens or keys of one block; the image is resized to the patches of `patch_grid`."""

    def __init__(self, network: Dinov2, *, kind: Literal["tokens", "keys"], stride: int | None) -> None:
        settings = f"block{len(network.blocks)}:{kind}:" + (f"stride{stride}" if stride else f"cells{CELLS}")
        super().__init__(f"dinov2-small:{settings}:{tensors_hash(network.state_dict())}", WIDTH)
        self.network = network
        self._keys = kind == "keys"
        self._stride = stride
        freeze(self)

    @torch.no_grad()
    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B C h w"]:
        """Features; cells cover the whole image evenly, at least one along each axis."""
        return self._features(image)

    @torch.no_grad()
    def cutout(
        self, image: Annotated[Tensor, "B 3 H W"], opacity: Annotated[Tensor, "B H W"]
    ) -> Annotated[Tensor, "B C h w"]:
        """Features of the patches that show something, encoded without the others: cheaper, and no backdrop
        has a say.
        """
        # Patches with something in them; what they show only in part lies on grey.
        cover = F.adaptive_avg_pool2d(opacity[:, None], patch_grid(image.shape[-2:], self._stride))[:, 0]
        filled = image + (1 - opacity[:, None]) * GREY
        # One by one: as many tokens as each image shows.
        features = []
        for each, shown in zip(torch.split(filled, 1), cover > COVER, strict=True):
            partly = bool(shown.any() & ~shown.all())
            features.append(self._features(each, shown if partly else None))
        return torch.cat(features)

    def _features(
        self, image: Tensor, shown: Annotated[Tensor, "h w"] | None = None
    ) -> Annotated[Tensor, "B C h w"]:
        # Resized to whole patches, with ImageNet's mean and deviation.
        size = []
        for n in patch_grid(image.shape[-2:], self._stride):
            size.append(PATCH * n)
        if size != list(image.shape[-2:]):
            image = F.interpolate(image, size, mode="bicubic", align_corners=False, antialias=True)
        mean = image.new_tensor(IMAGENET_MEAN).view(1, 3, 1, 1)
        std = image.new_tensor(IMAGENET_STD).view(1, 3, 1, 1)
        features: Tensor = self.network((image - mean) / std, self._keys, shown)
        return features


def load_dinov2(*, layer: int, kind: Literal["tokens", "keys"], stride: int | None) -> Dinov2Encoder:
    """The encoder up to block `layer` (negative: from the last of 12). Raises WeightsError where the file has
    no such block.
    """
    block = layer if layer > 0 else BLOCKS + 1 + layer
    if not 1 <= block <= HELD:
        raise WeightsError(
            f"dinov2: no block {layer} ships; allowed are 1 to {HELD}, or a model of the hub by --semantic.encoder.model"
        )
    with torch.device("meta"):  # no memory or time for weights that are replaced
        network = Dinov2(block)
    tensors = dequantised(read_weights(WEIGHTS)[0])
    network.load_state_dict({name: tensors[name] for name in network.state_dict()}, assign=True)
    return Dinov2Encoder(network, kind=kind, stride=stride)


def dequantised(stored: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Tensors of a file in float32: rows of int8 times their scales, NAME by NAME.scale."""
    tensors = {}
    for name, value in stored.items():
        scale = stored.get(f"{name}.scale")
        if scale is not None:
            value = value.float() * scale.view(-1, *(1,) * (value.ndim - 1))
        if not name.endswith(".scale"):
            tensors[name] = value
    return tensors
