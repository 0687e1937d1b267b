"""Masks of photographs by their names: one rule for scene folders, `fprf process` and references.

A mask of images/a/0001.jpg is, the best first:

1. masks/a/0001.jpg.png, as COLMAP has it
2. masks/a/0001.jpg, or 0001 with the suffix of another kind of image
3. 0001 with a word for masks before or behind it: 0001_mask.png, mask_0001.png, 0001.mask.png,
   0001_0_mask_0.png (several of one photograph: the first)
4. the number alone, or with such a word, where the photograph is called frame_0001, IMG_0001 and the like

Folders of masks may leave out the folder of the images, or all folders where names stay different without.
Case, outer blanks and Unicode's normal form don't matter. `masks`, `mask`, `Masks` or `masks_4` may be called
the folder itself.
"""

import os
import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from .images import IMAGE_SUFFIXES
from .picture_names import MASK_WORDS, SKY_WORDS, numbered, spelling, without_suffixes, without_words


class MaskKind(NamedTuple):
    """Subjects of masks, by the names of their folders and files."""

    folder: str
    folders: re.Pattern[str]
    """Names of their folders, spelled, without blanks, `_` and `-`."""
    words: str
    """Words in names of files."""


USED = MaskKind("masks", re.compile(r"masks?\d*"), MASK_WORDS)
SKY = MaskKind("sky_masks", re.compile(r"skymasks?\d*"), SKY_WORDS)


class FoundMasks(NamedTuple):
    """Masks of some photographs."""

    masks: tuple[Path | None, ...]
    """A mask for each; None = none. Empty where there is none for any."""
    notes: list[str]
    """Misfits, one line for each kind of masks."""


def match_masks(
    photographs: Sequence[Path], files: Sequence[Path], words: str = MASK_WORDS
) -> list[int | None]:
    """The number of the mask of each photograph; None = none fits.

    Paths of photographs are relative to the folder that the masks' folder lies in, or one further up; those of
    files to the masks' folder.
    """
    known = _Photographs(photographs)
    best: list[tuple[int, bool, str, int] | None] = [None] * len(photographs)
    for number, file in enumerate(files):
        name = _plain(file.name)
        folder = _folder_of(file)
        rank, owners = known.owners(name, folder, words)
        # Of several files for one photograph: the likeliest name, PNG before what is lossy, the first by name.
        offer = (rank, not name.endswith(".png"), name, number)
        for owner in owners:
            held = best[owner]
            if held is None or offer < held:
                best[owner] = offer
    found: list[int | None] = []
    for each in best:
        found.append(None if each is None else each[3])
    return found


class _Photographs:
    """Photographs by their spelled names, by these without suffixes, and by their numbers alone."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self.folders = [_folder_of(path) for path in paths]
        self.by_name = defaultdict[str, list[int]](list)
        self.by_stem = defaultdict[str, list[int]](list)
        self.by_number = defaultdict[str, list[int]](list)
        for k, path in enumerate(paths):
            name = _plain(path.name)
            self.by_name[name].append(k)
            stem = name
            for stem in without_suffixes(name):
                self.by_stem[stem].append(k)
            self.by_number[numbered(stem)].append(k)

    def owners(self, name: str, folder: tuple[str, ...], words: str) -> tuple[int, list[int]]:
        """The photographs that a file of this name is the mask of, and how unlikely its name is, from 0 on."""
        stems = list(without_suffixes(name))
        bases: list[str] = []
        for stem in stems:
            bases += without_words(stem, words)
        tries = [(self.by_name, stems[:1]), (self.by_name, [name]), (self.by_stem, stems)]
        tries += [(self.by_name, bases), (self.by_stem, bases)]
        for rank, (index, keys) in enumerate(tries):
            for key in keys:
                if owners := self._in_folder(index.get(key, []), folder):
                    return rank, owners
        for key in (*bases, *stems):
            owners = self._in_folder(self.by_number.get(numbered(key), []), folder)
            if len(owners) == 1:
                return len(tries), owners
        return len(tries), []

    def _in_folder(self, numbers: list[int], folder: tuple[str, ...]) -> list[int]:
        """Those that lie in a folder of the masks' folder: with or without that of the images, or with less
        where no two folders have the name.
        """
        ends = []
        for k in numbers:
            if _ends_with(self.folders[k], folder):
                ends.append(k)
        near = []
        for k in ends:
            if len(self.folders[k]) - len(folder) <= 1:
                near.append(k)
        for chosen in (near, ends):
            if len({self.folders[k] for k in chosen}) == 1:
                return chosen
        return []


def _folder_of(path: Path) -> tuple[str, ...]:
    return tuple(_plain(part) for part in path.parts[:-1])


def _ends_with(folder: tuple[str, ...], end: tuple[str, ...]) -> bool:
    if len(end) <= len(folder):
        return folder[len(folder) - len(end) :] == end
    return False


def mask_folders(folder: Path, kind: MaskKind = USED) -> list[Path]:
    """Folders of masks directly in a folder; the one of the plain name before others."""
    found = []
    for name in sorted(os.listdir(folder)) if folder.is_dir() else []:
        plain = re.sub(r"[\s_\-]+", "", spelling(name))
        if kind.folders.fullmatch(plain) and (folder / name).is_dir():
            found.append((name != kind.folder, len(plain), name))
    result: list[Path] = []
    for _, _, name in sorted(found):
        result.append(folder / name)
    return result


def mask_files(folder: Path) -> list[Path]:
    """Images below a folder, relative to it, hidden ones left out."""
    files = []
    for path in sorted(folder.rglob("*")):
        inner = path.relative_to(folder)
        hidden = any(part.startswith(".") for part in inner.parts)
        if not hidden and path.suffix.lower() in IMAGE_SUFFIXES and path.is_file():
            files.append(inner)
    return files


class _Search:
    """Masks of some photographs, as they are found folder by folder."""

    def __init__(self, photographs: Sequence[Path], words: str) -> None:
        self.photographs = photographs
        self.words = words
        self.masks: list[Path | None] = [None] * len(photographs)
        self.folders: list[Path] = []
        self.count = 0
        self.unused: list[Path] = []

    def look_into(self, folder: Path, members: Sequence[int]) -> None:
        """Take the masks in a folder of masks for photographs that have none yet."""
        files = mask_files(folder)
        self.folders.append(folder)
        self.count += len(files)
        self.unused += self._take(folder, files, members, folder.parent)

    def look_beside(self) -> None:
        """Take masks in the folders of the photographs, where names say that they are: 0001_mask.png."""
        known = set(self.photographs)
        by_folder = defaultdict[Path, list[int]](list)
        for k, path in enumerate(self.photographs):
            if self.masks[k] is None:
                by_folder[path.parent].append(k)
        for folder, members in by_folder.items():
            files = []
            for name in sorted(os.listdir(folder)) if folder.is_dir() else []:
                named = re.search("mask|msk", spelling(name)) and not name.startswith(".")
                if named and folder / name not in known and Path(name).suffix.lower() in IMAGE_SUFFIXES:
                    files.append(Path(name))
            self._take(folder, files, members, folder)

    def _take(self, folder: Path, files: Sequence[Path], members: Sequence[int], base: Path) -> list[Path]:
        """Take masks for photographs, whose paths count from `base`; the files that are left over."""
        paths = []
        for k in members:
            paths.append(_relative(self.photographs[k], base))
        chosen = match_masks(paths, files, self.words)
        for k, number in zip(members, chosen, strict=True):
            if self.masks[k] is None and number is not None:
                self.masks[k] = folder / files[number]
        taken = set(chosen)
        found: list[Path] = []
        for number, file in enumerate(files):
            if number not in taken:
                found.append(folder / file)
        return found

    def found(self) -> FoundMasks:
        """The masks, and what does not fit in one line."""
        masks = tuple(self.masks) if any(self.masks) else ()
        return FoundMasks(masks, self._notes())

    def _notes(self) -> list[str]:
        bare = []
        for path, mask in zip(self.photographs, self.masks, strict=True):
            if mask is None:
                bare.append(path)
        if not (bare or self.unused) or not (self.folders or any(self.masks)):
            return []
        where = self.folders[0] if self.folders else bare[0].parent
        if len(bare) == len(self.photographs):
            image = bare[0]
            if self.unused:
                like = f", like {self.unused[0].name},"
            else:
                like = ""
            return [
                f"{where}: none of its {self.count} images{like} is a mask by its name, so nothing is masked; call that of "
                f"{image.name} {image.name}.png, {image.stem}.png or {image.stem}_mask.png"
            ]
        said = []
        if bare:
            count = f"{len(bare)} of {len(self.photographs)} images"
            said.append(f"{count} have none and are used whole, like {bare[0].name}")
        if self.unused:
            count = f"{len(self.unused)} of {self.count} files"
            said.append(f"{count} are left over, like {self.unused[0].name}")
        return [f"masks in {where}: {'; '.join(said)}"]


def masks_in(folder: Path, photographs: Sequence[Path], *, for_all: bool = True) -> FoundMasks:
    """Masks of photographs in one folder that somebody names; unless it is for all of them, masks of others are
    not told.
    """
    search = _Search(photographs, USED.words)
    search.look_into(folder, range(len(photographs)))
    if any(search.masks) and not for_all:
        search.unused = []
    return search.found()


def masks_beside(data: Path, photographs: Sequence[Path], kind: MaskKind = USED) -> FoundMasks:
    """Masks of a scene's photographs: in a folder beside theirs, or beside one around that, up to the scene's;
    else in their own folder.
    """
    search = _Search(photographs, kind.words)
    for folder, members in _folders_about(data, photographs, kind):
        search.look_into(folder, members)
    if kind is USED:
        search.look_beside()
    return search.found()


def _folders_about(
    data: Path, photographs: Sequence[Path], kind: MaskKind
) -> Iterator[tuple[Path, list[int]]]:
    """Folders of masks, the nearest first, each with the photographs that it may be of."""
    beside = defaultdict[Path, list[int]](list)
    within = defaultdict[Path, list[int]](list)
    for k, path in enumerate(photographs):
        for level in path.parents[1:]:
            if level == data or data in level.parents:
                beside[level].append(k)
        within[path.parent].append(k)
    inside = set()
    for path in photographs:
        inside.add(path.parent)
    given: set[Path] = set()
    # Beside the folders of the images first, then in those: images may lie in the scene's folder itself.
    for levels in (beside, within):
        for level in sorted(levels, key=lambda each: -len(each.parts)):
            for folder in mask_folders(level, kind):
                holds_images = any(folder == each or folder in each.parents for each in inside)
                if folder not in given and not holds_images:
                    given.add(folder)
                    yield folder, levels[level]


def _relative(path: Path, folder: Path) -> Path:
    if path.is_relative_to(folder):
        return path.relative_to(folder)
    return Path(path.name) if path.is_absolute() else path


def _plain(name: str) -> str:
    """A name as it is compared: `fprf process` writes blanks as _."""
    return re.sub(r"\s", "_", spelling(name))
