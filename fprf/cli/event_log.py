"""Training as it goes, kept in the run's events.jsonl."""

import time
from typing import TYPE_CHECKING

from .progress import LINE_SECONDS

if TYPE_CHECKING:
    from ..training.run import Run
    from ..training.trainer import Report

__all__ = ["EventLog"]


class EventLog:
    """Lines for events.jsonl, not more often than every few seconds, and the last one always."""

    def __init__(self, folder: "Run") -> None:
        self.folder, self.last = folder, -LINE_SECONDS

    def __call__(self, event: "Report") -> None:
        """A line for the event, if one is due."""
        now = time.perf_counter()
        if now - self.last < LINE_SECONDS and event.share < 1:
            return
        self.last = now
        self.folder.log(
            {
                "step": event.step,
                "seconds": round(event.seconds, 2),
                "psnr": round(event.psnr, 3),
                "rays_per_second": round(event.rays_per_second),
                "kept": round(event.kept, 4),
                "skipped_steps": event.skipped,
                "losses": {name: float(f"{value:.4g}") for name, value in event.losses.items()},
            }
        )
