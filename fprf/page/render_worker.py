"""One thread for everything that touches the model, which it does step by step.

Jobs are short and come first. Then clients take turns, a step each (a chunk of rays); what remains is for
idle times. Newer work takes the place of older work of its name between two steps, so stale pictures never
queue, however fast a camera moves.
"""

import contextlib
import enum
import threading
from collections.abc import Callable, Generator, Hashable
from concurrent.futures import CancelledError, Future
from functools import partial
from typing import Any, NamedTuple, TypeAlias, TypeVar

from ..errors import UsageError

T = TypeVar("T")
Steps: TypeAlias = Generator[None, None, T]


class _Order(enum.IntEnum):
    """Order of work."""

    JOB = 0
    CLIENT = 1
    IDLE = 2


class _Work(NamedTuple):
    """Steps, and what becomes of them."""

    steps: Steps[Any]
    done: Future[Any]


class RenderWorker:
    """`on_error` receives what was raised by work that nobody waits for, and the worker goes on."""

    def __init__(self, on_error: Callable[[Exception], None]) -> None:
        self._on_error = on_error
        self._change = threading.Condition()
        # Work by its order and name; among that of the same order the first one is next.
        self._work: dict[tuple[_Order, Hashable], _Work] = {}
        self._dropped: list[Steps[Any]] = []
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="fprf-render", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def draw(self, client: Hashable, steps: Steps[None]) -> None:
        """Advance a client's picture, in the place of the one before, in turn with those of other clients."""
        self._add((_Order.CLIENT, client), steps).add_done_callback(self._report)

    def run(self, name: Hashable, job: Callable[[], object]) -> None:
        """Run something short before the next step, in the place of a waiting job of the same name."""
        self._add((_Order.JOB, name), _once(job)).add_done_callback(self._report)

    def run_when_idle(self, steps: Steps[None]) -> None:
        """Advance `steps` while no client waits; work for idle times is done in its order."""
        self._add((_Order.IDLE, object()), steps).add_done_callback(self._report)

    def result(self, job: Callable[[], T]) -> T:
        """Run a job from another thread and return its result. Raises what it raises, UsageError where the
        viewer ends.
        """
        return self._wait(self._add((_Order.JOB, object()), _once(job)))

    def result_when_idle(self, steps: Steps[T]) -> T:
        """Advance `steps` while no client waits, from another thread, and return their result. Raises as
        `result`.
        """
        return self._wait(self._add((_Order.IDLE, object()), steps))

    def forget(self, client: Hashable) -> None:
        """Drop the picture of a client that has disconnected."""
        with self._change:
            self._drop((_Order.CLIENT, client))

    def close(self, timeout: float = 5.0) -> None:
        """Stop after the current step and drop the rest."""
        with self._change:
            self._closed = True
            for key in [*self._work]:
                self._drop(key)
            self._change.notify()
        if self._thread.is_alive():
            self._thread.join(timeout)

    def _add(self, key: tuple[_Order, Hashable], steps: Steps[T]) -> "Future[T]":
        done: Future[T] = Future()
        with self._change:
            self._drop(key)
            self._work[key] = _Work(steps, done)
            if self._closed:
                self._drop(key)
            self._change.notify()
        return done

    def _drop(self, key: tuple[_Order, Hashable]) -> None:
        """Take work out; its generator is closed by the thread that ran it, for it may be in the middle of a
        step.
        """
        if (work := self._work.pop(key, None)) is not None:
            self._dropped.append(work.steps)
            work.done.cancel()
            self._change.notify()

    def _run(self) -> None:
        while True:
            with self._change:
                while not (self._work or self._dropped or self._closed):
                    self._change.wait()
                for steps in self._dropped:
                    steps.close()
                self._dropped.clear()
                if self._closed:
                    return
                if not self._work:
                    continue
                # The first of the most urgent order.
                key = min(self._work, key=lambda key: key[0])
                steps, done = self._work[key]
            outcome: Callable[[], None] | None = None
            try:
                next(steps)
            except StopIteration as end:
                outcome = partial(done.set_result, end.value)
            except Exception as error:
                outcome = partial(done.set_exception, error)
            with self._change:
                if done.cancelled():  # newer work has its place
                    continue
                # What is over goes, a client goes to the back, and work for idle times stays in front.
                if outcome is not None or key[0] == _Order.CLIENT:
                    del self._work[key]
                if outcome is not None:
                    outcome()
                elif key[0] == _Order.CLIENT:
                    self._work[key] = _Work(steps, done)

    def _report(self, done: "Future[Any]") -> None:
        if not done.cancelled() and isinstance(error := done.exception(), Exception):
            with contextlib.suppress(
                Exception
            ):  # reporting can fail too, as when the client has just disconnected
                self._on_error(error)

    def _wait(self, done: "Future[T]") -> T:
        try:
            return done.result()
        except CancelledError:
            raise UsageError("the viewer is ending") from None


def _once(job: Callable[[], T]) -> Steps[T]:
    yield from ()
    return job()
