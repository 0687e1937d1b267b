"""The controls beside the scene, made of viser's. Each asks the session for a change; what the session says comes back.

Values come from a browser: whatever does not fit a look or the state is refused there, and told.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ..style.config import PRESETS, preset_flags
from .cameras import CameraState, picture_size
from .film import FilmPlan, film_cameras
from .session import Session
from .state import (
    MAPS,
    MAX_PIXELS,
    MIN_PIXELS,
    DropMode,
    FilmProgress,
    Key,
    State,
    add_key,
    apply_preset,
    replace_key,
    restore_key,
    save_look,
)

if TYPE_CHECKING:
    import viser

_NONE = "nothing"
_DROP_MODES: tuple[DropMode, ...] = ("alone", "in the mix")
_SIZES = {"small (480)": 480, "medium (960)": 960, "full HD (1920)": 1920}
_LOOK: Mapping[str, tuple[str, float, float, float]] = {
    "strength": ("strength", 0.0, 1.0, 0.01),
    "temperature": ("temperature", 0.05, 2.0, 0.05),
    "clusters": ("clusters", 1, 40, 1),
    "blend": ("local ↔ global", 0.0, 1.0, 0.01),
    "luminance": ("keep light", 0.0, 1.0, 0.01),
    "smoothness": ("smoothness", 0, 256, 1),
}
"""Sliders of a look's fields: label, least and most value, step."""
_HINTS = {
    "strength": "0 = the scene as it was captured",
    "temperature": "how softly regions are matched: low = each takes from what is most like it, high = all take from all",
    "clusters": "local styles of each photograph",
    "blend": "0 = each region takes a local style, 1 = all take that of the whole photograph",
    "smoothness": "how alike regions are coloured that meet without an edge between them",
    "luminance": "how much of the scene's own light and dark stays",
    "drop_mode": "what a photograph that is dropped becomes: the style alone, or one more in the mix",
    "map": "matches: which photograph each place takes its style from; regions: what can be picked",
    "picking": "a click on the scene picks what is there; then choose what the region takes from, or that it stays as it is",
}


class Panel:
    """`move_camera` moves a client's camera, `camera_of` reads it; `draw_lines` draws what lies over the scene anew."""

    def __init__(
        self,
        gui: "viser.GuiApi",
        session: Session,
        move_camera: Callable[["viser.ClientHandle", CameraState], None],
        camera_of: Callable[["viser.ClientHandle"], CameraState],
        draw_lines: Callable[[], None],
    ) -> None:
        self._gui, self._session = gui, session
        self._move_camera, self._camera_of, self._draw_lines = move_camera, camera_of, draw_lines
        self._bound: list[tuple[Any, Callable[[State], object]]] = []
        self._add_look_controls(session.state)
        self._add_view_controls(session.state)
        self._add_saved_looks()
        self._add_film_controls()

    def follow(self, before: State, now: State) -> None:
        """Set the controls to the state."""
        names = [name for name, _ in now.saved]
        if [name for name, _ in before.saved] != names:
            self._towards.options = self._restore.options = (_NONE, *names)
        for control, read in self._bound:
            value = read(now)
            if control.value != value:
                control.value = value
        if (before.keys, before.playing) != (now.keys, now.playing):
            self._draw_lines()
        if (before.keys, before.film) != (now.keys, now.film):
            self._progress.value = 100.0 * now.film.done / max(1, now.film.total)
            self._record.disabled = now.film.busy
            self._film_text.content = _film_text(now)

    @property
    def cameras(self) -> bool:
        """True where captured cameras are drawn."""
        return bool(self._cameras.value)

    @property
    def blocks(self) -> bool:
        """True where the boxes of blocks are drawn."""
        return bool(self._blocks.value)

    @property
    def plan(self) -> FilmPlan:
        """The film that the controls describe."""
        state = self._session.state
        aspect = state.keys[0].camera.aspect if state.keys else 1.0
        width, height = picture_size(aspect, _SIZES.get(str(self._size.value), 960))
        return FilmPlan(state.keys, float(self._seconds.value), float(self._fps.value), (width // 2 * 2, height // 2 * 2))

    def _add_look_controls(self, state: State) -> None:
        with self._gui.add_folder("Style"):
            for name, (label, low, high, step) in _LOOK.items():
                value = getattr(state.look, name)
                self._bind_look(name, self._gui.add_slider(label, low, high, step, value, hint=_HINTS[name]))
            for name in PRESETS:
                self._on_press(self._gui.add_button(name, hint=preset_flags(name)), self._preset(name))
            drop = self._gui.add_dropdown("new photo", _DROP_MODES, initial_value=state.drop_mode, hint=_HINTS["drop_mode"])
        self._bind(drop, lambda state: state.drop_mode, lambda state, value: replace(state, drop_mode=_drop_mode(value)))

    def _add_view_controls(self, state: State) -> None:
        names, drawn_there = self._session.viewed.scene.names, self._session.in_browser
        maps = MAPS[:-1] if drawn_there else MAPS
        with self._gui.add_folder("Show"):
            map_ = self._gui.add_dropdown("map", maps, initial_value=state.map, hint=_HINTS["map"])
            opacity = self._gui.add_slider("map covers", 0.0, 1.0, 0.05, state.map_opacity)
            wipe = self._gui.add_checkbox("before/after", state.wipe is not None, hint="drag the line on the picture")
            picking = self._gui.add_checkbox("pick a region", state.picking, hint=_HINTS["picking"])
            self._cameras = self._gui.add_checkbox("cameras", False, hint="where the images were taken")
            self._blocks = self._gui.add_checkbox("blocks", False, hint="the boxes that a large scene is cut into")
            pixels = self._gui.add_slider("sharpness", MIN_PIXELS, MAX_PIXELS, 32, state.pixels, hint="longest side in pixels")
            for control in (wipe, self._blocks, pixels):  # what needs pictures that are rendered here, or fields
                control.visible = not drawn_there
            view = self._gui.add_slider("fly to view", 0, max(1, len(names) - 1), 1, 0)
            save = self._gui.add_button("Save a picture", hint="of this view, as large as it is here; a PNG")
        self._bind(map_, lambda state: state.map, lambda state, value: replace(state, map=value))
        self._bind(opacity, lambda state: state.map_opacity, lambda state, value: replace(state, map_opacity=float(value)))
        self._bind(wipe, lambda state: state.wipe is not None, lambda state, value: replace(state, wipe=_wipe(state, value)))
        self._bind(picking, lambda state: state.picking, lambda state, value: replace(state, picking=bool(value), picked=None))
        self._bind(pixels, lambda state: state.pixels, lambda state, value: replace(state, pixels=int(value)))
        for control in (self._cameras, self._blocks):
            control.on_update(lambda event: self._draw_lines())

        def fly(event: Any) -> None:
            if event.client is not None and 0 <= int(view.value) < len(names):
                cameras = self._session.viewed.scene.cameras
                self._move_camera(event.client, self._session.transform.camera_state(cameras, int(view.value)))

        view.on_update(fly)
        self._on_press(save, self._save_picture)

    def _save_picture(self, client: "viser.ClientHandle") -> None:
        size = (client.camera.image_width, client.camera.image_height)
        share = min(1.0, MAX_PIXELS / max(size))
        width, height = (max(1, round(share * side)) for side in size)
        self._session.save_picture(self._camera_of(client), (width, height))

    def _add_saved_looks(self) -> None:
        with self._gui.add_folder("Looks", expand_by_default=False):
            name = self._gui.add_text("name", "first look")
            keep = self._gui.add_button("Keep this look")
            self._towards = self._gui.add_dropdown("towards", (_NONE,), hint="the look at the other end of the slider")
            at = self._gui.add_slider("on the way", 0.0, 1.0, 0.01, 0.0)
            self._restore = self._gui.add_dropdown("back to", (_NONE,))

        def shown(state: State) -> str:
            return next((name for name, look in state.saved if look == state.look.towards), _NONE)

        def towards(state: State, value: Any) -> State:
            return replace(state, look=replace(state.look, towards=dict(state.saved).get(str(value))))

        def restore(state: State) -> State:
            return replace(state, look=dict(state.saved).get(str(self._restore.value), state.look))

        self._bind_look("at", at)
        self._bind(self._towards, shown, towards)
        self._restore.on_update(lambda event: self._session.update(restore))
        self._on_press(keep, lambda client: self._session.update(lambda state: save_look(state, str(name.value))))

    def _add_film_controls(self) -> None:
        with self._gui.add_folder("Film", expand_by_default=False):
            self._film_text = self._gui.add_markdown(_film_text(State()))
            add = self._gui.add_button("Add a key here", hint="this view, in this look")
            swap = self._gui.add_button("Replace the chosen key", hint="by this view, in this look")
            back = self._gui.add_button("Go to the chosen key", hint="to its view, in its look")
            play = self._gui.add_button("Play the flight", hint="coarsely, here alone; once more to end it")
            self._seconds = self._gui.add_number("seconds between keys", 2.0, min=0.1, max=60.0, step=0.1)
            self._fps = self._gui.add_number("frames a second", 24, min=1, max=60, step=1)
            self._size = self._gui.add_dropdown("size", tuple(_SIZES), initial_value="medium (960)")
            along = self._gui.add_slider("fly along", 0.0, 1.0, 0.01, 0.0)
            self._record = self._gui.add_button("Make the film")
            self._progress = self._gui.add_progress_bar(0.0)
        session = self._session

        def put(change: Callable[[State, Key], State]) -> Callable[["viser.ClientHandle"], None]:
            def pressed(client: "viser.ClientHandle") -> None:
                camera, thumbnail = self._camera_of(client), session.thumbnail(client.client_id)
                session.update(lambda state: change(state, Key(camera, state.look, thumbnail)))

            return pressed

        def go(client: "viser.ClientHandle") -> None:
            session.films.stop(client.client_id)
            state = session.state
            if session.update(restore_key) and state.selected_key is not None:
                self._move_camera(client, state.keys[state.selected_key].camera)

        def fly(client: "viser.ClientHandle") -> None:
            if session.state.playing:
                session.films.stop(client.client_id)
            else:
                session.films.play(client.client_id, self.plan, lambda camera: self._move_camera(client, camera))

        def fly_along(event: Any) -> None:
            if event.client is None or not session.state.keys:
                return
            path = film_cameras(session.transform, self.plan)
            at = min(1.0, max(0.0, float(along.value)))
            self._move_camera(event.client, session.transform.camera_state(path, round(at * (len(path) - 1))))

        self._on_press(add, put(add_key))
        self._on_press(swap, put(replace_key))
        self._on_press(back, go)
        self._on_press(play, fly)
        self._on_press(self._record, lambda client: session.films.record(self.plan))
        along.on_update(fly_along)

    def _bind(self, control: Any, read: Callable[[State], object], write: Callable[[State, Any], State]) -> None:
        """Let a control show what `read` finds in the state; what a client makes of it is written by `write`."""
        self._bound.append((control, read))
        control.on_update(lambda event: self._session.update(lambda state: write(state, control.value)))

    def _bind_look(self, name: str, control: Any) -> None:
        def write(state: State, value: Any) -> State:
            # The page counts in hundredths; equal looks must be equal exactly.
            values: dict[str, Any] = {name: int(value) if name == "clusters" else round(float(value), 4)}
            return replace(state, look=replace(state.look, **values))

        self._bind(control, lambda state: getattr(state.look, name), write)

    def _preset(self, name: str) -> Callable[["viser.ClientHandle"], object]:
        return lambda client: self._session.update(lambda state: replace(state, look=apply_preset(state.look, name)))

    def _on_press(self, button: Any, act: Callable[["viser.ClientHandle"], object]) -> None:
        button.on_click(lambda event: None if event.client is None else act(event.client))


def _wipe(state: State, on: bool) -> float | None:
    if not on:
        return None
    return 0.5 if state.wipe is None else state.wipe


def _drop_mode(value: Any) -> DropMode:
    return next((each for each in _DROP_MODES if each == value), _DROP_MODES[0])


def _film_text(state: State) -> str:
    count = len(state.keys)
    text = "no keys yet: fly somewhere, choose a look, add a key" if not count else f"{count} key{'s' if count > 1 else ''}"
    if state.film.busy:
        text += f"; frame {state.film.done} of {state.film.total}"
    elif state.film != FilmProgress() and state.film.path is not None:
        text += f"; made `{state.film.path.parent.name}/{state.film.path.name}`"
    return text
