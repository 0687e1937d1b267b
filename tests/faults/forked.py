"""Work in a forked process that may be ended anywhere."""

import os
from collections.abc import Callable

DEAD = 73


def forked(work: Callable[[], object]) -> int:
    """The exit code of a process that did the work: 0 done, 1 an exception."""
    process = os.fork()
    if process == 0:
        code = 1
        try:
            work()
            code = 0
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


class Deadly:
    """Ends the process before the `at`-th call of whatever it was put around, as a kill would: nothing is cleaned up."""

    NAMES = ("open", "fsync", "replace", "unlink", "rmdir", "mkdir", "close")

    def __init__(self, at: int) -> None:
        self.left = at

    def around(self, function: Callable[..., object]) -> Callable[..., object]:
        def call(*args: object, **named: object) -> object:
            if self.left == 0:
                os._exit(DEAD)
            self.left -= 1
            return function(*args, **named)

        return call
