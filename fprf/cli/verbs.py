"""Functions of the command line for each kind of scene."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import UsageError
from ..plugins.registry import nearest

if TYPE_CHECKING:
    from ..config import TrainConfig
    from ..plugins.config import Need
    from ..training.run import Known
    from ..viewer.live import LiveViewer
    from .eval import EvalConfig


class Verbs(ABC):
    """`train` and `eval` for a config of one kind, which a run to be measured was trained with.

    Each raises UsageError for flags that the kind does not know.
    """

    @abstractmethod
    def plan(self, method: str) -> None:
        """Show what training would cost, and run nothing."""

    @abstractmethod
    def train(self, method: str, *, quiet: bool = False, view: "LiveViewer | None" = None, others: bool = False) -> Path:
        """Train to the end and return the run folder; go on with a run that is there.

        `view` shows how it goes; `others` lets the images differ from those that the run was begun with.
        """

    @abstractmethod
    def needs(self) -> "list[Need]":
        """Packages and weights that training needs and that are not here."""

    @abstractmethod
    def evaluate(self, config: "EvalConfig") -> dict[str, object]:
        """Measure a run, write metrics.json and renders, and return the metrics."""


def verbs_of(run: Path) -> Verbs:
    """Functions for the run in a folder. Raises CheckpointError where there is none."""
    from ..training.run import Run

    return Run(run).load_config()[0].verbs()


def views_of(known: "Known", split: str, names: Sequence[str] = ()) -> list[int]:
    """Views by name, or those of a split where none is named.

    Raises UsageError for a name that the run does not hold, or a split without views.
    """
    held = list(known.names)
    for name in names:
        if name not in held:
            raise UsageError(f"--views {name}: no such view in the run{nearest(name, held)} ({held[0]} … {held[-1]})")
    views = [held.index(name) for name in names] or list(known.split(split))
    if not views:
        raise UsageError(f"--split {split}: the run holds no such views; choose another split")
    return views


class FieldVerbs(Verbs):
    """Verbs on runs of fields; each calls its own module."""

    def __init__(self, config: "TrainConfig") -> None:
        self.config = config

    def plan(self, method: str) -> None:
        from .blocks import show_plan
        from .train import default_output

        show_plan(self.config, method, self.config.output or default_output(self.config, method))

    def train(self, method: str, *, quiet: bool = False, view: "LiveViewer | None" = None, others: bool = False) -> Path:
        from .train import train_scene

        return train_scene(self.config, method, quiet=quiet, view=view, others=others)

    def needs(self) -> "list[Need]":
        from ..training.prepare import decoder_needs, plugin_needs

        missing = plugin_needs(self.config)
        if any(need.what.startswith(("content.encoder", "content.decoder")) for need in missing):
            return missing
        return [*missing, *decoder_needs(self.config)]

    def evaluate(self, config: "EvalConfig") -> dict[str, object]:
        from .eval import evaluate_fields

        return evaluate_fields(config)
