"""The style dictionary (paper, section on semantic matching): local semantic codes and the styles that go with them."""

from typing import Annotated, NamedTuple

from torch import Tensor

__all__ = ["StyleDictionary"]


class StyleDictionary(NamedTuple):
    """T style codes of all references together."""

    keys: Annotated[Tensor, "T D"]
    """Semantic centroid of each code, in the scene's semantic basis."""
    mean: Annotated[Tensor, "T C"]
    covariance: Annotated[Tensor, "T C C"]
    """Content statistics of each code; the local standard deviation is the root of the diagonal."""
    share: Annotated[Tensor, "T"]
    """Share of its reference's pixels."""
    reference: Annotated[Tensor, "T"]
    """int64 index of the reference that a code comes from."""
    weight: Annotated[Tensor, "T"]
    """User weight of its reference; above 0."""
    names: tuple[str, ...]
    """Names of the references, in dictionary order."""
