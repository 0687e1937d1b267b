"""Files of a SOG capture: in an archive, or in a folder beside a meta.json."""

import io
import json
import re
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ...errors import DataError

_MAX_MEMBERS = 64
"""Files of an archive or names in a meta.json, at most; SOG has 8."""
_IMAGE_NAME = re.compile(r"\w[\w .-]*\.(webp|png)", re.IGNORECASE)
"""Names of images in a folder: no other file can be read or replaced by what a meta.json says."""
_ARCHIVE_TIME = (1980, 1, 1, 0, 0, 0)
"""Time of archived files: the same capture gives the same bytes."""


def unbundle(path: Path, data: bytes) -> dict[str, bytes]:
    """The files of an archive, in their order. Raises DataError where it is damaged, or claims more than it
    holds.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = archive.infolist()
            # WebP does not shrink: what claims more than the archive is long is damaged, but for texts.
            if len(entries) > _MAX_MEMBERS or sum(entry.file_size for entry in entries) > 2 * len(data) + (
                1 << 22
            ):
                raise DataError(
                    f"{path}: {len(entries)} files that claim more than the archive holds; copy it again"
                )
            found: dict[str, bytes] = {}
            for entry in entries:
                found[entry.filename] = archive.read(entry)
            return found
    except (
        OSError,
        ValueError,
        EOFError,
        RuntimeError,
        NotImplementedError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise DataError(
            f"{path}: no readable .sog archive ({error}); copy it again, it is cut off or damaged"
        ) from error


def folder_of(path: Path, files: Mapping[str, bytes]) -> str:
    """The folder of an archive, with its slash, that holds the meta.json nearest to the top. Raises DataError
    without one.
    """
    found = []
    for name in files:
        if name.rpartition("/")[2] == "meta.json" and not name.startswith("__MACOSX/"):
            found.append(name)
    if not found:
        raise DataError(f"{path}: an archive without meta.json; not a SOG file")
    return min(found, key=lambda name: (name.count("/"), name)).removesuffix("meta.json")


def bundle(parts: Mapping[str, bytes], like: bytes | None = None) -> bytes:
    """Files as an archive, stored as they are; times are those of the archive `like`, where it has such a
    file.
    """
    times: dict[str, tuple[int, int, int, int, int, int]] = {}
    if like is not None:
        with zipfile.ZipFile(io.BytesIO(like)) as archive:
            for entry in archive.infolist():
                times[entry.filename] = entry.date_time
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for name, content in parts.items():
            archive.writestr(zipfile.ZipInfo(name, times.get(name, _ARCHIVE_TIME)), content)
    return out.getvalue()


def folder_files(path: Path, data: bytes) -> dict[str, bytes]:
    """The images that a meta.json names, from its own folder alone, and itself."""
    parts: dict[str, bytes] = {}
    for name in image_names(path, read_meta(path, data)):
        try:
            parts[name] = (path.parent / name).read_bytes()
        except (OSError, ValueError) as error:
            raise DataError(f"{path}: {name} beside it cannot be read; copy the whole folder") from error
    if path.name == "meta.json":
        return {**parts, path.name: data}
    return {**parts, "meta.json": data}


def image_names(path: Path, meta: Mapping[str, Any]) -> list[str]:
    """Names of the images of a meta.json. Raises DataError for one that may be any other file's."""
    names = []
    for group in meta.values():
        if isinstance(group, dict) and isinstance(group.get("files"), list):
            names += group["files"]
    for name in names:
        if not isinstance(name, str) or not _IMAGE_NAME.fullmatch(name) or len(names) > _MAX_MEMBERS:
            raise DataError(f"{path}: {name!r} is no .webp or .png beside it; not a SOG folder")
    return names


def read_meta(path: Path, data: bytes) -> dict[str, Any]:
    """Content of a meta.json. Raises DataError where it is not one of a SOG capture."""
    try:
        meta = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: no valid meta.json ({error}); not a SOG file, or it is damaged") from error
    if not isinstance(meta, dict) or not isinstance(meta.get("means"), dict):
        raise DataError(f"{path}: a meta.json without `means`; not a SOG file")
    return meta
