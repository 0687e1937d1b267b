"""One worker for everything that touches the model: the newest request of each client, never an older one.

Work is an iterator that is advanced step by step (a chunk of rays). Before each step the worker looks at what has come in:
a newer request of a client takes the place of its older one, which is dropped where it stands. So stale pictures never
queue, however fast a camera moves. Clients take turns step by step. `do` runs something small before the next step; of
several with one name only the last is run. `spare` is work for when nobody waits (a film).
"""

import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Iterator
from typing import Generic, TypeVar

__all__ = ["Desk"]

Request = TypeVar("Request")


class Desk(Generic[Request]):
    """`work(client, request)` is what there is to do for a request; `fault` is told of what went wrong, and all goes on."""

    def __init__(
        self, work: Callable[[Hashable, Request], Iterator[None]], fault: Callable[[Hashable | None, Exception], None]
    ) -> None:
        self._work, self._fault = work, fault
        self._change = threading.Condition()
        self._fresh: dict[Hashable, Request] = {}
        self._active: OrderedDict[Hashable, Iterator[None]] = OrderedDict()
        self._left: set[Hashable] = set()
        self._errands: OrderedDict[Hashable, Callable[[], None]] = OrderedDict()
        self._spare: deque[Iterator[None]] = deque()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="fprf-render", daemon=True)

    def start(self) -> None:
        """Begin to work."""
        self._thread.start()

    def ask(self, client: Hashable, request: Request) -> None:
        """What a client wants now, instead of whatever it wanted before."""
        with self._change:
            self._left.discard(client)
            self._fresh[client] = request
            self._change.notify()

    def leave(self, client: Hashable) -> None:
        """A client has gone: drop what it wanted."""
        with self._change:
            self._fresh.pop(client, None)
            self._left.add(client)
            self._change.notify()

    def do(self, name: Hashable, errand: Callable[[], None]) -> None:
        """Run something on the worker, before any more rendering; it takes the place of an errand of the same name."""
        with self._change:
            self._errands.pop(name, None)
            self._errands[name] = errand
            self._change.notify()

    def spare(self, work: Iterator[None]) -> None:
        """Work for when no client waits."""
        with self._change:
            self._spare.append(work)
            self._change.notify()

    @property
    def idle(self) -> bool:
        """Nobody waits for anything; spare work does not count."""
        with self._change:
            return not (self._fresh or self._active or self._errands)

    @property
    def closed(self) -> bool:
        """Nothing more will be done."""
        return self._closed

    def close(self, timeout: float = 5.0) -> None:
        """Stop after the step at hand; work that is left is dropped."""
        with self._change:
            self._closed = True
            self._change.notify()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join(timeout)

    def _run(self) -> None:
        while True:
            with self._change:
                while not (self._closed or self._fresh or self._active or self._errands or self._spare or self._left):
                    self._change.wait()
                if self._closed:
                    break
                errand = self._errands.popitem(last=False)[1] if self._errands else None
                fresh, self._fresh = self._fresh, {}
                left, self._left = self._left, set()
            self._drop(left | set(fresh))
            for client, request in fresh.items():
                self._begin(client, request)
            if errand is not None:
                self._guarded(None, errand)
            else:
                self._advance()
        self._drop(set(self._active))

    def _begin(self, client: Hashable, request: Request) -> None:
        def begin() -> None:
            self._active[client] = self._work(client, request)

        self._guarded(client, begin)

    def _advance(self) -> None:
        """One step for the client whose turn it is, else one of spare work."""
        if self._active:
            client, work = self._active.popitem(last=False)
            if self._guarded(client, lambda: next(work)):
                self._active[client] = work
        elif self._spare:
            work = self._spare[0]
            if not self._guarded(None, lambda: next(work)):
                self._spare.popleft()

    def _drop(self, clients: set[Hashable]) -> None:
        for client in clients:
            work = self._active.pop(client, None)
            close = getattr(work, "close", None)  # a generator gives back what it holds; another iterator has nothing to
            if close is not None:
                self._guarded(client, close)

    def _guarded(self, client: Hashable | None, call: Callable[[], object]) -> bool:
        """Whether there may be more to do. Whatever goes wrong is told, and stops nothing."""
        try:
            call()
        except StopIteration:
            return False
        except Exception as error:
            try:
                self._fault(client, error)
            except Exception:  # telling can fail too, as when the client has just gone
                return False
            return False
        return True
