"""The serial executor."""

import pytest

from fprf.plugins.executors.config import SerialConfig
from fprf.plugins.executors.executors import SerialExecutor
from fprf.testing import check_executor


def test_the_contract() -> None:
    check_executor(SerialConfig())
    assert isinstance(SerialConfig().build(), SerialExecutor)


def test_the_first_error_stops_the_rest() -> None:
    seen: list[int] = []

    def work(task: int) -> float:
        seen.append(task)
        return 1 / task

    with pytest.raises(ZeroDivisionError):
        SerialExecutor().map(work, [2, 0, 1])
    assert seen == [2, 0]
