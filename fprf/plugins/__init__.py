"""The plug-in mechanism (registry, slots, codec) and the built-in plug-ins, registered as a stranger's would be."""

from .config import PluginConfig
from .registry import installed, load, name_of

__all__ = ["PluginConfig", "installed", "load", "name_of"]
