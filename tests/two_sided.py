"""Two-sided AdaIN alone: `region-tone` without its colours, its light and its smoothing."""

from typing import Any

from fprf.plugins.stylizers.config import RegionToneConfig


def region_adain(**fields: Any) -> RegionToneConfig:
    """Each region's features channel by channel to those of its match, in full."""
    alone = {"features": 1.0, "colours": 0.0, "light": False, "temperature": 0.4, "smoothness": 0.0}
    return RegionToneConfig(**{**alone, **fields})
