"""The scene that is viewed: its state, its clients' cameras, and everything that changes either. Knows no page.

Calls come from any thread. What touches the model happens on the desk; `Face` is told what became of it.
"""

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

from ..errors import FprfError, UsageError
from ..io.images import Picture, shrink
from ..training.loading import Trained
from .cameras import Eye, Stage, stage_of
from .crew import Crew
from .film import FilmPlan, Thumbnail
from .looks import Card, Look
from .moment import likest
from .painter import Shown
from .rehearsal import rehearsal
from .render_worker import Desk
from .renderer import Frame, Glance, Sight
from .restyler import Opener, Studio
from .state import State, dropped, renumbered
from .uploads import Intake, shown_name

__all__ = ["Face", "Session"]

_PATIENCE = 0.5
"""Seconds between looks whether the desk is closed."""
_THUMBNAIL = 192
"""Longest side of a key's picture."""


class Face(ABC):
    """What a session talks to: the page. Called from several threads; a call that fails harms nothing."""

    @abstractmethod
    def show(self, client: Hashable, frame: Frame) -> None:
        """A picture for a client."""

    @abstractmethod
    def changed(self, before: State, now: State) -> None:
        """The state is another one."""

    @abstractmethod
    def say(self, text: str, client: Hashable | None = None) -> None:
        """Something to read, for one client or for all."""


class Session:
    """Use as a context manager, which ends its threads and processes."""

    def __init__(self, trained: Trained, state: State, opened: Opener | None = None) -> None:
        self.trained = trained
        self.stage: Stage = stage_of(trained.known.cameras)
        self.studio = Studio(trained, opened)
        self.intake = Intake()
        self.state = state
        self._face: Face | None = None
        self._eyes: dict[Hashable, Eye] = {}
        self._cards: frozenset[Card] = frozenset()
        self._lock = threading.RLock()
        self._sight = Sight(trained, self.studio, self.stage, self._show)
        self._desk: Desk[Glance] = Desk(self._sight.look, self._fault)
        self._crew = Crew(self, self._desk)
        self._pictures: dict[Hashable, Picture] = {}
        self._shots = 0

    def __enter__(self) -> "Session":
        self._desk.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End everything; a film that is being made is left unfinished."""
        self._desk.close()
        self.intake.close()

    def meet(self, face: Face) -> None:
        """From now on this is who is told."""
        self._face = face

    def warm(self) -> None:
        """Make ready what the first photograph needs, while nobody waits: encoders, kernels, the process that decodes."""
        threading.Thread(target=self.intake.warm, name="fprf-warm", daemon=True).start()

        def work() -> Iterator[None]:
            yield from rehearsal(self.studio, self._sight, self.stage, self.intake.folder)
            self.studio.keep(self.state.all_cards)

        self._desk.spare(work())

    def see(self, client: Hashable, eye: Eye) -> None:
        """A client's camera is here now."""
        with self._lock:
            if self._crew.playing(client):
                return
            self._eyes[client] = eye
            self._desk.ask(client, Glance(eye, self.state.shown, self.state.pixels))

    def leave(self, client: Hashable) -> None:
        """A client has gone."""
        with self._lock:
            self._eyes.pop(client, None)
            self._pictures.pop(client, None)
        self._crew.stop(client)
        self._desk.leave(client)
        self._desk.do(("forget", client), lambda: self._sight.forget(client))

    @property
    def watched(self) -> bool:
        """Whether anybody is here."""
        return bool(self._eyes)

    @property
    def idle(self) -> bool:
        """Everybody has the sharpest picture."""
        return self._desk.idle

    def renew(self, load: Callable[[], Trained], opened: Opener | None = None) -> None:
        """The scene in another state of its training, between two steps of the desk; all that was made of it is made again."""

        def now() -> None:
            self.trained = trained = load()
            self._sight.renew(trained)
            before = self.studio.renew(trained, opened)
            if before is not None and self.state.needs_regions:
                regions = likest(before, self.studio.encoders.scene).tolist()
                self.change(lambda state: renumbered(state, regions))
            self._ask_again()
            if self.state.picked is not None:
                self.choose(self.state.picked.region)

        self._desk.do("renew", self._told(now, None))

    def say(self, text: str, client: Hashable | None = None) -> None:
        """A line to read, for one client or for all."""
        self._say(text, client)

    def change(self, to: Callable[[State], State], client: Hashable | None = None) -> bool:
        """Replace the state; all clients see it. What cannot be is said to the client, and nothing changes."""
        try:
            with self._lock:
                before, self.state = self.state, to(self.state)
                now = self.state
                if (before.shown, before.pixels) != (now.shown, now.pixels):
                    self._ask_again()
        except FprfError as error:
            self._say(str(error), client)
            return False
        if now.picked is not None and now.look != before.look:
            self.choose(now.picked.region, client)  # what it takes is another thing now
        if now != before and self._face is not None:
            self._face.changed(before, now)
        return True

    def drop(self, data: bytes, name: str) -> Card:
        """A photograph: decoded, encoded, and the scene's style from now on. Raises DataError for what is none."""
        return self.add(self.intake.take(data), shown_name(name))

    def add(self, path: Path, name: str) -> Card:
        """The same for a file of this machine."""
        done: Future[Card] = Future()

        def encode() -> None:
            try:
                card = self.studio.card(path, _free(name, self.state))
                self.change(lambda state: dropped(state, card))
                self._tidy(card)
                done.set_result(card)
            except Exception as error:
                done.set_exception(error)

        self._desk.do(("add", path), encode)
        while True:  # who waits for ever keeps the process from ending
            try:
                return done.result(_PATIENCE)
            except TimeoutError:
                if self._desk.closed and not done.done():
                    raise UsageError("the viewer is ending") from None

    def _tidy(self, card: Card) -> None:
        """Photographs that left the shelf, and that no look needs, go with what was made of them: some 6 MB each."""
        held = self.state.all_cards
        for gone in {*self._cards, card} - held:
            if gone.path.parent == self.intake.folder:
                gone.path.unlink(missing_ok=True)
        self._cards = held
        self.studio.keep(held)

    def pick(self, client: Hashable, place: tuple[float, float]) -> None:
        """A click at shares of a client's width and height: the region there is picked; of nothing, none is."""

        def find() -> None:
            eye = self._eyes.get(client)
            if eye is None:
                return
            side = 1000
            cameras = self.stage.cameras([eye], (round(side * eye.aspect), side))
            width, height = cameras.size[0].tolist()
            region = self.studio.region_at(cameras, (place[0] * width, place[1] * height))
            self._choose(region)

        self._desk.do(("pick", client), self._told(find, client))

    def choose(self, region: int | None, client: Hashable | None = None) -> None:
        """Pick a region by number, or none."""
        self._desk.do("choose", self._told(lambda: self._choose(region), client))

    def film(self, plan: FilmPlan, client: Hashable | None = None) -> None:
        """Make a film in the run's folder, while nobody waits for a picture; one at a time."""
        self._crew.film(plan, client)

    def play(self, client: Hashable, plan: FilmPlan, fly: Callable[[Eye], None]) -> None:
        """Show a client the flight; `fly` moves its camera. Its own moves count again when it is over."""
        self._crew.play(client, plan, fly)

    def preview(self, client: Hashable, eye: Eye, look: Look) -> None:
        """For one client, another look than that of all."""
        with self._lock:
            if client in self._eyes:
                self._eyes[client] = eye = eye._replace(aspect=self._eyes[client].aspect)
                self._desk.ask(client, Glance(eye, Shown(look), self.state.pixels))

    def look_again(self, client: Hashable) -> None:
        """What a client sees is to be what all see."""
        with self._lock:
            if client in self._eyes:
                self._desk.ask(client, Glance(self._eyes[client], self.state.shown, self.state.pixels))

    def land(self, client: Hashable) -> None:
        """End a client's flight where it is."""
        self._crew.stop(client)

    def picture(self, client: Hashable) -> Picture | None:
        """What a client was shown last."""
        return self._pictures.get(client)

    def thumbnail(self, client: Hashable) -> Thumbnail | None:
        """What a client sees now, small."""
        picture = self._pictures.get(client)
        if picture is None:
            return None
        self._shots += 1
        return Thumbnail(self._shots, shrink(picture, _THUMBNAIL))

    def _choose(self, region: int | None) -> None:
        count = self.studio.regions
        if region is not None and not 0 <= region < count:
            raise UsageError(f"region {region}: regions go from 0 to {count - 1}")
        picked = None if region is None else self.studio.picked(self.state.look, region)
        self.change(lambda state: replace(state, picked=picked))

    def _told(self, call: Callable[[], None], client: Hashable | None) -> Callable[[], None]:
        """The call, with what goes wrong told to the client."""

        def told() -> None:
            try:
                call()
            except FprfError as error:
                self._say(str(error), client)

        return told

    def _ask_again(self) -> None:
        """Pictures for everybody."""
        with self._lock:
            for client, eye in self._eyes.items():
                self._desk.ask(client, Glance(eye, self.state.shown, self.state.pixels))

    def _show(self, client: Hashable, frame: Frame) -> None:
        if self._face is not None and client is not None:  # a rehearsal has no one to show itself to
            self._pictures[client] = frame.picture
            self._face.show(client, frame)

    def _say(self, text: str, client: Hashable | None = None) -> None:
        if self._face is not None:
            self._face.say(text, client)

    def _fault(self, client: Hashable | None, error: Exception) -> None:
        known = isinstance(error, FprfError)
        self._say(str(error) if known else f"this should not have happened: {type(error).__name__}: {error}", client)


def _free(name: str, state: State) -> str:
    """The name, or one like it that no photograph on the shelf has."""
    taken, count, found = {card.name for card in state.shelf}, 1, name
    while found in taken:
        count += 1
        found = f"{name} ({count})"
    return found
