"""One thread for everything that touches the model: it serves the newest request of each client and drops older ones.

Work is an iterator that is advanced step by step (a chunk of rays). Before each step a newer request of a client replaces its
older one, so stale pictures never queue, however fast a camera moves. Clients take turns step by step.
"""

import contextlib
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Generator, Hashable
from concurrent.futures import Future
from typing import Generic, TypeAlias, TypeVar

from ..errors import UsageError

T = TypeVar("T")
Request = TypeVar("Request")
Steps: TypeAlias = Generator[None, None, None]
_POLL = 0.5
"""Seconds between looks whether the worker is closed."""


class RenderWorker(Generic[Request]):
    """`work(client, request)` yields between steps; `on_error` receives what a step raised, and the worker goes on."""

    def __init__(self, work: Callable[[Hashable, Request], Steps], on_error: Callable[[Exception], None]) -> None:
        self._work, self._on_error = work, on_error
        self._change = threading.Condition()
        self._fresh: dict[Hashable, Request] = {}
        self._active: OrderedDict[Hashable, Steps] = OrderedDict()
        self._left: set[Hashable] = set()
        self._jobs: OrderedDict[Hashable, Callable[[], None]] = OrderedDict()
        self._idle_work: deque[Steps] = deque()
        self._busy = self._closed = False
        self._thread = threading.Thread(target=self._run, name="fprf-render", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def request(self, client: Hashable, request: Request) -> None:
        """Replace whatever the client requested before."""
        with self._change:
            self._left.discard(client)
            self._fresh[client] = request
            self._change.notify()

    def forget(self, client: Hashable) -> None:
        """Drop the request of a client that has disconnected."""
        with self._change:
            self._fresh.pop(client, None)
            self._left.add(client)
            self._change.notify()

    def run(self, name: Hashable, job: Callable[[], None]) -> None:
        """Run something short before the next step, in the place of a waiting job of the same name."""
        with self._change:
            self._jobs.pop(name, None)
            self._jobs[name] = job
            self._change.notify()

    def run_when_idle(self, work: Steps) -> None:
        """Advance `work` (a film) while no client waits."""
        with self._change:
            self._idle_work.append(work)
            self._change.notify()

    def result(self, name: Hashable, call: Callable[[], T]) -> T:
        """Run a call as `run` does, from another thread, and return its result. Raises what it raises."""
        done: Future[T] = Future()

        def job() -> None:
            try:
                done.set_result(call())
            except Exception as error:
                done.set_exception(error)

        self.run(name, job)
        return self._wait(done)

    def result_when_idle(self, work: Generator[None, None, T]) -> T:
        """Advance `work` while no client waits, from another thread, and return its result. Raises what it raises."""
        done: Future[T] = Future()

        def steps() -> Steps:
            try:
                done.set_result((yield from work))
            except Exception as error:
                done.set_exception(error)

        self.run_when_idle(steps())
        return self._wait(done)

    def _wait(self, done: "Future[T]") -> T:
        while True:  # waiting for ever would keep the process from ending
            try:
                return done.result(_POLL)
            except TimeoutError:
                if self._closed and not done.done():
                    raise UsageError("the viewer is ending") from None

    @property
    def idle(self) -> bool:
        """True where no client waits; work for idle times does not count."""
        with self._change:
            return not (self._busy or self._fresh or self._active or self._jobs)

    def close(self, timeout: float = 5.0) -> None:
        """Stop after the current step and drop the rest."""
        with self._change:
            self._closed = True
            self._change.notify()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join(timeout)

    def _run(self) -> None:
        while True:
            with self._change:
                self._busy = False
                while not (self._closed or self._fresh or self._active or self._jobs or self._idle_work or self._left):
                    self._change.wait()
                if self._closed:
                    break
                # Take everything that came since the last step, at once, so that older requests of a client never start.
                job = self._jobs.popitem(last=False)[1] if self._jobs else None
                fresh, self._fresh = self._fresh, {}
                left, self._left = self._left, set()
                self._busy = bool(fresh or job or self._active)
            self._drop(left | set(fresh))
            for client, request in fresh.items():
                self._active[client] = self._work(client, request)
            if job is not None:
                self._call(job)
            else:
                self._advance()
        self._drop(set(self._active))

    def _advance(self) -> None:
        """Make one step for the next client in turn, else one of the work for idle times."""
        if self._active:
            # The client in front makes one step and goes to the back.
            client, work = self._active.popitem(last=False)
            if self._call(lambda: next(work)):
                self._active[client] = work
        elif self._idle_work:
            work = self._idle_work[0]
            if not self._call(lambda: next(work)):
                self._idle_work.popleft()

    def _drop(self, clients: set[Hashable]) -> None:
        for client in clients:
            work = self._active.pop(client, None)
            if work is not None:
                self._call(work.close)

    def _call(self, call: Callable[[], object]) -> bool:
        """Return whether there may be more to do; report what was raised."""
        try:
            call()
        except StopIteration:
            return False
        except Exception as error:
            with contextlib.suppress(Exception):  # reporting can fail too, as when the client has just disconnected
                self._on_error(error)
            return False
        return True
