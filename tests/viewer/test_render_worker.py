import threading
import time
from collections.abc import Callable, Hashable, Iterator

import pytest

from fprf.viewer.render_worker import Desk

Told = list[tuple[Hashable | None, str]]


class Bench:
    """A desk whose work waits for a permit before each step, and remembers what it did."""

    def __init__(self, steps: int = 4) -> None:
        self.steps = steps
        self.permits = threading.Semaphore(0)
        self.log: list[tuple[Hashable, object, int]] = []
        self.closed: list[object] = []
        self.faults: Told = []
        self.desk: Desk[object] = Desk(self.work, lambda client, error: self.faults.append((client, str(error))))

    def work(self, client: Hashable, request: object) -> Iterator[None]:
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
    bench.desk.close()


def until(true: Callable[[], bool]) -> None:
    for _ in range(2000):
        if true():
            return
        time.sleep(0.005)
    raise AssertionError("it never came")


def test_a_request_is_worked_off(bench: Bench) -> None:
    bench.desk.start()
    bench.desk.ask("a", 1)
    bench.let(4)
    until(lambda: bench.closed == [1])
    assert bench.log == [("a", 1, step) for step in range(4)]


def test_a_newer_request_takes_over_between_steps_and_those_between_are_never_begun(bench: Bench) -> None:
    bench.desk.start()
    bench.desk.ask("a", 0)
    bench.let(1)
    until(lambda: len(bench.log) == 1)
    for request in range(1, 200):  # while the second step of request 0 is held
        bench.desk.ask("a", request)
    bench.let(100)
    until(lambda: 199 in bench.closed)
    begun = {request for _, request, _ in bench.log}
    assert begun == {0, 199}
    assert sum(request == 0 for _, request, _ in bench.log) <= 2 and 0 in bench.closed


def test_clients_take_turns(bench: Bench) -> None:
    bench.desk.ask("a", "x")
    bench.desk.ask("b", "y")
    bench.desk.start()
    bench.let(8)
    until(lambda: len(bench.closed) == 2)
    assert [client for client, _, _ in bench.log] == ["a", "b"] * 4


def test_a_fault_is_told_and_work_goes_on(bench: Bench) -> None:
    bench.desk.start()
    bench.desk.ask("a", "bad")
    bench.let(2)
    until(lambda: bench.faults == [("a", "it broke")])
    bench.desk.ask("a", "good")
    bench.let(4)
    until(lambda: "good" in bench.closed)


def test_even_where_telling_fails() -> None:
    def fault(client: Hashable | None, error: Exception) -> None:
        raise RuntimeError("nobody there")

    done = threading.Event()

    def work(client: Hashable, request: object) -> Iterator[None]:
        if request == "bad":
            raise ValueError
        done.set()
        yield

    desk: Desk[object] = Desk(work, fault)
    desk.start()
    desk.ask("a", "bad")
    desk.do("errand", lambda: 1 / 0)
    desk.ask("b", "good")
    assert done.wait(10)
    desk.close()


def test_who_leaves_is_dropped(bench: Bench) -> None:
    bench.desk.start()
    bench.desk.ask("a", 1)
    bench.let(1)
    until(lambda: len(bench.log) == 1)
    bench.desk.leave("a")
    bench.let(10)
    until(lambda: bench.closed == [1])
    time.sleep(0.02)
    assert len(bench.log) <= 2


def test_errands_come_first_and_only_the_last_of_a_name(bench: Bench) -> None:
    done: list[str] = []
    bench.desk.ask("a", 1)
    bench.desk.do("slider", lambda: done.append("old"))
    bench.desk.do("photo", lambda: done.append("photo"))
    bench.desk.do("slider", lambda: done.append("new"))
    bench.desk.start()
    until(lambda: len(done) == 2)
    assert done == ["photo", "new"] and bench.log == []


def test_spare_work_waits_for_clients_and_is_done_in_order(bench: Bench) -> None:
    bench.desk.spare(bench.work("film", "first"))
    bench.desk.spare(bench.work("film", "second"))
    bench.desk.ask("a", 1)
    bench.desk.start()
    bench.let(12)
    until(lambda: len(bench.closed) == 3)
    assert [request for _, request, _ in bench.log] == [1] * 4 + ["first"] * 4 + ["second"] * 4


def test_a_broken_film_makes_way_for_the_next(bench: Bench) -> None:
    bench.desk.spare(bench.work("film", "bad"))
    bench.desk.spare(bench.work("film", "second"))
    bench.desk.start()
    bench.let(8)
    until(lambda: "second" in bench.closed)
    assert bench.faults == [(None, "it broke")]


def test_closing_ends_the_thread_in_the_middle_of_work() -> None:
    bench = Bench(steps=10_000)
    bench.desk.start()
    bench.desk.ask("a", 1)
    bench.let(3)
    until(lambda: len(bench.log) == 3)
    threading.Timer(0.05, lambda: bench.let(5)).start()
    bench.desk.close()
    assert bench.closed == [1] and len(bench.log) < 10


def test_many_threads_ask_at_once(bench: Bench) -> None:
    bench.desk.start()
    bench.let(100_000)
    threads = [threading.Thread(target=lambda n=n: [bench.desk.ask(n, request) for request in range(50)]) for n in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    until(lambda: all(any((n, 49, 3) == entry for entry in bench.log) for n in range(8)))
    for n in range(8):
        requests = [request for client, request, _ in bench.log if client == n]
        assert requests == sorted(requests)  # never an older one after a newer one
