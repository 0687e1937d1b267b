"""Files of a folder that are photographs of the scene: without thumbnails, reduced copies, maps, masks, what
other programs hide, and copies of a photograph under another name.

What is left out has a line for each kind, with the count and an example. Nothing that differs from all others is
left out by its look: copies are told by equal files or equal pixels, reduced copies by name, shape and look.
"""

import hashlib
import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path, PurePath
from typing import NamedTuple

import numpy as np

from ..errors import DataError
from .images import IMAGE_SUFFIXES, Image, ImageHeader, load_image, raw_twins, read_header
from .picture_names import MAP_WORDS, THUMBNAIL_WORDS, spelling, without_suffixes, without_words

COPIES = "copies of other photographs"
HIDDEN = "hidden files"
_OTHER_PROGRAMS = "files of other programs"
_THUMBNAILS = "thumbnails"
_MAPS = "masks and maps of other photographs"
_RECONSTRUCTION = "pictures of a reconstruction"
_RAW_TWINS = "raw files of other photographs"
_REDUCED_COPIES = "reduced copies of other photographs"

_FOLDERS_OF_OTHERS = frozenset(("__macosx", "$recycle.bin", "#recycle", "@recycle", "lost+found"))
_FOLDERS_OF_MODELS = frozenset(("sparse", "stereo", "distorted"))
"""COLMAP's, and those of 3DGS's converter."""
_THUMBNAIL_FOLDERS = frozenset(
    ("@eadir", "thumb", "thumbs", "thumbnail", "thumbnails", "preview", "previews")
)
_MAP_NOUNS = frozenset(
    {"mask", "masks", "msk", "seg", "segmentation", "segmentations"}
    | {"semantic", "semantics", "matte", "mattes", "confidence", "depth"}
    | {"depths", "depthmap", "depthmaps", "disparity", "disparities", "normal"}
    | {"normals", "normalmap", "normalmaps"}
)
_MAP_ADJECTIVES = frozenset(
    {"map", "maps", "image", "images", "png", "exr"}
    | {"mono", "sensor", "sky", "dynamic", "binary", "from"}
    | {"est", "estimated", "pred", "predicted", "pretrain", "gt"}
    | {"vis", "viz", "object", "objects", "people", "person"}
)
"""A folder of these words alone, one a noun, holds maps: depth, mono_normals, sky_masks_4."""
_COMPARED_PAIRS = 3
"""Pairs of pictures that are looked at before a folder counts as reduced copies of another: by eye."""
_THUMBNAIL_PIXELS = 32
"""Side at which two pictures are compared by their look, at most: by eye."""
_MAX_DIFFERENCE = 4.0
"""Mean difference of levels in 0 to 255 up to which two such pictures are one: rounding and JPEG stay below 2, two
views of one place are 10 and more apart (by eye).
"""


class Photographs(NamedTuple):
    """The photographs of a folder."""

    files: list[Path]
    """In the order of their paths."""
    left_out: dict[str, list[str]]
    """Paths relative to the folder of what is left out, by its kind."""

    def notes(self) -> list[str]:
        """A line for each kind."""
        found: list[str] = []
        for kind, names in self.left_out.items():
            found.append(left_out_note(kind, names))
        return found


def left_out_note(kind: str, names: Sequence[str]) -> str:
    """The line that names what is left out."""
    return f"left out: {len(names)} {kind}, like {names[0]}"


def shown_name(path: PurePath) -> str:
    """A path with slashes, as it can be printed: what is not UTF-8 as \\udce9."""
    return path.as_posix().encode(errors="backslashreplace").decode()


def find_photographs(folder: Path, *, below: bool = True, without: Path | None = None) -> Photographs:
    """The photographs in a folder and, unless `below` is false, in those below it but `without`.

    A name counts below the folder only: whoever gives a folder that is called `masks` means it.
    """
    paths = sorted(folder.rglob("*") if below else folder.glob("*"))
    files = []
    left_out = defaultdict[str, list[str]](list)
    for path in paths:
        if path.suffix.lower() not in IMAGE_SUFFIXES or not path.is_file():
            continue
        if without is not None and path.is_relative_to(without):
            continue
        inner = path.relative_to(folder)
        kind = _kind_of_path(inner)
        if kind:
            left_out[kind].append(shown_name(inner))
        else:
            files.append(path)
    files = _without(files, folder, left_out, dict.fromkeys(raw_twins(files), _RAW_TWINS))
    files = _without(files, folder, left_out, _companions(files))
    files = _without(files, folder, left_out, _reduced(files))
    return Photographs(files, dict(left_out))


def _without(
    files: list[Path], folder: Path, left_out: dict[str, list[str]], kinds: Mapping[Path, str]
) -> list[Path]:
    """The files that have no kind; the others are added to what is left out."""
    for path, kind in kinds.items():
        left_out[kind].append(shown_name(path.relative_to(folder)))
    found: list[Path] = []
    for path in files:
        if path not in kinds:
            found.append(path)
    return found


def _kind_of_path(path: PurePath) -> str:
    """Kind of a file by the names of its folders and its own first letter; empty for a photograph."""
    folders = []
    for part in path.parts[:-1]:
        folders.append(spelling(part))
    for name in folders:
        words = set(re.split(r"[\s_.\-\d]+", name)) - {""}
        if name in _FOLDERS_OF_OTHERS:
            return _OTHER_PROGRAMS
        if words and words <= _THUMBNAIL_FOLDERS:
            return _THUMBNAILS
        if words & _MAP_NOUNS and words <= _MAP_NOUNS | _MAP_ADJECTIVES:
            return _MAPS
        if name in _FOLDERS_OF_MODELS:
            return _RECONSTRUCTION
    if any(part.startswith(".") for part in path.parts):
        return HIDDEN
    return ""


def _companions(files: Sequence[Path]) -> dict[Path, str]:
    """Masks, maps and thumbnails that lie beside their photographs, by their names: 0001_mask.png."""
    stems = defaultdict[Path, set[str]](set)
    for path in files:
        stems[path.parent] |= {spelling(path.name), *without_suffixes(spelling(path.name))}
    found: dict[Path, str] = {}
    for path in files:
        there = stems[path.parent]
        own = list(without_suffixes(spelling(path.name)))
        for kind, words in ((_MAPS, MAP_WORDS), (_THUMBNAILS, THUMBNAIL_WORDS)):
            bases: set[str] = set()
            for stem in own:
                bases |= set(without_words(stem, words))
            if bases & (there - set(own)):
                found[path] = kind
    photographs = []
    for path in files:
        if path not in found:
            photographs.append(path)
    sizes = {}
    for path in photographs:
        if found:
            sizes[path] = _size_of(path)
    result: dict[Path, str] = {}
    for path, kind in found.items():
        if kind == _MAPS or _is_smallest(path, sizes):
            result[path] = kind
    return result


def _is_smallest(path: Path, sizes: Mapping[Path, tuple[int, int]]) -> bool:
    """True for a picture that is smaller than all photographs beside it, or cannot be read."""
    beside = []
    for other, size in sizes.items():
        if other.parent == path.parent:
            beside.append(max(size))
    return max(_size_of(path)) < min(beside, default=0)


def _size_of(path: Path) -> tuple[int, int]:
    """Width and height; 0 and 0 for what cannot be read."""
    header = _header(path)
    if header is None:
        return (0, 0)
    return (header.width, header.height)


def _header(path: Path) -> ImageHeader | None:
    try:
        return read_header(path)
    except DataError:
        return None


def _reduced(files: Sequence[Path]) -> dict[Path, str]:
    """Pictures of folders that hold those of another folder at a smaller size, such as images_4."""
    folders = defaultdict[Path, dict[str, Path]](dict)
    for path in files:
        folders[path.parent][_stem(path)] = path
    found: dict[Path, str] = {}
    for folder, members in folders.items():
        for other, theirs in folders.items():
            pairs = []
            for stem, path in members.items():
                if stem in theirs:
                    pairs.append((path, theirs[stem]))
            if other != folder and len(pairs) == len(members) and _are_reduced(pairs):
                found |= dict.fromkeys(members.values(), _REDUCED_COPIES)
                break
    return found


def _stem(path: Path) -> str:
    return next(without_suffixes(spelling(path.name)), path.name)


def _are_reduced(pairs: Sequence[tuple[Path, Path]]) -> bool:
    """True where each first one is the second at a smaller size, by their headers and by some pairs' look."""
    if not all(_is_smaller(*pair) for pair in pairs):
        return False
    some = pairs[:: -(-len(pairs) // _COMPARED_PAIRS)]
    return all(_look_alike(*pair) for pair in some)


def _is_smaller(small: Path, large: Path) -> bool:
    """True where a picture has fewer pixels than another, and its shape within rounding."""
    width, height = _size_of(small)
    whole_width, whole_height = _size_of(large)
    if not 0 < width < whole_width:
        return False
    return abs(width * whole_height - height * whole_width) <= whole_width + whole_height


def _look_alike(small: Path, large: Path) -> bool:
    """True where two pictures at one small size have about the same levels of grey; JPEG moves colours further."""
    width, height = _size_of(small)
    size = (min(_THUMBNAIL_PIXELS, width), min(_THUMBNAIL_PIXELS, height))
    try:
        first = load_image(small, size).mean(2)
        second = load_image(large, size).mean(2)
    except DataError:
        return False
    return float(np.abs(first - second).mean()) <= _MAX_DIFFERENCE


def pixel_digest(path: Path) -> str:
    """A hash of an image's size and pixels, whatever its encoding. Raises DataError where it cannot be read."""
    return digest_of_pixels(load_image(path))


def digest_of_pixels(pixels: Image) -> str:
    """The same of decoded pixels [H W 3]."""
    shape = "x".join(map(str, pixels.shape))
    return f"{shape}-{hashlib.sha256(pixels.tobytes()).hexdigest()}"


def file_digest(path: Path) -> str:
    """SHA-256 of a file. Raises DataError where it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DataError(
            f"{path}: cannot be read ({error.strerror}); check the path and its permissions"
        ) from error


def original_first(paths: Iterable[Path]) -> list[Path]:
    """Paths in an order in which a photograph comes before its copies: their names are longer."""
    return sorted(paths, key=lambda path: (len(path.as_posix()), path.as_posix()))


def equal_files(paths: Sequence[Path]) -> dict[Path, Path]:
    """The files that are byte by byte another, with that one. Only files of one length are read."""
    by_length = defaultdict[int, list[Path]](list)
    for path in original_first(paths):
        by_length[os.path.getsize(path)].append(path)
    found: dict[Path, Path] = {}
    for alike in by_length.values():
        if len(alike) > 1:
            found |= _repeated(alike, file_digest)
    return found


def equal_pictures(paths: Sequence[Path]) -> dict[Path, Path]:
    """The pictures that are, pixel by pixel, another one in any encoding, with that one; those of one size are
    decoded. What cannot be decoded is nobody's copy.
    """
    found = equal_files(paths)
    by_size = defaultdict[tuple[int, int], list[Path]](list)
    for path in original_first(paths):
        if path not in found and max(_size_of(path)) > 0:
            by_size[_size_of(path)].append(path)
    for alike in by_size.values():
        if len(alike) > 1:
            found |= _repeated(alike, _digest_or_path)
    return found


def _digest_or_path(path: Path) -> str:
    try:
        return pixel_digest(path)
    except DataError:
        return str(path)


def _repeated(paths: Sequence[Path], digest: Callable[[Path], str]) -> dict[Path, Path]:
    first: dict[str, Path] = {}
    found = {}
    for path in paths:
        original = first.setdefault(digest(path), path)
        if original != path:
            found[path] = original
    return found
