"""Executor configs. `build` imports the implementation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from ..config import PluginConfig

if TYPE_CHECKING:
    from ...interfaces import Executor

__all__ = ["ExecutorConfig", "SerialConfig"]


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
