"""What keeps one bad batch from spoiling a run: steps that are not finite change nothing, and denormals are cleared.

One gradient that is not finite destroys a parameter and its moments for ever, so it is looked for before the optimiser sees
it; so is one whose square overflows, which would stay in Adam's second moment as infinity. One norm over everything tells
both: it takes a twentieth of the time of a look at each number.

Moments of what is no longer seen decay into denormal numbers and, rounded, stay there; Adam takes 15 times as long over them.
They are cleared by step number, not by the processor's own mode: that is set a thread, so that results would depend on which
thread computed what.
"""

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor, nn

__all__ = ["CLEAR_EVERY", "PATIENCE", "clear_denormals", "unfit_gradients", "unfit_terms"]

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
def clear_denormals(optimizer: torch.optim.Optimizer) -> None:
    """Set moments of Adam that are, or would soon be, denormal to zero; the parameters' next step is the same without them."""
    for state in optimizer.state.values():
        first, second = state.get("exp_avg"), state.get("exp_avg_sq")
        if first is not None and second is not None:
            torch.hardshrink(first, FAINT_FIRST, out=first)
            torch.threshold_(second, FAINT_SECOND, 0.0)
