"""The root of every config that is chosen by name."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple


class Need(NamedTuple):
    """Something that a plug-in lacks on this machine."""

    what: str
    """Name of what is missing, for example `the package transformers`."""
    remedy: str
    """The command that installs it, or what else to do."""
    downloaded: bool = False
    """`build` downloads it where there is a network."""


@dataclass(frozen=True, kw_only=True)
class PluginConfig:
    """A config whose concrete type is an entry point. A field annotated with an abstract subclass (one that
    sets `group`) is a *slot*: `--path.to.slot NAME` fills it, and the chosen config's own fields become
    flags.

    Each kind declares its own `build(...)`, which imports the implementation: config modules import no torch.
    """

    group: ClassVar[str]

    @classmethod
    def of_number(cls, number: int) -> "PluginConfig | None":
        """The config that a whole number stands for in a slot of this kind, on the command line and in files.

        By default none. Raises ConfigError for numbers out of range.
        """
        return None

    def needs(self) -> tuple[Need, ...]:
        """Packages and files that `build` wants and that are not here, found without building or downloading
        anything.

        `fprf train` shows the needs of all plug-ins at once, before any work, and `fprf doctor METHOD`
        beforehand; of a format of files `fprf restyle` and `fprf export`. By default none. A slot's own
        plug-in is asked for itself.
        """
        return ()


def absent_file(path: Path | None) -> tuple[Need, ...]:
    """The need for a file of weights that is named and not there; none where no file is named."""
    if path is None or path.is_file():
        return ()
    return (Need(f"{path}: no such weights file", "name one that exists"),)
