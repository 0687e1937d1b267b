"""The base of verbs that packages add to `fprf`. Imports no torch."""

from dataclasses import dataclass
from typing import ClassVar

from ..plugins.config import PluginConfig


@dataclass(frozen=True, kw_only=True)
class CommandConfig(PluginConfig):
    """A verb: `fprf NAME` parses its fields as flags and calls `run`. Its docstring is the first text of
    `--help`.

    Fields may be slots. The built-in verbs are listed in `fprf.cli.VERBS` with their usage, which help shows
    without importing them and an entry point cannot hold.
    """

    group: ClassVar[str] = "fprf.commands"
    positional: ClassVar[tuple[str, ...]] = ()
    """Fields that are given without a flag, in this order, and must be given."""

    def run(self) -> int:
        """Run the verb; return the exit code, 0 = done. Raise FprfError for a mistake of the user."""
        raise NotImplementedError
