"""Executor configs. `build` imports the implementation."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

from ...checks import at_least, positive
from ..config import Need, PluginConfig

if TYPE_CHECKING:
    from ...interfaces import Executor


@dataclass(frozen=True, kw_only=True)
class ExecutorConfig(PluginConfig):
    """Runs independent tasks."""

    group: ClassVar[str] = "fprf.executors"

    def on(self, device: str) -> ExecutorConfig:
        """The config for tasks that train on a kind of device (cpu, cuda, mps): another one where executors
        reserve devices.
        """
        return self

    def build(self) -> Executor:
        """The executor."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class SerialConfig(ExecutorConfig):
    """One task after the other, in this process."""

    def build(self) -> Executor:
        from .executors import SerialExecutor

        return SerialExecutor()


@dataclass(frozen=True, kw_only=True)
class RayConfig(ExecutorConfig):
    """Tasks on many processes or machines, by Ray (`pip install "fprf[cluster]"`; docs/large-scenes.md)."""

    address: str = ""
    """Address of a running cluster, HOST:PORT, or auto for the one of this machine; empty = one is started
    here.
    """
    workers: int = 2
    """Tasks at a time, where the cluster is started here."""
    processors: float = 1.0
    """Processors that a task takes; the cluster runs as many tasks as have room."""
    gpus: float | None = None
    """GPUs that a task takes, or its share of one; 0 hides them from it. None = 1 where training is on CUDA,
    else 0.
    """
    retries: int = 3
    """Times that a task whose worker died is started again."""

    def __post_init__(self) -> None:
        at_least("executor.workers", self.workers, 1)
        positive("executor.processors", self.processors)
        at_least("executor.retries", self.retries, 0)
        if self.gpus is not None:
            at_least("executor.gpus", self.gpus, 0.0)

    def needs(self) -> tuple[Need, ...]:
        if importlib.util.find_spec("ray") is not None:
            return ()
        return (Need("the package ray", "pip install 'fprf[cluster]', or choose --executor serial"),)

    def on(self, device: str) -> RayConfig:
        """With the GPUs that tasks on this device take."""
        if self.gpus is not None:
            return self
        return replace(self, gpus=float(device == "cuda"))

    def build(self) -> Executor:
        from .executors import RayExecutor

        return RayExecutor(self)
