"""A trained run, ready to render."""

from pathlib import Path
from typing import NamedTuple

from ..config import TrainConfig
from ..datamanagers.basis import Basis
from ..errors import CheckpointError
from ..style.scene import SceneStyle, from_tensors
from . import checkpoint
from .model import Model, build_model
from .prepare import device_of
from .run import Known, Run

__all__ = ["Trained", "load_run", "load_style"]


class Trained(NamedTuple):
    """One run in memory."""

    run: Run
    config: TrainConfig
    method: str
    known: Known
    model: Model
    step: int
    seconds: float
    """How long it was trained."""
    damaged: tuple[str, ...] = ()
    """A line for each newer checkpoint that could not be used."""


def load_run(root: Path, device: str = "auto") -> Trained:
    """Rebuild a run's model from its folder alone. Raises CheckpointError with what is missing and what to do."""
    run = Run(root)
    config, method = run.load_config()
    known = run.load_known()
    saved, damaged = checkpoint.load_latest(run.checkpoints)
    if saved is None:
        raise CheckpointError(f"{root}: no checkpoint yet; go on with `fprf train {root / 'config.json'} --output {root}`")
    model = build_model(config, known.facts)
    checkpoint.restore(saved, model, None)
    model.requires_grad_(False)
    model = model.to(device_of(device)).eval()
    return Trained(run, config, method, known, model, saved.step, saved.seconds, tuple(damaged))


def load_style(run: Run) -> tuple[SceneStyle, Basis | None]:
    """The scene's own statistics, and its semantic basis (None without semantics)."""
    scene = from_tensors(run.load_tensors("style"))
    if scene.keys.shape[1] == 0:
        return scene, None
    return scene, Basis.from_tensors(run.load_tensors("basis"))
