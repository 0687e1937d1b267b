"""What `events.jsonl` tells of training, as TensorBoard's event files."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import UsageError

if TYPE_CHECKING:
    from ..training.events import History

__all__ = ["write_scalars"]


def write_scalars(folder: Path, histories: Sequence["History"]) -> int:
    """One run of TensorBoard for the training and each block, replaced if it is there; how many values were written.

    Times are those of training, so that a resumed run has no gap. Raises UsageError without the package `tensorboard`.
    """
    try:
        from torch.utils.tensorboard.writer import SummaryWriter
    except ImportError as fault:
        raise UsageError("--tensorboard: the package tensorboard is not installed; pip install 'fprf[tensorboard]'") from fault
    written = 0
    for history in histories:
        place = folder / (history.name or "training")
        shutil.rmtree(place, ignore_errors=True)
        writer = SummaryWriter(str(place))
        try:
            for name, values in history.values.items():
                for step, seconds, value in zip(history.step, history.seconds, values, strict=True):
                    if value is not None:
                        writer.add_scalar(name, value, step, walltime=seconds)
                        written += 1
        finally:
            writer.close()
    return written
