"""Presets: settings of a style by name, built from the controls that `StyleConfig` has. No torch.

A row of `PRESETS` is all that a new preset needs: verbs that restyle take its name as a flag (`--gentle`), the viewer shows a
button, and `TrainedScene.stylize` takes it as `preset`.
"""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, TypeVar

from ..errors import UsageError
from ..plugins.registry import nearest

__all__ = ["PRESETS", "preset_flags", "with_preset"]

C = TypeVar("C")

PRESETS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        "gentle": MappingProxyType({"strength": 0.9, "luminance": 0.2, "blend": 0.2, "stylizer.smoothness": 128.0}),
    }
)
"""Values by dotted field of `StyleConfig`. `gentle`: safe on photographs, still clearly in the style (docs/styles.md)."""


def with_preset(config: C, name: str) -> C:
    """The config, a dataclass with the fields of `StyleConfig` that the preset sets, with its values.

    What the config's stylizer does not have is left out. Raises UsageError for an unknown name.
    """
    if name not in PRESETS:
        raise UsageError(f"preset {name!r}: no such preset{nearest(name, list(PRESETS))}; there is {', '.join(PRESETS)}")
    for path, value in PRESETS[name].items():
        config = _with(config, path.split("."), value)
    return config


def preset_flags(name: str) -> str:
    """What a preset sets, as flags."""
    return " ".join(f"--{path.replace('_', '-')} {value:g}" for path, value in PRESETS[name].items())


def _with(config: Any, path: list[str], value: float) -> Any:
    first, *rest = path
    if not hasattr(config, first):
        return config
    return replace(config, **{first: _with(getattr(config, first), rest, value) if rest else value})
