"""Range checks for config fields: one line each, with the field's name."""

import math

from .errors import ConfigError


def _finite(name: str, value: float) -> None:
    # math.isfinite would raise on an integer too large for a float.
    if value != value or abs(value) == math.inf:
        raise ConfigError(f"{name}: {value} is not a finite number")


def positive(name: str, value: float) -> None:
    """Raise ConfigError unless value > 0."""
    _finite(name, value)
    if value <= 0:
        raise ConfigError(f"{name}: {value} must be above 0")


def at_least(name: str, value: float, low: float) -> None:
    """Raise ConfigError unless value >= low."""
    _finite(name, value)
    if value < low:
        raise ConfigError(f"{name}: {value} must be at least {low}")


def between(name: str, value: float, low: float, high: float) -> None:
    """Raise ConfigError unless low <= value <= high."""
    _finite(name, value)
    if not low <= value <= high:
        raise ConfigError(f"{name}: {value} must lie in [{low}, {high}]")
