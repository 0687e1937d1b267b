"""Every error that a user can cause, or that names somebody else's code.

    FprfError                 one clear line: where, what was found, what is allowed, what to do
      UsageError              a flag or an argument
      ConfigError             a saved config or a config field
      PluginError             a plug-in that is missing, ambiguous, broken or of the wrong type
      DataError               a scene folder, an image, a reference photograph
        WriteError            a file that the system refuses to write
      WeightsError            encoder or decoder weights: absent, of another encoder, damaged
      CheckpointError         a run folder or a checkpoint
      NumericsError           a value that is not finite where it must be
      OutOfMemoryError        not enough memory, and nothing left that could be made smaller
      Stopped                 work that whoever was told of its progress has ended

The command line turns each into one line on standard error and exit code 2.
"""


class FprfError(Exception):
    """The root: its text is complete and meant for the user.

    Names that come from files stand in it; what a terminal would not print of them (line breaks, escapes) is
    spelled out.
    """

    def __init__(self, text: str) -> None:
        super().__init__("".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text))


class UsageError(FprfError):
    """A flag or an argument that the command line does not take."""


class ConfigError(FprfError):
    """A config value out of its range, or a saved config that the code cannot read."""


class PluginError(FprfError):
    """A plug-in that is missing, ambiguous, broken or of the wrong type."""


class DataError(FprfError):
    """A scene, an image or a reference that cannot be used as it is."""


class WriteError(DataError):
    """A file that the system refuses to write: a full disk, a folder that is only read."""


class WeightsError(FprfError):
    """Weights that are absent, damaged, or belong to something else."""


class CheckpointError(FprfError):
    """A run folder or checkpoint that cannot be read."""


class NumericsError(FprfError):
    """A value that is not finite where the computation needs one."""


class OutOfMemoryError(FprfError):
    """Not enough memory, and nothing left that could be made smaller."""


class Stopped(FprfError):
    """Work that was ended from outside: raise it in a `progress` function. What was done is kept, and the same call
    goes on from there.
    """

    def __init__(self, text: str = "stopped; the same call goes on from here") -> None:
        super().__init__(text)
