"""A frozen convolutional network as an encoder: the image is resized so that its cells cover it exactly."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import torch
from torch import Tensor, nn

from ...errors import WeightsError
from ...interfaces import Encoder
from ..weightfiles import tensors_hash
from .frozen import freeze, resize_to_multiple

__all__ = ["NetworkEncoder", "fitting"]


class NetworkEncoder(Encoder):
    """A network of one feature per `stride` pixels. `name` says everything that changes the output but the tensors."""

    def __init__(self, name: str, network: nn.Module, *, stride: int) -> None:
        super().__init__()
        self._identity, self._stride = f"{name}:{tensors_hash(network.state_dict())}", stride
        self.network = network
        freeze(self)
        self._channels = int(self(torch.zeros(1, 3, stride, stride)).shape[1])

    @property
    def identity(self) -> str:
        """Name and a hash of every tensor that is used."""
        return self._identity

    @property
    def channels(self) -> int:
        """Channels of the features."""
        return self._channels

    @torch.no_grad()
    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B C h w"]:
        """Features, one per `stride` pixels, at least one along each axis."""
        features: Tensor = self.network(resize_to_multiple(image, self._stride))
        return features


@contextmanager
def fitting(source: str, what: str, flag: str) -> Iterator[None]:
    """Building and trying a network on a file's tensors: what is missing or misshapen there is a WeightsError."""
    try:
        yield
    except (KeyError, RuntimeError) as error:
        reason = f"{error.args[0]} is missing" if isinstance(error, KeyError) else str(error).strip().splitlines()[0]
        raise WeightsError(
            f"{source}: does not hold {what} ({reason}); choose a layer that it holds, or name another file with {flag} FILE"
        ) from error
