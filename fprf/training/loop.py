"""Parts of a training loop: schedule, interrupts, and numbers that are not finite."""

import math
import signal
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from types import FrameType

import torch
from torch import Tensor, nn

from ..config import OptimizerConfig, RunConfig


def progress(config: RunConfig, step: int, seconds: float) -> float:
    """Share of the way, 0 to 1: by steps or by minutes, whichever is further."""
    share = step / config.steps if config.steps else 1.0
    if config.minutes is not None:
        share = max(share, seconds / (60 * config.minutes))
    return min(1.0, share)


def rate(config: OptimizerConfig, step: int, share: float) -> float:
    """Linear warm-up, then a cosine from `rate` to `final * rate`, and 1 / sqrt(step) from `hold` on."""
    late = 1.0 if config.hold is None else math.sqrt(config.hold / max(config.hold, step))
    warm = min(1.0, (step + 1) / max(1, config.warm_up))
    cosine = 0.5 * (1 + math.cos(math.pi * share))
    return config.rate * warm * late * (config.final + (1 - config.final) * cosine)


_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stop:
    """Requests to stop."""

    def __init__(self) -> None:
        self.asked = False
        """Once: end when the step is done."""
        self.hurried = False
        """Twice: ended within a step, so that what is in memory is of no use."""

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Take note of a signal; the second raises KeyboardInterrupt wherever the program is."""
        self.hurried = self.asked
        self.asked = True
        if self.hurried:
            raise KeyboardInterrupt

    def obey(self) -> None:
        """Raise KeyboardInterrupt if it was asked for."""
        if self.asked:
            raise KeyboardInterrupt


@contextmanager
def held_back() -> Iterator[Stop]:
    """Hold signals back inside the block, and as before after it. Other threads than the first cannot, and don't."""
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.signal(number, stop) for number in _SIGNALS}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


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
    gradients = [(name, p.grad) for name, p in parameters if p.grad is not None]
    if not gradients or bool(torch.nn.utils.get_total_norm([grad for _, grad in gradients]) < LARGEST):
        return None
    bad = [name for name, grad in gradients if not bool(grad.norm() < LARGEST)]
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
        row = torch.stack([values.get(name, self.none) for name in self.names]).to(self.rows.dtype)
        fit = torch.isfinite(row)
        means = SMOOTHING * self.rows[:2] + (1 - SMOOTHING) * torch.stack([row, self._present[given]])
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
