"""One task after the other, in this process."""

from collections.abc import Callable, Sequence
from typing import TypeVar

from ...interfaces import Executor

__all__ = ["SerialExecutor"]

Task = TypeVar("Task")
Result = TypeVar("Result")


class SerialExecutor(Executor):
    """The default: no dependency, no processes."""

    def map(self, function: Callable[[Task], Result], tasks: Sequence[Task]) -> list[Result]:
        """Results in the order of the tasks; the first error stops the rest."""
        return [function(task) for task in tasks]
