"""Check before a file is written: nothing that is read, and nothing of another origin, is replaced unasked.

The origin of an output is the verb that writes it and the files and folders that the verb reads; other settings do
not count. A folder that outputs were written to holds a list of them, `.fprf.json`: for each its origin as a hash,
its size and the time of its last change. A file is replaced where that list says that it has this very origin and
nobody has changed it since; any other file that is there is refused, unless the user asked for it to be overwritten.

    {"format": 1, "files": {NAME: {"origin": hash, "style": key, "size": bytes, "mtime_ns": nanoseconds}}}

Paths that are read are hashed relative to the folder, so that a project can be moved as a whole. Outputs are those
that a symbolic link leads to.
"""

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from ..errors import DataError, UsageError
from .atomic import write_json
from .strict_json import parse_json

RECORD = ".fprf.json"
"""List of the outputs in a folder."""
_RECORD_FORMAT = 1
"""Counts up when an older fprf could not read the list."""

_Entry: TypeAlias = dict[str, Any]
"""Entry of the list for a file; one that is announced, and not yet written, has no size."""


@dataclass(frozen=True, kw_only=True)
class OverwriteConfig:
    """The flag of every verb that writes files."""

    overwrite: bool = False
    """Replace files that are there already, whatever they are: also those that are read, and those that this verb has
    not made of the same files.
    """


@dataclass(frozen=True, kw_only=True)
class Origin:
    """Origin of the outputs of one command."""

    by: str
    """The verb."""
    reads: tuple[Path, ...] = ()
    """Files and folders that the outputs are made of."""
    beside: tuple[Path, ...] = ()
    """Files that the command reads for other outputs; they are not overwritten either."""
    overwrite: bool = False
    """Everything may be replaced."""
    remedy: str = "name another --output, or replace it with --overwrite true"
    """Remedy that a refusal names."""

    def refusal(self, path: Path) -> str | None:
        """Why a file may not be written, as a sentence; None where it may."""
        real = real_path(path)
        if self.overwrite or not os.path.lexists(real):
            return None
        if any(same_file(real, each) for each in (*self.reads, *self.beside)):
            return f"{path}: is read by this command, and would be overwritten; {self.remedy}"
        if real.is_dir():  # nothing replaces a folder: writing says so
            return None
        entry = _read_record(real.parent).get(real.name, {})
        if entry.get("origin") != self.key(real.parent):
            return f"{path}: is there already, and was not made by this command of these files; {self.remedy}"
        if _is_changed(real, entry):
            return f"{path}: was changed after this command had made it; {self.remedy}"
        return None

    def check(self, paths: Iterable[Path]) -> None:
        """Raise UsageError for the first of the files that may not be written."""
        for path in paths:
            refused = self.refusal(path)
            if refused is not None:
                raise UsageError(refused)

    def permits(self, paths: Iterable[Path]) -> bool:
        """True where all of the files may be written."""
        return all(self.refusal(path) is None for path in paths)

    @contextmanager
    def writing(self, paths: Sequence[Path], style: str = "") -> Iterator[int]:
        """Check the files, let the block write them, and list those that are there afterwards.

        They are announced before: what a killed process leaves is known to be ours. With a `style`, files that
        the list has of another style in the same folders are removed first, so that a folder never mixes two: how
        many is what the block gets. Raises UsageError as `check`, DataError where the system refuses.
        """
        self.check(paths)
        names: dict[Path, list[str]] = {}
        for path in map(real_path, paths):
            names.setdefault(path.parent, []).append(path.name)
        new = _absent_folders(names)
        removed = 0
        for folder, own in names.items():
            with suppress(DataError):  # what cannot be written there, the block says
                removed += self._announce(folder, own, style)
        try:
            yield removed
        finally:
            with suppress(DataError):  # the outputs are there; the list only spares a question
                for folder, own in names.items():
                    self._list(folder, own, style)
            for folder in new:
                with suppress(OSError):  # something was written into it
                    folder.rmdir()

    def record(self, paths: Iterable[Path]) -> None:
        """List files that were just written, whose names nobody knew before."""
        names: dict[Path, list[str]] = {}
        for path in map(real_path, paths):
            names.setdefault(path.parent, []).append(path.name)
        for folder, own in names.items():
            with suppress(DataError):
                self._list(folder, own, "")

    def key(self, folder: Path) -> str:
        """The origin as a hash, of outputs in a folder."""
        reads = sorted({_relative(each, folder) for each in self.reads})
        return hashlib.sha256(json.dumps([self.by, reads]).encode(errors="surrogateescape")).hexdigest()[:32]

    def _announce(self, folder: Path, names: Sequence[str], style: str) -> int:
        """List files that are about to be written; how many of another style were removed, and are not among
        them.
        """
        entries = _read_record(folder)
        removed = 0
        if style:
            for name, entry in list(entries.items()):
                ours = self.overwrite or entry.get("origin") == self.key(folder)
                other = entry.get("style", "") not in ("", style)
                if ours and other and not _is_changed(folder / name, entry):
                    (folder / name).unlink(missing_ok=True)
                    del entries[name]
                    removed += name not in names
        announced = {"origin": self.key(folder), "style": style}
        _write_record(folder, entries | dict.fromkeys(names, announced))
        return removed

    def _list(self, folder: Path, names: Sequence[str], style: str) -> None:
        entries = _read_record(folder)
        origin = self.key(folder)
        for name in names:
            entries.pop(name, None)
            with suppress(OSError):
                found = (folder / name).stat()
                stamp = {"size": found.st_size, "mtime_ns": found.st_mtime_ns}
                entries[name] = {"origin": origin, "style": style, **stamp}
        _write_record(folder, entries)


def real_path(path: Path) -> Path:
    """The file that a path leads to, through symbolic links; its own name where it leads nowhere yet."""
    return Path(os.path.realpath(path))


def same_file(first: Path, second: Path) -> bool:
    """True for one file under two names: by links, hard links, or the case of letters where that does not count."""
    try:
        return os.path.samefile(first, second)
    except OSError:  # one of them is not there
        return False


def unused_name(name: str, taken: Iterable[str]) -> str:
    """The name, with a number from 2 on behind it where it is taken; names that differ in case are one."""
    known = set()
    for each in taken:
        known.add(each.casefold())
    if name.casefold() not in known:
        return name
    number = 2
    while f"{name}-{number}".casefold() in known:
        number += 1
    return f"{name}-{number}"


def _absent_folders(folders: Iterable[Path]) -> list[Path]:
    """Folders that are yet to be made, with those that they lie in, from the innermost outwards."""
    absent: set[Path] = set()
    for folder in folders:
        absent |= {each for each in (folder, *folder.parents) if not each.exists()}
    return sorted(absent, key=lambda each: len(each.parts), reverse=True)


def _relative(path: Path, folder: Path) -> str:
    """A path as it is seen from a folder; whole where that is on another drive."""
    whole = os.path.realpath(path)
    try:
        return Path(os.path.relpath(whole, os.path.realpath(folder))).as_posix()
    except ValueError:
        return whole


def _is_changed(path: Path, entry: _Entry) -> bool:
    """True where a file is not as it was when it was listed."""
    if "size" not in entry:  # announced, and cut off before it was listed
        return False
    try:
        found = path.stat()
    except OSError:
        return False
    return bool(entry.get("size") != found.st_size or entry.get("mtime_ns") != found.st_mtime_ns)


def _read_record(folder: Path) -> dict[str, _Entry]:
    """The list of a folder; empty where there is none, or none that can be understood."""
    try:
        content = parse_json((folder / RECORD).read_text("utf-8"))
        if content["format"] == _RECORD_FORMAT:
            files = content["files"]
        else:
            files = {}
        found: dict[str, _Entry] = {}
        for name, entry in files.items():
            found[name] = dict(entry)
        return found
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return {}


def _write_record(folder: Path, entries: dict[str, _Entry]) -> None:
    """Write the list of a folder; none where it would be empty. Raises DataError where the system refuses."""
    if entries:
        write_json(folder / RECORD, {"format": _RECORD_FORMAT, "files": entries})
    else:
        with suppress(OSError):
            (folder / RECORD).unlink()
