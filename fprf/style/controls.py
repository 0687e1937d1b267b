"""What a user turns: how strong a style is, and which reference goes where."""

from collections.abc import Mapping, Set
from typing import Annotated

import torch
from torch import Tensor

from ..errors import UsageError

__all__ = ["blend_strength", "edit_table"]


def blend_strength(
    content: Annotated[Tensor, "N C"], styled: Annotated[Tensor, "N C"], strength: float
) -> Annotated[Tensor, "N C"]:
    """Between the scene's features (strength 0, bit for bit) and the styled ones (strength 1, bit for bit).

    Raises UsageError outside [0, 1].
    """
    if not 0.0 <= strength <= 1.0:
        raise UsageError(f"strength: {strength} must lie in [0, 1]")
    if strength == 0.0:
        return content
    if strength == 1.0:
        return styled
    return torch.lerp(content, styled, strength)


def edit_table(
    table: Annotated[Tensor, "K T"],
    reference: Annotated[Tensor, "T"],
    *,
    pin: Mapping[int, int] | None = None,
    forbid: Set[tuple[int, int]] = frozenset(),
) -> Annotated[Tensor, "K T"]:
    """A region-to-code table with the user's wishes; rows still sum to 1.

    `pin` maps a region to the only reference it may take codes from; `forbid` holds (region, reference) pairs that may not
    meet. Within what is left the matching's own odds stay. Raises UsageError for numbers out of range or a region that is
    left with nothing.
    """
    regions, references = len(table), int(reference.max()) + 1
    pin = pin or {}
    for k, i in (*pin.items(), *sorted(forbid)):
        if not (0 <= k < regions and 0 <= i < references):
            raise UsageError(
                f"region {k} and reference {i}: regions go from 0 to {regions - 1}, references from 0 to {references - 1}"
            )
    allowed = torch.ones(table.shape, dtype=torch.bool, device=table.device)
    for k, i in pin.items():
        allowed[k] = reference == i
    for k, i in forbid:
        allowed[k] &= reference != i
    for k in (~allowed.any(1)).nonzero().flatten().tolist():
        raise UsageError(f"region {k}: every reference is forbidden; allow one, or keep the region as it is")
    # Codes that the matching gave next to nothing share evenly where they are all that is left.
    odds = torch.where(allowed, table.clamp_min(torch.finfo(table.dtype).tiny), 0.0)
    odds = odds / odds.amax(1, keepdim=True)
    return odds / odds.sum(1, keepdim=True)
