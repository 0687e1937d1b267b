"""Configuration of `fprf process`, which finds poses. No cv2, no torch."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ..checks import at_least, between
from ..plugins.conversion import convert_fields

Lens = Literal["simple-pinhole", "pinhole", "simple-radial", "radial", "opencv", "opencv-fisheye"]


@dataclass(frozen=True, kw_only=True)
class SfmConfig:
    """Frames, features, pairs and lenses of a reconstruction."""

    frames: int = 150
    """Sharp frames taken from a video, at most; images of a folder are all used."""
    blurred: float = 0.3
    """A stretch of a video whose sharpest frame has less than this share of the sharpness around it gives
    none, in [0, 1).
    """
    lens: Lens = "simple-radial"
    """Lens model that is fitted; wide-angle and action cameras want opencv or opencv-fisheye."""
    cameras: Literal["shared", "each"] = "shared"
    """shared: images of one size, model and focal length have one lens; where their files say no focal length,
    several if residuals tell them apart. each: every image has its own.
    """
    masks: Path | None = None
    """A folder of masks with the images' names, black where nothing is to be used: the still background of a
    turntable, passers-by. They go into the scene, and training uses them too.
    """
    features: int = 8192
    """Features of an image, at most."""
    side: int = 1600
    """Longest side in pixels at which features are sought; larger images are reduced for that."""
    matching: Literal["auto", "exhaustive", "sequential", "similar"] = "auto"
    """exhaustive: all with all. sequential: in the order of names or time. similar: with those that share most
    of their 300 largest features, and with their neighbours by name. auto: exhaustive for up to 30 images,
    else similar, with sequential for videos; images that find no pose are then matched with all.
    """
    overlap: int = 10
    """Neighbours in order that an image is matched with, and 2, 4, 8, ... 2^overlap further on."""
    neighbours: int = 16
    """Images alike that an image is matched with, by `similar`."""
    threads: int | None = None
    """Threads of COLMAP; none = all cores."""
    gpu: bool = True
    """Let COLMAP use a GPU where there is one and it was built for it."""
    seed: int = 0
    """Seed of COLMAP's random choices."""

    def __post_init__(self) -> None:
        convert_fields(self)
        at_least("frames", self.frames, 3)
        between("blurred", self.blurred, 0.0, 0.99)
        at_least("features", self.features, 100)
        at_least("side", self.side, 100)
        at_least("overlap", self.overlap, 1)
        at_least("neighbours", self.neighbours, 1)
        if self.threads is not None:
            at_least("threads", self.threads, 1)
