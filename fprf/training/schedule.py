"""How far training is, and the learning rate that goes with it."""

import math

from ..config import OptimizerConfig, RunConfig

__all__ = ["progress", "rate"]


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
