import threading
import time
from collections.abc import Hashable, Iterator

import pytest
from photographs import until

from fprf.viewer.render_worker import RenderWorker, Steps


class Bench:
    """A worker whose work waits for a permit before each step, and remembers what it did."""

    def __init__(self, steps: int = 4) -> None:
        self.steps = steps
        self.permits = threading.Semaphore(0)
        self.log: list[tuple[Hashable, object, int]] = []
        self.closed: list[object] = []
        self.faults: list[str] = []
        self.worker: RenderWorker[object] = RenderWorker(self.work, lambda error: self.faults.append(str(error)))

    def work(self, client: Hashable, request: object) -> Steps:
        try:
            for step in range(self.steps):
                self.permits.acquire()
                if request == "bad" and step == 1:
                    raise ValueError("it broke")
                self.log.append((client, request, step))
                yield
        finally:
            self.closed.append(request)

    def let(self, count: int) -> None:
        for _ in range(count):
            self.permits.release()


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    bench.let(10_000)
    bench.worker.close()


def test_a_newer_request_takes_over_between_steps_and_those_between_are_never_begun(bench: Bench) -> None:
    bench.worker.start()
    bench.worker.request("a", 0)
    bench.let(1)
    until(lambda: len(bench.log) == 1)
    for request in range(1, 200):  # while the second step of request 0 is held
        bench.worker.request("a", request)
    bench.let(100)
    until(lambda: 199 in bench.closed)
    load_unfinished = {request for _, request, _ in bench.log}
    assert load_unfinished == {0, 199}
    assert sum(request == 0 for _, request, _ in bench.log) <= 2 and 0 in bench.closed


def test_clients_take_turns(bench: Bench) -> None:
    bench.worker.request("a", "x")
    bench.worker.request("b", "y")
    bench.worker.start()
    bench.let(8)
    until(lambda: len(bench.closed) == 2)
    assert [client for client, _, _ in bench.log] == ["a", "b"] * 4


def test_a_fault_is_told_and_work_goes_on(bench: Bench) -> None:
    bench.worker.start()
    bench.worker.request("a", "bad")
    bench.let(2)
    until(lambda: bench.faults == ["it broke"])
    bench.worker.request("a", "good")
    bench.let(4)
    until(lambda: "good" in bench.closed)


def test_even_where_telling_fails() -> None:
    def fault(error: Exception) -> None:
        raise RuntimeError("nobody there")

    done = threading.Event()

    def work(client: Hashable, request: object) -> Steps:
        if request == "bad":
            raise ValueError
        done.set()
        yield

    worker: RenderWorker[object] = RenderWorker(work, fault)
    worker.start()
    worker.request("a", "bad")
    worker.run("errand", lambda: 1 / 0)
    worker.request("b", "good")
    assert done.wait(10)
    worker.close()


def test_who_leaves_is_dropped(bench: Bench) -> None:
    bench.worker.start()
    bench.worker.request("a", 1)
    bench.let(1)
    until(lambda: len(bench.log) == 1)
    bench.worker.forget("a")
    bench.let(10)
    until(lambda: bench.closed == [1])
    time.sleep(0.02)
    assert len(bench.log) <= 2


def test_errands_come_first_and_only_the_last_of_a_name(bench: Bench) -> None:
    done: list[str] = []
    bench.worker.request("a", 1)
    bench.worker.run("slider", lambda: done.append("old"))
    bench.worker.run("photo", lambda: done.append("photo"))
    bench.worker.run("slider", lambda: done.append("new"))
    bench.worker.start()
    until(lambda: len(done) == 2)
    assert done == ["photo", "new"] and bench.log == []


def test_spare_work_waits_for_clients_and_is_done_in_order(bench: Bench) -> None:
    bench.worker.run_when_idle(bench.work("film", "first"))
    bench.worker.run_when_idle(bench.work("film", "second"))
    bench.worker.request("a", 1)
    bench.worker.start()
    bench.let(12)
    until(lambda: len(bench.closed) == 3)
    assert [request for _, request, _ in bench.log] == [1] * 4 + ["first"] * 4 + ["second"] * 4


def test_closing_ends_the_thread_in_the_middle_of_work() -> None:
    bench = Bench(steps=10_000)
    bench.worker.start()
    bench.worker.request("a", 1)
    bench.let(3)
    until(lambda: len(bench.log) == 3)
    threading.Timer(0.05, lambda: bench.let(5)).start()
    bench.worker.close()
    assert bench.closed == [1] and len(bench.log) < 10


def test_many_threads_ask_at_once(bench: Bench) -> None:
    bench.worker.start()
    bench.let(100_000)
    threads = [
        threading.Thread(target=lambda n=n: [bench.worker.request(n, request) for request in range(50)]) for n in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    until(lambda: all(any((n, 49, 3) == entry for entry in bench.log) for n in range(8)))
    for n in range(8):
        requests = [request for client, request, _ in bench.log if client == n]
        assert requests == sorted(requests)  # never an older one after a newer one
