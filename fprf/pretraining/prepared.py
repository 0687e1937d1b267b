"""Crops and targets that are made once: kept beside the output until the run is finished, so that resuming is quick."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from ..plugins.weightfiles import read_weights, write_weights
from .config import DistilConfig

__all__ = ["prepared", "prepared_path"]

Pair = tuple[Tensor, Tensor]


def prepared_path(output: Path) -> Path:
    """Where the crops of an unfinished run lie."""
    return output.with_name(output.name + ".prepared")


def prepared(make: Callable[[], Pair], config: DistilConfig, output: Path) -> Pair:
    """Inputs and targets: those of an interrupted run that would prepare the same, or made anew and kept."""
    path = prepared_path(output)
    if path.is_file():
        tensors, metadata = read_weights(path)
        if metadata.get("key") == _key(config):
            return tensors["inputs"], tensors["targets"]
    inputs, targets = make()
    write_weights(path, {"inputs": inputs, "targets": targets}, {"key": _key(config)})
    return inputs, targets


def _key(config: DistilConfig) -> str:
    """What the crops depend on: a run may be made longer without preparing them again."""
    free = replace(config, output=None, minutes=1.0, steps=None, batch=1, rate=1.0, samples=0.0, device="auto")
    return repr(free)
