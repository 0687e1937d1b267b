"""What a trained scene knows of its own style: one set of content statistics and its semantic regions."""

from typing import Annotated, NamedTuple

from torch import Tensor

__all__ = ["SceneStyle"]


class SceneStyle(NamedTuple):
    """Statistics of the per-point content features, weighted by rendering weight, over the training views.

    Regions are clusters of the scene's own semantics (design: two-sided dictionary). A scene without semantics has one
    region and D = 0.
    """

    mean: Annotated[Tensor, "C"]
    covariance: Annotated[Tensor, "C C"]
    keys: Annotated[Tensor, "K D"]
    """Centroid of each region's semantic features."""
    region_mean: Annotated[Tensor, "K C"]
    region_covariance: Annotated[Tensor, "K C C"]
    share: Annotated[Tensor, "K"]
    """Share of the scene's weight in each region; sums to 1."""
    semantic_mean: Annotated[Tensor, "D"]
    """Mean semantic feature of the scene: the centre for cosine matching."""
