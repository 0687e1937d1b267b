"""Executor configs. `build` imports the implementation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from ...checks import at_least, positive
from ..config import PluginConfig

if TYPE_CHECKING:
    from ...interfaces import Executor

__all__ = ["ExecutorConfig", "RayConfig", "SerialConfig"]


@dataclass(frozen=True, kw_only=True)
class ExecutorConfig(PluginConfig):
    """Runs independent tasks."""

    group: ClassVar[str] = "fprf.executors"

    def build(self) -> Executor:
        """The executor."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class SerialConfig(ExecutorConfig):
    """One task after the other, in this process."""

    def build(self) -> Executor:
        """The executor."""
        from .serial import SerialExecutor

        return SerialExecutor()


@dataclass(frozen=True, kw_only=True)
class RayConfig(ExecutorConfig):
    """Tasks on many processes or machines, by Ray (`pip install "fprf[cluster]"`; `fprf cluster` explains)."""

    address: str = ""
    """Where a cluster runs, HOST:PORT, or auto for the one of this machine; empty = one is started here."""
    workers: int = 2
    """Tasks at a time, where the cluster is started here."""
    processors: float = 1.0
    """Processors that a task takes; the cluster runs as many tasks as have room."""
    retries: int = 3
    """How often a task whose worker died is started again."""

    def __post_init__(self) -> None:
        at_least("executor.workers", self.workers, 1)
        positive("executor.processors", self.processors)
        at_least("executor.retries", self.retries, 0)

    def build(self) -> Executor:
        """The executor."""
        from .ray import RayExecutor

        return RayExecutor(self)
