"""Trained runs of any kind, opened by the entry point of their kind."""

from pathlib import Path
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

from ..errors import PluginError
from ..plugins.registry import entry, load_object
from ..run_config import RunConfig
from ..scenes import Scene
from .quality import QualityConfig, at_quality
from .run import Known, Run

if TYPE_CHECKING:
    from .field_scene import Trained

SCENES = "fprf.scenes"
"""Entry points by the `kind` of configs: functions `(run, config, device, quality) -> LoadedRun` that open
their runs.
"""
S = TypeVar("S", bound=Scene, covariant=True)


class LoadedRun(NamedTuple, Generic[S]):
    """A run in memory, whatever its scene is made of."""

    run: Run
    method: str
    known: Known
    step: int
    seconds: float
    """Training time."""
    scene: S


def open_run(root: Path, device: str = "auto", quality: QualityConfig | None = None) -> LoadedRun[Scene]:
    """A run of any kind, by the function that the entry-point group `fprf.scenes` names for the kind of its
    config.

    Of a run in training it is the newest checkpoint. Raises CheckpointError with what is missing, UsageError
    for qualities that the kind does not know, PluginError where the kind is not installed.
    """
    run = Run(root)
    config = run.load_config()[0]
    opened = load_object(SCENES, config.kind)
    if not callable(opened):
        raise PluginError(
            f"{SCENES}: {config.kind!r} ({entry(SCENES, config.kind).origin}) is no function; mend that package"
        )
    loaded: LoadedRun[Scene] = opened(run, config, device, QualityConfig() if quality is None else quality)
    return loaded


def open_fields(run: Run, config: RunConfig, device: str, quality: QualityConfig) -> "LoadedRun[Trained]":
    """A run of fields; imports what they are made of."""
    from .field_scene import load_run

    trained = at_quality(load_run(run.root, device, quality.max_memory), quality)
    return LoadedRun(run, trained.method, trained.known, trained.step, trained.seconds, trained)
