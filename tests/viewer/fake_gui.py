"""A panel without viser: controls that remember what is done to them, and can be moved and pressed as by a client."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any


class Client:
    """What viser hands over with an event; its camera is wherever the panel flew it last."""

    def __init__(self, number: int) -> None:
        self.client_id = number
        self.cameras: list[Any] = []


class Control:
    """One control: `moved` is what a browser does, setting `value` what the program does."""

    def __init__(self, value: Any = None, options: Any = ()) -> None:
        self.value, self.content, self.disabled, self.options = value, value, False, tuple(options)
        self._heard: list[Callable[[Any], object]] = []

    def on_update(self, act: Callable[[Any], object]) -> None:
        self._heard.append(act)

    on_click = on_update

    def moved(self, value: Any, client: Client | None = None) -> None:
        self.value = value
        self.pressed(client)

    def pressed(self, client: Client | None = None) -> None:
        event = SimpleNamespace(client=client, client_id=None if client is None else client.client_id)
        for act in self._heard:
            act(event)


class Gui:
    """Controls by their labels."""

    def __init__(self) -> None:
        self.all: dict[str, Control] = {}

    def __getitem__(self, label: str) -> Control:
        return self.all[label]

    def _add(self, label: str, value: Any = None, options: Any = (), **more: Any) -> Control:
        assert label not in self.all, "two controls of one name cannot be told from each other"
        self.all[label] = Control(value, options)
        return self.all[label]

    add_button = add_checkbox = add_number = add_text = _add

    @contextmanager
    def add_folder(self, label: str, expand_by_default: bool = True) -> Iterator[None]:
        yield

    def add_slider(self, label: str, low: float, high: float, step: float, value: Any, hint: str = "") -> Control:
        assert low <= value <= high
        return self._add(label, value)

    def add_dropdown(self, label: str, options: Any, initial_value: Any = None, hint: str = "") -> Control:
        return self._add(label, options[0] if initial_value is None else initial_value, options)

    def add_markdown(self, text: str) -> Control:
        return self._add("about", text)

    def add_progress_bar(self, value: float) -> Control:
        return self._add("progress", value)
