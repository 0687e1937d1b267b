"""Names to objects through entry points. Listing reads metadata only; loading imports the one plug-in that is
named.

A broken, ambiguous or missing plug-in is an error only for whoever names it.
"""

import difflib
import re
import sys
from collections.abc import Mapping
from functools import cache
from importlib.metadata import EntryPoint, distributions
from importlib.metadata import distribution as find_distribution
from types import MappingProxyType
from typing import NamedTuple, TypeVar

from ..errors import PluginError

T = TypeVar("T")


class Entry(NamedTuple):
    """One registered plug-in, not imported."""

    point: EntryPoint
    package: str
    """Distribution and version, for example `acme-clip 0.3`."""

    @property
    def origin(self) -> str:
        """Object and package, for messages."""
        return f"{self.point.value} from {self.package}"


def installed(group: str) -> Mapping[str, tuple[Entry, ...]]:
    """Entries of a group by name, sorted. A name that several packages claim has several entries."""
    return _scan()[0].get(group, MappingProxyType({}))


def choices(group: str, kind: type = object) -> list[str]:
    """Names of a group that may be of the kind: all but those known, without importing anything, to be of
    another.
    """
    names = []
    for name, entries in installed(group).items():
        known = None
        if len(entries) == 1:
            known = _imported(entries[0].point)
        if not isinstance(known, type) or issubclass(known, kind):
            names.append(name)
    return names


def groups() -> tuple[str, ...]:
    """Every group that some package registers in."""
    return tuple(sorted(_scan()[0]))


def unreadable() -> tuple[str, ...]:
    """Packages whose entry points cannot be read, each with the reason. They register nothing and hurt nobody
    else.
    """
    return _scan()[1]


def forget() -> None:
    """Read the metadata anew at the next question, for example after a package was installed in this
    process.
    """
    _scan.cache_clear()


def entry(group: str, name: str, kind: type = object) -> Entry:
    """The one entry of that name. Raises PluginError where there is none or more than one; others of the kind
    are named.
    """
    entries = installed(group).get(name, ())
    if not entries:
        others = choices(group, kind)
        raise PluginError(
            f"{group}: no plug-in {name!r} is installed{nearest(name, others)} (installed: {', '.join(others) or 'none'}); "
            "after adding an entry point to a package, install that package again"
        )
    if len(entries) > 1:
        claims = ", ".join(each.origin for each in entries)
        raise PluginError(f"{group}: several packages provide {name!r}: {claims}; uninstall all but one")
    return entries[0]


def load_object(group: str, name: str, kind: type = object) -> object:
    """Import the one plug-in of that name. Raises PluginError where it is missing, ambiguous or fails to
    import.

    The kind, of which the object may yet not be, says which others that error names.
    """
    plugin = entry(group, name, kind)
    try:
        loaded: object = plugin.point.load()
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a stranger's module may even call sys.exit while it is imported
        raise PluginError(
            f"{group}: {name!r} ({plugin.origin}) failed to import: {type(error).__name__}: {error}; "
            "mend or uninstall that package, or choose another plug-in"
        ) from error
    return loaded


def load(group: str, name: str, kind: type[T]) -> type[T]:
    """Import the one plug-in of that name, a subclass of `kind`. Raises PluginError."""
    loaded = load_object(group, name, kind)
    if isinstance(loaded, type) and issubclass(loaded, kind):
        return loaded
    if isinstance(loaded, type):
        shown = loaded.__name__
    else:
        shown = repr(loaded)
    raise PluginError(
        f"{group}: {name!r} ({entry(group, name).origin}) is {shown}, not a {kind.__name__}; "
        f"choose one of that kind ({', '.join(choices(group, kind)) or 'none is installed'}), or correct its entry point"
    )


def make(group: str, name: str, kind: type[T]) -> T:
    """The config of that name with its defaults. Raises PluginError, also where it has none to start from."""
    chosen = load(group, name, kind)
    try:
        return chosen()
    except Exception as error:  # a stranger's defaults
        raise PluginError(
            f"{group}: {name!r} ({entry(group, name).origin}) has no defaults to start from ({error}); "
            "every field of a plug-in's config needs one"
        ) from error


def name_of(group: str, cls: type) -> str:
    """The name that a plug-in is saved under: the inverse of `load`. Imports nothing."""
    # By what metadata say, or by the object itself where a class is re-exported.
    value = f"{cls.__module__}:{cls.__qualname__}"
    for name, entries in installed(group).items():
        if any(each.point.value == value or _imported(each.point) is cls for each in entries):
            return name
    raise PluginError(
        f"{value} has no entry point in {group}, so it has no name to be saved under; "
        f'add `NAME = "{value}"` to [project.entry-points."{group}"] of its package and install that again'
    )


def nearest(name: str, allowed: Mapping[str, object] | list[str]) -> str:
    """`; did you mean 'x'?` where something allowed is close, else nothing."""
    close = difflib.get_close_matches(name, list(allowed), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def _imported(point: EntryPoint) -> object | None:
    """The object of an entry point, from the modules that are imported already: a class may be
    re-exported.
    """
    # `package.module:Class.attribute`, of which the module may not be imported yet.
    module, _, attributes = point.value.partition(":")
    value: object | None = sys.modules.get(module.strip())
    for attribute in attributes.strip().split("."):
        value = getattr(value, attribute, None)
    return value


_PREFIX = "fprf."


@cache
def _scan() -> tuple[Mapping[str, Mapping[str, tuple[Entry, ...]]], tuple[str, ...]]:
    """Entries by group and name, and complaints about packages that cannot be read."""
    entries: dict[str, dict[str, list[Entry]]] = {}
    complaints: list[str] = []
    seen: set[str] = set()
    for distribution in distributions():
        try:
            # Of most packages this one file is read: metadata of hundreds would take a second to parse.
            if f"[{_PREFIX}" not in (distribution.read_text("entry_points.txt") or ""):
                continue
            name = distribution.name
            points = list(distribution.entry_points)
            spelling = re.sub(r"[-_.]+", "-", name).lower()
            package = f"{name} {distribution.version}"
            # Of several copies on sys.path the first one counts, be it one without entry points of ours.
            if spelling in seen or find_distribution(name).locate_file("") != distribution.locate_file(""):
                continue
        except Exception as error:  # whatever a damaged file makes the reader raise: it may be about us
            place = distribution.locate_file("")
            reason = f"{type(error).__name__}: {error}"
            complaints.append(f"{place}: a package's entry points cannot be read ({reason})")
            continue
        seen.add(spelling)
        for point in points:
            if point.group.startswith(_PREFIX):
                entries.setdefault(point.group, {}).setdefault(point.name, []).append(Entry(point, package))
    groups = {}
    for group, names in entries.items():
        ordered = {}
        for name in sorted(names):
            ordered[name] = tuple(sorted(names[name], key=lambda each: each.package))
        groups[group] = MappingProxyType(ordered)
    return MappingProxyType(groups), tuple(complaints)
