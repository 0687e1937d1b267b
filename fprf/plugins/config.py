"""The root of every config that is chosen by name."""

from dataclasses import dataclass
from typing import ClassVar

__all__ = ["PluginConfig"]


@dataclass(frozen=True, kw_only=True)
class PluginConfig:
    """A config whose concrete type is an entry point. A field annotated with an abstract subclass (one that sets
    `group`) is a *slot*: `--path.to.slot NAME` fills it, and the chosen config's own fields become flags.

    Each kind declares its own `build(...)`, which imports the implementation: config modules import no torch.
    """

    group: ClassVar[str]
