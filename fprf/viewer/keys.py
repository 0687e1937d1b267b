"""The keys of a flight as they are edited: added, replaced, put in another order; and how the scene looks between two."""

from dataclasses import replace

from ..errors import UsageError
from .film import Key
from .looks import Look
from .state import State

__all__ = ["added", "at_key", "between_keys", "chosen", "replaced", "shifted", "without"]


def added(state: State, key: Key) -> State:
    """With a key behind the chosen one, or at the end; it is the chosen one now. Raises UsageError for too many."""
    at = len(state.keys) if state.chosen is None else state.chosen + 1
    return replace(state, keys=(*state.keys[:at], key, *state.keys[at:]), chosen=at)


def replaced(state: State, key: Key) -> State:
    """With another key in the place of the chosen one."""
    at = _chosen(state)
    return replace(state, keys=(*state.keys[:at], key, *state.keys[at + 1 :]))


def without(state: State) -> State:
    """Without the chosen key; the one before it is chosen then."""
    at = _chosen(state)
    keys = (*state.keys[:at], *state.keys[at + 1 :])
    return replace(state, keys=keys, chosen=max(0, at - 1) if keys else None)


def shifted(state: State, by: int) -> State:
    """With the chosen key `by` places later; it stops at the ends."""
    at = _chosen(state)
    to = min(len(state.keys) - 1, max(0, at + by))
    rest = (*state.keys[:at], *state.keys[at + 1 :])
    return replace(state, keys=(*rest[:to], state.keys[at], *rest[to:]), chosen=to)


def chosen(state: State, at: int) -> State:
    """With a key chosen by its place. Raises UsageError where there is none."""
    if not 0 <= at < len(state.keys):
        raise UsageError(f"film: key {at + 1} of {len(state.keys)}: there is none")
    return replace(state, chosen=at)


def at_key(state: State) -> State:
    """In the look of the chosen key, as far as its photographs are on the shelf still."""
    look = state.keys[_chosen(state)].look
    return replace(state, look=look)


def between_keys(keys: tuple[Key, ...], at: float) -> Look:
    """The look at a place of the flight, counted in keys: it fades as in the film (a smoothstep).

    Where one of both looks lies between two looks itself, it holds for its half of the way: this is for previews.
    """
    last = len(keys) - 1
    at = min(float(last), max(0.0, at))
    first = min(int(at), max(0, last - 1))
    here, there, way = keys[first].look, keys[min(last, first + 1)].look, at - first
    if here == there or way == 0:
        return here
    if way == 1:
        return there
    if here.towards is not None or there.towards is not None:
        return here if way < 0.5 else there
    return replace(here, towards=there, at=way * way * (3 - 2 * way))


def _chosen(state: State) -> int:
    if state.chosen is None:
        raise UsageError("film: no key is chosen; click one, or add one")
    return state.chosen
