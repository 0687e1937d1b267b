import threading
from collections.abc import Hashable, Iterator

import pytest
from session_helpers import until

from fprf.page.render_worker import RenderWorker, Steps


class Workplace:
    """A worker whose work waits for a permit before each step, and remembers what it did."""

    def __init__(self, steps: int = 4) -> None:
        self.steps = steps
        self.permits = threading.Semaphore(0)
        self.log: list[tuple[Hashable, object, int]] = []
        self.closed: list[object] = []
        self.errors: list[str] = []
        self.worker: RenderWorker = RenderWorker(self.report)

    def work(self, client: Hashable, request: object) -> Steps[None]:
        try:
            for step in range(self.steps):
                self.permits.acquire()
                if request == "bad" and step == 1:
                    raise ValueError("it broke")
                self.log.append((client, request, step))
                yield
        finally:
            self.closed.append(request)

    def report(self, error: Exception) -> None:
        self.errors.append(str(error))
        raise RuntimeError("the client has gone")

    def ask(self, client: Hashable, request: object) -> None:
        self.worker.draw(client, self.work(client, request))

    def let(self, count: int) -> None:
        for _ in range(count):
            self.permits.release()

    def requests(self) -> list[object]:
        return [request for _, request, _ in self.log]


@pytest.fixture
def place() -> Iterator[Workplace]:
    place = Workplace()
    yield place
    place.let(10_000)
    place.worker.close()


def test_a_newer_request_takes_over_between_steps_and_those_between_are_never_begun(place: Workplace) -> None:
    place.worker.start()
    place.ask("a", 0)
    place.let(1)
    until(lambda: len(place.log) == 1)
    for request in range(1, 200):  # while the second step of request 0 is held
        place.ask("a", request)
    place.let(100)
    until(lambda: 199 in place.closed)
    assert {*place.requests()} == {0, 199} and place.requests().count(0) <= 2 and 0 in place.closed


def test_jobs_come_first_then_clients_in_turns_then_idle_work_in_order(place: Workplace) -> None:
    for name in ("first", "second"):
        place.worker.run_when_idle(place.work("film", name))
    for client in ("a", "b"):
        place.ask(client, client)
    jobs: list[str] = []
    for name, text in (("slider", "replaced"), ("photograph", "photograph"), ("slider", "slider")):
        place.worker.run(name, lambda text=text: jobs.append(f"{text} after {len(place.log)}"))  # type: ignore[misc]
    place.worker.start()
    until(lambda: len(jobs) == 2)
    place.let(16)
    until(lambda: len(place.closed) == 4)
    assert jobs == ["photograph after 0", "slider after 0"]
    assert place.requests() == ["a", "b"] * 4 + ["first"] * 4 + ["second"] * 4


def test_errors_are_reported_and_work_goes_on_even_where_reporting_fails(place: Workplace) -> None:
    place.worker.start()
    place.ask("a", "bad")
    place.let(2)
    until(lambda: place.errors == ["it broke"])
    place.worker.run("job", lambda: 1 / 0)
    until(lambda: len(place.errors) == 2)
    place.ask("a", "good")
    place.let(4)
    until(lambda: "good" in place.closed)


def test_a_client_that_leaves_is_dropped(place: Workplace) -> None:
    place.worker.start()
    place.ask("a", 1)
    place.let(1)
    until(lambda: len(place.log) == 1)
    place.worker.forget("a")
    place.let(10)
    until(lambda: place.closed == [1])
    assert len(place.log) <= 2


def test_closing_ends_the_thread_in_the_middle_of_work() -> None:
    place = Workplace(steps=10_000)
    place.worker.start()
    place.ask("a", 1)
    place.let(3)
    until(lambda: len(place.log) == 3)
    threading.Timer(0.05, lambda: place.let(5)).start()
    place.worker.close()
    assert place.closed == [1] and len(place.log) < 10
