"""What keeps one bad batch from spoiling a run: steps that are not finite change nothing, and denormals are cleared.

One gradient that is not finite destroys a parameter and its moments for ever, so it is looked for before the optimiser sees
it; so is one whose square overflows, which would stay in Adam's second moment as infinity. One norm over everything tells
both: it takes a twentieth of the time of a look at each number.

Moments of what is no longer seen decay into denormal numbers and, rounded, stay there; Adam takes 15 times as long over them.
They are cleared by step number, not by the processor's own mode: that is set a thread, so that results would depend on which
thread computed what.

On CUDA the host does not check before the optimiser steps, since it would wait. `unfit_step` stays on the device, fused Adam
reads it there and skips the step, and `StepStatistics` counts; the host reads the counts with the reports.
"""

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor, nn

__all__ = [
    "CLEAR_EVERY",
    "PATIENCE",
    "SMOOTHING",
    "StepStatistics",
    "clear_denormals",
    "unfit_gradients",
    "unfit_step",
    "unfit_terms",
]

SMOOTHING = 0.95
"""Decay of running means."""

PATIENCE = 3
"""Steps in a row that are not finite after which a run goes back to its last checkpoint: it will not recover by itself."""
CLEAR_EVERY = 100
"""Steps between looks for denormals. A first moment falls by 0.9^100 = 3e-5 until then."""
FAINT_FIRST = 1e-33
"""First moments below are cleared: after CLEAR_EVERY more steps they would be denormal (below 1.2e-38)."""
FAINT_SECOND = 1e-36
"""The same for second moments. Their root, 1e-18, is far below any useful eps."""
LARGEST = 1.8e19
"""Norm of a gradient that Adam can square in float32 (3.4e38)."""
_NAMED = 3


def unfit_terms(loss: Tensor, parts: Mapping[str, Tensor]) -> str | None:
    """Names of the loss terms that are not finite; None where the loss is."""
    if bool(torch.isfinite(loss)):
        return None
    bad = [name for name, value in parts.items() if not bool(torch.isfinite(value))]
    return ", ".join(bad) or "the sum of the loss terms"


def unfit_gradients(parameters: Iterable[tuple[str, nn.Parameter]]) -> str | None:
    """Names of the parameters whose gradient is not finite, or too large to be squared; None where all are well."""
    found = [(name, p.grad) for name, p in parameters if p.grad is not None]
    if not found or bool(torch.nn.utils.get_total_norm([grad for _, grad in found]) < LARGEST):
        return None
    bad = [name for name, grad in found if not bool(grad.norm() < LARGEST)]
    more = f" and {len(bad) - _NAMED} more" if len(bad) > _NAMED else ""
    return f"the gradient of {', '.join(bad[:_NAMED]) or 'all parameters together'}{more}"


@torch.no_grad()
def unfit_step(loss: Tensor, parameters: Iterable[nn.Parameter]) -> Tensor:
    """1 where the loss or a gradient is not finite, or too large to be squared, else 0: float32, on the loss's device."""
    norm = torch.nn.utils.get_total_norm([p.grad for p in parameters if p.grad is not None])
    return (~(torch.isfinite(loss) & (norm < LARGEST))).float()


class StepStatistics:
    """Running means of named scalars, and counts of those that were not finite, kept on their device until they are read."""

    def __init__(self, device: torch.device) -> None:
        self.names: list[str] = []
        # A row each: sums of values, sums of weights, how often not finite. MPS has no float64.
        self.rows = torch.zeros(3, 0, dtype=torch.float32 if device.type == "mps" else torch.float64, device=device)
        self.none = torch.full((), torch.nan, device=device)
        self.skipped, self.failed = torch.zeros((), device=device), torch.zeros((), device=device)
        self._present: dict[tuple[str, ...], Tensor] = {}

    @torch.no_grad()
    def add(self, values: Mapping[str, Tensor]) -> None:
        """One step's scalars. A name that is absent, or not finite, leaves its mean as it is."""
        new = [name for name in values if name not in self.names]
        if new:
            self.names += new
            self.rows = torch.nn.functional.pad(self.rows, (0, len(new)))
            self._present.clear()
        given = tuple(values)
        if given not in self._present:
            # Filled on the device: a term that comes every few steps must not have the host wait for a copy.
            marks = [torch.full_like(self.none, float(name in values)) for name in self.names]
            self._present[given] = torch.stack(marks).to(self.rows.dtype)
        found = torch.stack([values.get(name, self.none) for name in self.names]).to(self.rows.dtype)
        fit = torch.isfinite(found)
        means = SMOOTHING * self.rows[:2] + (1 - SMOOTHING) * torch.stack([found, self._present[given]])
        bad = self.rows[2] + self._present[given] * ~fit
        self.rows = torch.cat([torch.where(fit, means, self.rows[:2]), bad[None]])

    def count_skipped(self, unfit: Tensor) -> None:
        """Count a step: `unfit` is 1 where it was skipped, else 0."""
        self.skipped, self.failed = self.skipped + unfit, (self.failed + 1) * unfit

    def means(self) -> dict[str, float]:
        """The means, corrected for their start; names that never had a finite number are left out. The host waits."""
        value, weight, _ = self.rows.tolist()
        return {name: v / w for name, v, w in zip(self.names, value, weight, strict=True) if w > 0}

    def faults(self) -> tuple[int, int, str]:
        """Steps skipped so far, the last ones in a row, and the names of terms that were not finite since the last call."""
        skipped, failed, *bad = torch.cat([torch.stack([self.skipped, self.failed]), self.rows[2]]).tolist()
        self.rows[2].zero_()
        return int(skipped), int(failed), ", ".join(name for name, b in zip(self.names, bad, strict=True) if b > 0)


@torch.no_grad()
def clear_denormals(optimizer: torch.optim.Optimizer) -> None:
    """Set moments of Adam that are, or would soon be, denormal to zero; the parameters' next step is the same without them."""
    for state in optimizer.state.values():
        first, second = state.get("exp_avg"), state.get("exp_avg_sq")
        if first is not None and second is not None:
            torch.hardshrink(first, FAINT_FIRST, out=first)
            torch.threshold_(second, FAINT_SECOND, 0.0)
