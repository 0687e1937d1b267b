"""The controls beside the scene, made of viser's. Each asks the session for a change; what the session says comes back.

Values come from a browser: whatever does not fit a look or the state is refused there, and told.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

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
    Map,
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
_HINTS = {
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
        draw_lines: Callable[["Panel"], None],
    ) -> None:
        self._gui, self._session = gui, session
        self._move_camera, self._camera_of, self._draw_lines = move_camera, camera_of, draw_lines
        self._add_look_controls(session.state)
        self._add_view_controls(session.state)
        self._add_saved_looks()
        self._add_film_controls()

    def follow(self, before: State, now: State) -> None:
        """Set the controls to the state."""
        for name in ("strength", "temperature", "clusters", "blend", "luminance", "smoothness", "at"):
            self._set(self._looks[name], getattr(now.look, name))
        self._set(self._drop_mode, now.drop_mode)
        self._set(self._map, now.map)
        self._set(self._map_opacity, now.map_opacity)
        self._set(self._wipe, now.wipe is not None)
        self._set(self._picking, now.picking)
        self._set(self._pixels, now.pixels)
        names = [name for name, _ in now.saved]
        if [name for name, _ in before.saved] != names:
            self._towards.options = self._restore.options = (_NONE, *names)
        towards = [name for name, look in now.saved if look == now.look.towards]
        self._set(self._towards, towards[0] if towards else _NONE)
        if (before.keys, before.playing) != (now.keys, now.playing):
            self._draw_lines(self)
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
            self._drop_mode = self._gui.add_dropdown(
                "new photo", _DROP_MODES, initial_value=state.drop_mode, hint=_HINTS["drop_mode"]
            )
        for name, control in self._looks.items():
            self._on_look(name, control)
        for name, button in presets.items():
            self._on_press(button, self._preset(name))
        self._on_change(self._drop_mode, lambda value: lambda state: replace(state, drop_mode=_drop_mode(value)))

    def _add_view_controls(self, state: State) -> None:
        names, drawn_there = self._session.viewed.scene.names, self._session.in_browser
        maps = MAPS[:-1] if drawn_there else MAPS
        with self._gui.add_folder("Show"):
            self._map = self._gui.add_dropdown("map", maps, initial_value=state.map, hint=_HINTS["map"])
            self._map_opacity = self._gui.add_slider("map covers", 0.0, 1.0, 0.05, state.map_opacity)
            self._wipe = self._gui.add_checkbox("before/after", state.wipe is not None, hint="drag the line on the picture")
            self._picking = self._gui.add_checkbox("pick a region", state.picking, hint=_HINTS["picking"])
            self._cameras = self._gui.add_checkbox("cameras", False, hint="where the images were taken")
            self._blocks = self._gui.add_checkbox("blocks", False, hint="the boxes that a large scene is cut into")
            self._pixels = self._gui.add_slider(
                "sharpness", MIN_PIXELS, MAX_PIXELS, 32, state.pixels, hint="longest side in pixels"
            )
            for control in (self._wipe, self._blocks, self._pixels):  # what needs pictures that are rendered here, or fields
                control.visible = not drawn_there
            view = self._gui.add_slider("fly to view", 0, max(1, len(names) - 1), 1, 0)
            save = self._gui.add_button("Save a picture", hint="of this view, as large as it is here; a PNG")
        self._on_press(save, self._save_picture)
        self._on_change(self._map, lambda value: lambda state: replace(state, map=cast(Map, value)))
        self._on_change(self._map_opacity, lambda value: lambda state: replace(state, map_opacity=float(value)))
        self._on_change(self._wipe, lambda value: lambda state: replace(state, wipe=_wipe(state, bool(value))))
        self._on_change(self._picking, lambda value: lambda state: replace(state, picking=bool(value), picked=None))
        self._on_change(self._pixels, lambda value: lambda state: replace(state, pixels=int(value)))
        for control in (self._cameras, self._blocks):
            control.on_update(lambda event: self._draw_lines(self))

        def fly(event: Any) -> None:
            if event.client is not None and 0 <= int(view.value) < len(names):
                cameras = self._session.viewed.scene.cameras
                self._move_camera(event.client, self._session.transform.camera_state(cameras, int(view.value)))

        view.on_update(fly)

    def _save_picture(self, client: "viser.ClientHandle") -> None:
        size = (client.camera.image_width, client.camera.image_height)
        share = min(1.0, MAX_PIXELS / max(size))
        width, height = (max(1, round(share * side)) for side in size)
        self._session.save_picture(self._camera_of(client), (width, height), client.client_id)

    def _add_saved_looks(self) -> None:
        with self._gui.add_folder("Looks", expand_by_default=False):
            name = self._gui.add_text("name", "first look")
            keep = self._gui.add_button("Keep this look")
            self._towards = self._gui.add_dropdown("towards", (_NONE,), hint="the look at the other end of the slider")
            self._looks["at"] = self._gui.add_slider("on the way", 0.0, 1.0, 0.01, 0.0)
            self._restore = self._gui.add_dropdown("back to", (_NONE,))
        self._on_look("at", self._looks["at"])
        self._on_press(
            keep, lambda client: self._session.update(lambda state: save_look(state, str(name.value)), client.client_id)
        )

        def towards(value: Any) -> Callable[[State], State]:
            return lambda state: replace(state, look=replace(state.look, towards=dict(state.saved).get(str(value))))

        def restore(value: Any) -> Callable[[State], State]:
            return lambda state: replace(state, look=dict(state.saved).get(str(value), state.look))

        self._on_change(self._towards, towards)
        self._on_change(self._restore, restore)

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
                session.update(lambda state: change(state, Key(camera, state.look, thumbnail)), client.client_id)

            return pressed

        def go(client: "viser.ClientHandle") -> None:
            session.stop_flight(client.client_id)
            state = session.state
            if session.update(restore_key, client.client_id) and state.selected_key is not None:
                self._move_camera(client, state.keys[state.selected_key].camera)

        def fly(client: "viser.ClientHandle") -> None:
            if session.state.playing:
                session.stop_flight(client.client_id)
            else:
                session.play_flight(client.client_id, self.plan, lambda camera: self._move_camera(client, camera))

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
        self._on_press(self._record, lambda client: session.record_film(self.plan, client.client_id))
        along.on_update(fly_along)

    def _on_change(self, control: Any, change: Callable[[Any], Callable[[State], State]]) -> None:
        control.on_update(lambda event: self._session.update(change(control.value), event.client_id))

    def _on_look(self, name: str, control: Any) -> None:
        def change(value: Any) -> Callable[[State], State]:
            # The page counts in hundredths; equal looks must be equal exactly.
            values: dict[str, Any] = {name: int(value) if name == "clusters" else round(float(value), 4)}
            return lambda state: replace(state, look=replace(state.look, **values))

        self._on_change(control, change)

    def _preset(self, name: str) -> Callable[["viser.ClientHandle"], object]:
        def change(state: State) -> State:
            return replace(state, look=apply_preset(state.look, name))

        return lambda client: self._session.update(change, client.client_id)

    def _on_press(self, button: Any, act: Callable[["viser.ClientHandle"], object]) -> None:
        button.on_click(lambda event: None if event.client is None else act(event.client))

    def _set(self, control: Any, value: object) -> None:
        if control.value != value:
            control.value = value


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
