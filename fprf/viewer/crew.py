"""Films: made in the run's folder while nobody waits for a picture, and played on a client's page before that."""

import threading
import time
from collections.abc import Callable, Hashable, Iterator
from dataclasses import replace
from queue import Queue
from typing import TYPE_CHECKING

from ..errors import FprfError
from ..io.images import Picture
from ..io.video import write_video
from .cameras import Eye
from .film import FilmPlan, frames_of_film, lay_film, new_folder, path_of, taken
from .keys import between_keys
from .state import Film

if TYPE_CHECKING:
    from .render_worker import Desk
    from .renderer import Glance
    from .session import Session

__all__ = ["Crew"]

STEPS = 8.0
"""Pictures a second of a flight that is played: as many as a processor without help can make."""
_PATIENCE = 1.0
"""Seconds for one of them."""


class Crew:
    """Of one session."""

    def __init__(self, session: "Session", desk: "Desk[Glance]") -> None:
        self._session, self._desk = session, desk
        self._lock = threading.Lock()
        self._flights: dict[Hashable, threading.Event] = {}

    def film(self, plan: FilmPlan, client: Hashable | None) -> None:
        """Make a film, one at a time."""
        session = self._session
        with self._lock:
            if session.state.film.busy:
                session.say("film: one is being made; wait for it", client)
                return
            session.change(lambda state: replace(state, film=Film(0, 1)))
        threading.Thread(target=self._make, args=(plan, client), name="fprf-film", daemon=True).start()

    def play(self, client: Hashable, plan: FilmPlan, fly: Callable[[Eye], None]) -> None:
        """Show a client the flight as the film will be, coarsely; another one in the air is ended."""
        self.stop(client)
        over = threading.Event()
        with self._lock:
            self._flights[client] = over
        threading.Thread(target=self._fly, args=(client, plan, fly, over), name="fprf-flight", daemon=True).start()

    def playing(self, client: Hashable) -> bool:
        """Whether a flight is shown to a client."""
        return client in self._flights

    def stop(self, client: Hashable) -> None:
        """End a client's flight where it is."""
        with self._lock:
            over = self._flights.pop(client, None)
        if over is not None:
            over.set()

    def _fly(self, client: Hashable, plan: FilmPlan, fly: Callable[[Eye], None], over: threading.Event) -> None:
        session = self._session
        try:
            path = path_of(session.stage, plan._replace(fps=STEPS))
            last, start, frame = len(path) - 1, time.monotonic(), -1
            session.change(lambda state: replace(state, playing=True))
            while frame < last and not over.is_set():
                frame = min(last, max(frame + 1, int((time.monotonic() - start) * STEPS)))
                eye = session.stage.eye(path, frame)
                before = session.picture(client)
                session.preview(client, eye, between_keys(plan.keys, frame * (len(plan.keys) - 1) / max(1, last)))
                fly(eye)
                # As fast as pictures come: where a newer camera replaced each older one, none would be seen.
                until = time.monotonic() + _PATIENCE
                while not over.wait(1 / STEPS) and session.picture(client) is before and time.monotonic() < until:
                    pass
        except FprfError as error:
            session.say(str(error), client)
        finally:
            with self._lock:
                if self._flights.get(client) is over:
                    del self._flights[client]
                flying = bool(self._flights)
            session.change(lambda state: replace(state, playing=flying))
            session.look_again(client)

    def _make(self, plan: FilmPlan, client: Hashable | None) -> None:
        session = self._session
        trained = session.trained
        try:
            folder = new_folder(trained.run.root)
            lay_film(folder, session.stage, plan, trained.known.facts.semantic_encoder)
            frames: Queue[Picture | None] = Queue(2)
            failed: list[Exception] = []
            self._desk.spare(_watched(frames_of_film(folder, trained, frames, self._progress), failed))
            write_video(folder / "film.mp4", taken(frames), plan.fps)
            if failed:
                raise failed[0]
        except Exception as error:  # whatever it is, the next film can be made
            session.change(lambda state: replace(state, film=Film()))
            session.say(f"film: {error}", client)
            return
        session.change(lambda state: replace(state, film=replace(state.film, path=folder / "film.mp4")))
        session.say(f"film: {folder / 'film.mp4'}")

    def _progress(self, done: int, total: int) -> None:
        self._session.change(lambda state: replace(state, film=Film(done, total)))


def _watched(frames: Iterator[None], failed: list[Exception]) -> Iterator[None]:
    """The work, remembering what went wrong for who waits for its end."""
    try:
        yield from frames
    except Exception as error:
        failed.append(error)
        raise
