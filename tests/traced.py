"""The order in which functions are called, for what docs draw."""

import sys
import threading
from collections.abc import Callable, Iterable
from types import FrameType
from typing import Any

from tools.flows import FLOWS, Step, function_of


def order_of_calls(steps: Iterable[Step], work: Callable[[], object], *, first: bool = True) -> list[str]:
    """Names of the steps by when each is called first, or last, in any thread that the work starts."""
    names = {}
    for step in steps:
        names[function_of(step).__code__] = step.code
    found: list[str] = []
    lock = threading.Lock()

    def hear(frame: FrameType, event: str, arg: Any) -> None:
        name = names.get(frame.f_code)
        if event != "call" or name is None:
            return
        with lock:
            if name in found and not first:
                found.remove(name)
            if name not in found:
                found.append(name)

    before = sys.getprofile()
    threading.setprofile(hear)
    sys.setprofile(hear)
    try:
        work()
    finally:
        sys.setprofile(before)
        threading.setprofile(None)
    return found


def lane(flow: str, number: int) -> list[Step]:
    """Steps of a drawing's column that are Python."""
    return [step for step in FLOWS[flow][number].steps if not step.is_script]


def codes(steps: Iterable[Step]) -> list[str]:
    return [step.code for step in steps]
