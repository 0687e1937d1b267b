"""Settings of `python -m tools.distil`. Imports no torch."""

from dataclasses import dataclass
from pathlib import Path

from fprf.checks import at_least
from fprf.pretraining.config import PretrainConfig


@dataclass(frozen=True, kw_only=True)
class DistilConfig(PretrainConfig):
    """A small encoder that imitates larger ones."""

    teachers: tuple[Path, ...] = ()
    """Weights of the teachers: VGG-19 for `content`; MobileNetV2, then DeepLab's backbone for `semantic`."""
    batch: int = 4
    """Crops per step."""
    rate: float = 4e-3
    """Learning rate at its height."""
    crops: int = 4
    """Crops per photograph, prepared once."""
    size: int = 64
    """Pixels of a crop's side."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least("crops", self.crops, 1)
        at_least("size", self.size, 16)


@dataclass(frozen=True, kw_only=True)
class SemanticDistilConfig(DistilConfig):
    """The semantic encoder: whole photographs count here, and streets that differ in their light alone."""

    minutes: float = 40.0
    """Training time, preparation not included; the learning rate falls to zero at its end."""
    batch: int = 6
    """Views per step."""
    rate: float = 3e-3
    """Learning rate at its height."""
    crops: int = 1
    """Crops per photograph, prepared once."""
    size: int = 320
    """Pixels of a crop's side."""
    towns: int = 10
    """Streets that are rendered for it, each in every palette; 0 = photographs alone."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least("towns", self.towns, 0)
