"""Captures of Gaussians among files, by their names alone: the entry points of formats. Imports none of them."""

from pathlib import Path

from . import registry

CAPTURES = "fprf.captures"
"""Entry points of file formats of Gaussians (`splats.files.base.CaptureFormat`), by the ending of their
files.
"""


def endings() -> tuple[str, ...]:
    """Endings of the files of installed formats, with their dot; an index of a folder (lod-meta.json) has
    none of its own.
    """
    return tuple(f".{name}" for name in registry.installed(CAPTURES) if not name.endswith(".json"))


def format_name(path: Path) -> str | None:
    """The installed format that a file is of by its name; None where it is of none. A meta.json is that of a
    SOG folder.
    """
    name = path.name.lower()
    if name == "meta.json":
        return "sog"
    installed = registry.installed(CAPTURES)
    fits = []
    for each in installed:
        if name.endswith(f".{each}") or (name == each and "." in each):
            fits.append(each)
    return max(fits, key=len, default=None)


def stem_of(path: Path) -> str:
    """The name of a capture without the ending that says its format; of an index that of its folder, of a
    page its stem.
    """
    if path.is_dir():
        return path.resolve().name
    name = format_name(path)
    if path.name.lower() in ("meta.json", name):
        return path.resolve().parent.name
    if name is None:
        return path.stem
    return path.name[: -len(name) - 1]


def captures_in(folder: Path) -> list[Path]:
    """Captures that lie directly in a folder, in the order of their names: files that can be read, and folders of
    SOG. None in a folder that is a capture or a run itself.
    """
    if is_scene(folder):
        return []
    found = []
    for path in sorted(folder.iterdir()):
        index = path.is_dir() and any((path / name).is_file() for name in ("meta.json", "lod-meta.json"))
        name = format_name(path) if path.is_file() else None
        readable = name is not None and getattr(registry.load_object(CAPTURES, name), "reads", True)
        if not path.name.startswith(".") and (index or readable):
            found.append(path)
    return found


def is_scene(path: Path) -> bool:
    """True for the path of a capture or of a run, which is no photograph."""
    if path.is_dir():
        return any((path / name).is_file() for name in ("meta.json", "lod-meta.json", "config.json"))
    return format_name(path) is not None
