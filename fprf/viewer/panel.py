"""The controls beside the scene, made of viser's. Each says what it wants of the session; what the session says comes back.

Values come from a browser: whatever does not fit a look or the state is refused there, and told.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

from ..style.presets import PRESETS, preset_flags
from .cameras import Eye, fitted
from .film import FilmPlan, Key, path_of
from .keys import added, at_key, replaced
from .looks import preset
from .painter import MAPS, Map
from .session import Session
from .state import LEAST, MOST, Film, Landing, State, kept

if TYPE_CHECKING:
    import viser

__all__ = ["Panel"]

_NONE = "nothing"
_PLAY = "Play the flight"
_LANDINGS: tuple[Landing, ...] = ("alone", "in the mix")
_SIZES = {"small (480)": 480, "medium (960)": 960, "full HD (1920)": 1920}


class Panel:
    """`fly(client, eye)` moves a client's camera; `draw()` draws what lies over the scene anew."""

    def __init__(
        self,
        gui: "viser.GuiApi",
        session: Session,
        fly: Callable[["viser.ClientHandle", Eye], None],
        seen: Callable[["viser.ClientHandle"], Eye],
        draw: Callable[["Panel"], None],
    ) -> None:
        self._gui, self._session, self._fly, self._seen, self._draw = gui, session, fly, seen, draw
        self._look_controls(session.state)
        self._show_controls(session.state)
        self._kept_controls()
        self._film_controls()

    def follow(self, before: State, now: State) -> None:
        """Bring the controls to what the state says."""
        for name in ("strength", "temperature", "clusters", "blend", "luminance", "smoothness", "at"):
            self._set(self._looks[name], getattr(now.look, name))
        self._set(self._landing, now.landing)
        self._set(self._map, now.map)
        self._set(self._cover, now.cover)
        self._set(self._wipe, now.wipe is not None)
        self._set(self._picking, now.picking)
        self._set(self._pixels, now.pixels)
        names = [name for name, _ in now.saved]
        if [name for name, _ in before.saved] != names:
            self._towards.options = self._back.options = (_NONE, *names)
        toward = [name for name, look in now.saved if look == now.look.towards]
        self._set(self._towards, toward[0] if toward else _NONE)
        if before.keys != now.keys:
            self._about_keys.content = _about(now)
        if (before.keys, before.playing) != (now.keys, now.playing):
            self._draw(self)
        if before.film != now.film:
            self._progress.value = 100.0 * now.film.done / max(1, now.film.total)
            self._make.disabled = now.film.busy
            self._about_keys.content = _about(now)

    @property
    def cameras(self) -> bool:
        """Whether captured cameras are drawn."""
        return bool(self._cameras.value)

    @property
    def blocks(self) -> bool:
        """Whether the boxes of blocks are drawn."""
        return bool(self._blocks.value)

    @property
    def plan(self) -> FilmPlan:
        """The film as the controls say."""
        state = self._session.state
        aspect = state.keys[0].eye.aspect if state.keys else 1.0
        width, height = fitted(aspect, _SIZES.get(str(self._size.value), 960))
        return FilmPlan(state.keys, float(self._seconds.value), float(self._fps.value), (width // 2 * 2, height // 2 * 2))

    def _look_controls(self, state: State) -> None:
        look = state.look
        with self._gui.add_folder("Style"):
            add = self._gui.add_slider
            self._looks: dict[str, Any] = {
                "strength": add("strength", 0.0, 1.0, 0.01, look.strength, hint="0 = the scene as it was captured"),
                "temperature": add("temperature", 0.05, 2.0, 0.05, look.temperature, hint=_HINTS["temperature"]),
                "clusters": add("clusters", 1, 40, 1, look.clusters, hint=_HINTS["clusters"]),
                "blend": add("local ↔ global", 0.0, 1.0, 0.01, look.blend, hint=_HINTS["blend"]),
                "luminance": add("keep light", 0.0, 1.0, 0.01, look.luminance, hint=_HINTS["luminance"]),
                "smoothness": add("smoothness", 0, 256, 1, look.smoothness, hint=_HINTS["smoothness"]),
            }
            presets = {name: self._gui.add_button(name, hint=preset_flags(name)) for name in PRESETS}
            self._landing = self._gui.add_dropdown("new photo", _LANDINGS, initial_value=state.landing, hint=_HINTS["landing"])
        for name, control in self._looks.items():
            self._on_look(name, control)
        for name, button in presets.items():
            self._pressed(button, self._preset(name))
        self._on(self._landing, lambda value: lambda state: replace(state, landing=_one(value, _LANDINGS)))

    def _show_controls(self, state: State) -> None:
        names = self._session.trained.known.names
        with self._gui.add_folder("Show"):
            self._map = self._gui.add_dropdown("map", MAPS, initial_value=state.map, hint=_HINTS["map"])
            self._cover = self._gui.add_slider("map covers", 0.0, 1.0, 0.05, state.cover)
            self._wipe = self._gui.add_checkbox("before/after", state.wipe is not None, hint="drag the line on the picture")
            self._picking = self._gui.add_checkbox("pick a region", state.picking, hint=_HINTS["picking"])
            self._cameras = self._gui.add_checkbox("cameras", False, hint="where the images were taken")
            self._blocks = self._gui.add_checkbox("blocks", False, hint="the boxes that a large scene is cut into")
            self._pixels = self._gui.add_slider("sharpness", LEAST, MOST, 32, state.pixels, hint="longest side in pixels")
            view = self._gui.add_slider("fly to view", 0, max(1, len(names) - 1), 1, 0)
        self._on(self._map, lambda value: lambda state: replace(state, map=cast(Map, value)))
        self._on(self._cover, lambda value: lambda state: replace(state, cover=float(value)))
        self._on(self._wipe, lambda value: lambda state: replace(state, wipe=_wiped(state, bool(value))))
        self._on(self._picking, lambda value: lambda state: replace(state, picking=bool(value), picked=None))
        self._on(self._pixels, lambda value: lambda state: replace(state, pixels=int(value)))
        for control in (self._cameras, self._blocks):
            control.on_update(lambda event: self._draw(self))

        def fly(event: Any) -> None:
            if event.client is not None and 0 <= int(view.value) < len(names):
                self._fly(event.client, self._session.stage.eye(self._session.trained.known.cameras, int(view.value)))

        view.on_update(fly)

    def _kept_controls(self) -> None:
        with self._gui.add_folder("Looks", expand_by_default=False):
            name = self._gui.add_text("name", "first look")
            keep = self._gui.add_button("Keep this look")
            self._towards = self._gui.add_dropdown("towards", (_NONE,), hint="the look at the other end of the slider")
            self._looks["at"] = self._gui.add_slider("on the way", 0.0, 1.0, 0.01, 0.0)
            self._back = self._gui.add_dropdown("back to", (_NONE,))
        self._on_look("at", self._looks["at"])
        self._pressed(keep, lambda client: self._session.change(lambda state: kept(state, str(name.value)), client.client_id))

        def towards(value: Any) -> Callable[[State], State]:
            return lambda state: replace(state, look=replace(state.look, towards=dict(state.saved).get(str(value))))

        def back(value: Any) -> Callable[[State], State]:
            return lambda state: replace(state, look=dict(state.saved).get(str(value), state.look))

        self._on(self._towards, towards)
        self._on(self._back, back)

    def _film_controls(self) -> None:
        with self._gui.add_folder("Film", expand_by_default=False):
            self._about_keys = self._gui.add_markdown(_about(State()))
            add = self._gui.add_button("Add a key here", hint="this view, in this look")
            swap = self._gui.add_button("Replace the chosen key", hint="by this view, in this look")
            back = self._gui.add_button("Go to the chosen key", hint="to its view, in its look")
            self._play = self._gui.add_button(_PLAY, hint="coarsely, here alone; once more to end it")
            self._seconds = self._gui.add_number("seconds between keys", 2.0, min=0.1, max=60.0, step=0.1)
            self._fps = self._gui.add_number("frames a second", 24, min=1, max=60, step=1)
            self._size = self._gui.add_dropdown("size", tuple(_SIZES), initial_value="medium (960)")
            along = self._gui.add_slider("fly along", 0.0, 1.0, 0.01, 0.0)
            self._make = self._gui.add_button("Make the film")
            self._progress = self._gui.add_progress_bar(0.0)

        session = self._session

        def put(to: Callable[[State, Key], State]) -> Callable[["viser.ClientHandle"], None]:
            def pressed(client: "viser.ClientHandle") -> None:
                eye, picture = self._seen(client), session.thumbnail(client.client_id)
                session.change(lambda state: to(state, Key(eye, state.look, picture)), client.client_id)

            return pressed

        def go(client: "viser.ClientHandle") -> None:
            session.land(client.client_id)
            state = session.state
            if session.change(at_key, client.client_id) and state.chosen is not None:
                self._fly(client, state.keys[state.chosen].eye)

        self._pressed(add, put(added))
        self._pressed(swap, put(replaced))
        self._pressed(back, go)

        def fly(client: "viser.ClientHandle") -> None:
            if session.state.playing:
                session.land(client.client_id)
            else:
                session.play(client.client_id, self.plan, lambda eye: self._fly(client, eye))

        self._pressed(self._play, fly)
        self._pressed(self._make, lambda client: self._session.film(self.plan, client.client_id))

        def go_along(event: Any) -> None:
            if event.client is None or not self._session.state.keys:
                return
            path = path_of(self._session.stage, self.plan)
            at = min(1.0, max(0.0, float(along.value)))
            self._fly(event.client, self._session.stage.eye(path, round(at * (len(path) - 1))))

        along.on_update(go_along)

    def _on(self, control: Any, to: Callable[[Any], Callable[[State], State]]) -> None:
        """A control that replaces the state."""

        control.on_update(lambda event: self._session.change(to(control.value), event.client_id))

    def _on_look(self, name: str, control: Any) -> None:
        def to(value: Any) -> Callable[[State], State]:
            # The page counts in hundredths; a look wants what fits it exactly.
            change: dict[str, Any] = {name: int(value) if name == "clusters" else round(float(value), 4)}
            return lambda state: replace(state, look=replace(state.look, **change))

        self._on(control, to)

    def _preset(self, name: str) -> Callable[["viser.ClientHandle"], object]:
        """The look with what a preset sets: the controls follow."""

        def to(state: State) -> State:
            return replace(state, look=preset(state.look, name))

        return lambda client: self._session.change(to, client.client_id)

    def _pressed(self, button: Any, act: Callable[["viser.ClientHandle"], object]) -> None:
        button.on_click(lambda event: None if event.client is None else act(event.client))

    def _set(self, control: Any, value: object) -> None:
        if control.value != value:
            control.value = value


_HINTS = {
    "temperature": "how softly regions are matched: low = each takes from what is most like it, high = all take from all",
    "clusters": "local styles of each photograph",
    "blend": "0 = each region takes a local style, 1 = all take that of the whole photograph",
    "smoothness": "how alike regions are coloured that meet without an edge between them",
    "luminance": "how much of the scene's own light and dark stays",
    "landing": "what a photograph that is dropped becomes: the style alone, or one more in the mix",
    "map": "matches: which photograph each place takes its style from; regions: what can be picked",
    "picking": "a click on the scene picks what is there; then choose what the region takes from, or that it stays as it is",
}


def _wiped(state: State, on: bool) -> float | None:
    if not on:
        return None
    return 0.5 if state.wipe is None else state.wipe


def _one(value: Any, allowed: tuple[Landing, ...]) -> Landing:
    return next((each for each in allowed if each == value), allowed[0])


def _about(state: State) -> str:
    count = len(state.keys)
    said = "no keys yet: fly somewhere, choose a look, add a key" if not count else f"{count} key{'s' if count > 1 else ''}"
    if state.film.busy:
        said += f"; frame {state.film.done} of {state.film.total}"
    elif state.film != Film() and state.film.path is not None:
        said += f"; made `{state.film.path.parent.name}/{state.film.path.name}`"
    return said
