"""One row of the stress report: an input, what it is compared with, the bound, and what was measured."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["Check", "U", "markdown", "relative", "scaled", "unsound"]

U = 2.0**-24
"""Unit round-off of float32."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """What came of one input."""

    stage: str
    input: str
    reference: str
    measured: float
    bound: float
    """`measured` must be at most this; for `at_least`, at least."""
    unit: str = ""
    at_least: bool = False

    @property
    def passed(self) -> bool:
        """Whether the bound holds; NaN holds none."""
        if math.isnan(self.measured):
            return False
        return self.measured >= self.bound if self.at_least else self.measured <= self.bound

    def json(self) -> dict[str, object]:
        """The row for a file; a measure that is not finite becomes text."""
        measured: object = float(f"{self.measured:.4g}") if math.isfinite(self.measured) else str(self.measured)
        return {
            "stage": self.stage,
            "input": self.input,
            "reference": self.reference,
            "bound": self.bound,
            "bound_is": "at least" if self.at_least else "at most",
            "measured": measured,
            "unit": self.unit,
            "verdict": "holds" if self.passed else "BROKEN",
        }


def relative(found: Tensor, truth: Tensor, floor: float = 0.0) -> float:
    """Largest relative error where the truth is above `floor`; infinite where something is not finite, 0 of nothing."""
    found, truth = found.double(), truth.double()
    if not bool(found.isfinite().all()):
        return math.inf
    at = truth.abs() > floor
    error = ((found - truth).abs() / truth.abs())[at]
    return float(error.max()) if error.numel() else 0.0


def scaled(found: Tensor, truth: Tensor) -> float:
    """Largest error as a share of the largest true value."""
    found, truth = found.double(), truth.double()
    if not bool(found.isfinite().all()):
        return math.inf
    return float((found - truth).abs().max() / truth.abs().max().clamp_min(torch.finfo(torch.float64).tiny))


def unsound(*tensors: Tensor) -> float:
    """How many numbers are not finite."""
    return float(sum(int((~t.isfinite()).sum()) for t in tensors))


def markdown(checks: Sequence[Check]) -> str:
    """The rows as a table."""
    lines = ["| stage | input | reference | bound | measured | |", "|---|---|---|---|---|---|"]
    for check in checks:
        sign = "≥" if check.at_least else "≤"
        unit = f" {check.unit}" if check.unit else ""
        verdict = "holds" if check.passed else "**broken**"
        cells = (check.stage, check.input, check.reference, f"{sign} {check.bound:g}{unit}", f"{check.measured:.3g}", verdict)
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"
