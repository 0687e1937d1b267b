"""Knobs of `fprf pretrain`. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..checks import at_least, positive
from ..plugins.encoders.config import BundledContentConfig, EncoderConfig

__all__ = ["DistilConfig", "PretrainConfig", "PretrainDecoderConfig"]


@dataclass(frozen=True, kw_only=True)
class PretrainConfig:
    """What every pretraining needs."""

    images: tuple[Path, ...] = ()
    """Folders of photographs, searched at every depth; one in twelve is held out for the report."""
    photos: int | None = None
    """Use only so many of the photographs."""
    output: Path | None = None
    """Weights file to write. A checkpoint lies beside it until it is finished; run again to resume."""
    minutes: float = 8.0
    """Training time, preparation not included; the learning rate falls to zero at its end."""
    steps: int | None = None
    """Optimiser steps instead of minutes."""
    batch: int = 32
    """Examples per step."""
    rate: float = 2e-3
    """Learning rate at its height."""
    seed: int = 0
    """Every draw is a function of it."""

    def __post_init__(self) -> None:
        if self.photos is not None:
            at_least("photos", self.photos, 2)
        positive("minutes", self.minutes)
        if self.steps is not None:
            at_least("steps", self.steps, 1)
        at_least("batch", self.batch, 1)
        positive("rate", self.rate)
        at_least("seed", self.seed, 0)


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
class PretrainDecoderConfig(PretrainConfig):
    """D_VGG of the paper for one encoder, trained for identity."""

    encoder: EncoderConfig = BundledContentConfig()
    """The encoder whose features are to be decoded."""
    batch: int = 2048
    """Pixels per step."""
    hidden: int = 128
    """Hidden units."""
    pixels: int = 2000
    """Pixels per photograph, prepared once."""
    noise: float = 0.02
    """Gaussian noise on the features, in units of their standard deviation: makes the decoder smooth."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least("hidden", self.hidden, 1)
        at_least("pixels", self.pixels, 1)
        at_least("noise", self.noise, 0.0)
