"""Knobs of `fprf pretrain`. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..checks import at_least, positive
from ..io.overwriting import OverwriteConfig
from ..plugins.conversion import convert_fields
from ..plugins.encoders.config import BundledContentConfig, EncoderConfig


@dataclass(frozen=True, kw_only=True)
class PretrainConfig(OverwriteConfig):
    """Fields of every pretraining."""

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
    device: str = "auto"
    """cpu, cuda, mps, or auto. Draws are the same on each."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.photos is not None:
            at_least("photos", self.photos, 2)
        positive("minutes", self.minutes)
        if self.steps is not None:
            at_least("steps", self.steps, 1)
        at_least("batch", self.batch, 1)
        positive("rate", self.rate)
        at_least("seed", self.seed, 0)


@dataclass(frozen=True, kw_only=True)
class PretrainDecoderConfig(PretrainConfig):
    """D_VGG of the paper for one encoder: identity and, where asked for, the paper's content and style
    losses.
    """

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
    style: float = 0.0
    """Weight of the style loss (paper, lambda_s) on AdaIN between photographs, beside the identity's squared
    error: distance of VGG-19's means and deviations at relu1_1, relu2_1, relu3_1, relu4_1 (relu3_4 where the
    weights end before). 0 = not computed.
    """
    content: float = 0.0
    """Weight of the content loss (paper) on the same pictures, at relu2_1; 0 = not computed."""
    style_weights: Path | None = None
    """VGG-19's weights for both losses. With a file the report measures them even where they do not count;
    none = the download that the encoder `vgg19` uses.
    """
    crops: int = 64
    """Photographs whose crops are restyled by one another; memory grows with them."""
    size: int = 96
    """Pixels of such a crop's side."""
    pairs: int = 2
    """Pairs of crops at a time."""
    every: int = 4
    """Pairs are restyled in one step of so many, drawn by the seed, and then weigh as many times more: steps
    without them take a fraction of the time.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least("hidden", self.hidden, 1)
        at_least("pixels", self.pixels, 1)
        at_least("noise", self.noise, 0.0)
        at_least("style", self.style, 0.0)
        at_least("content", self.content, 0.0)
        at_least("crops", self.crops, 2)
        at_least("size", self.size, 16)
        at_least("pairs", self.pairs, 1)
        at_least("every", self.every, 1)
