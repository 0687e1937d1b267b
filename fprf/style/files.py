"""Files of styles, without torch: `style.json`, and `keys.json` for styles along a camera path.

`style.json` is a style that can be saved, shared, edited by hand and applied to another scene.

    {"format": 1, "style": {the fields of StyleConfig}, "sha256": {path: hash}, "semantic_encoder": identity,
     "regions": {name: [key in the encoder's own channels]}, "made": what a run measured}

Only "format" and "style" must be there; "$schema" may name the file's schema, for editors (`fprf
config-schema`). Paths are relative to the file, or absolute. A region that the style names is found on another
scene by its key, since numbers mean something on one scene alone.

`keys.json` says which frame has which style; between two of them one fades into the other.

    {"format": 1, "keyframes": [{"frame": 0, "style": "day/style.json"}, {"frame": 48, "style": null}]}

Paths are relative to the file, or absolute; null is the scene as it is. The fade is a smoothstep, so it
starts and ends without a jerk; before the first key and after the last, their styles hold.
"""

import hashlib
import json
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from ..checks import at_least
from ..errors import ConfigError, DataError
from ..io.atomic import write_json
from ..io.paths import as_path
from ..plugins import slots
from ..plugins.captures import captures_in, is_scene
from ..plugins.codec import from_json, packages_of, read_json, to_json
from ..plugins.registry import nearest
from .config import NO_MASK, StyleConfig

_STYLE_FORMAT = 1
"""Of style.json: counts up when an older fprf could not read it."""
_SCHEMA_KEY = "$schema"
"""Key of the place of a file's schema, for editors (`fprf config-schema`)."""
_STYLE_KEYS = (
    _SCHEMA_KEY,
    "format",
    "fprf",
    "plugins",
    "style",
    "sha256",
    "semantic_encoder",
    "regions",
    "made",
)

RegionKey = tuple[float, ...]
S = TypeVar("S", bound=StyleConfig)


class StyleFile(NamedTuple):
    """Content of a style file; paths relative to the working directory."""

    style: StyleConfig
    regions: Mapping[str, RegionKey] = {}
    """Regions of the scene that the style was made on, by their semantics in the encoder's own channels."""
    semantic_encoder: str = ""
    """Identity of the encoder that the keys are of."""
    sha256: Mapping[Path, str] = {}
    """Hash of each photograph and mask when the style was saved."""


def read_style(path: Path, *, centred: bool = True) -> StyleFile:
    """Read a style file; `centred` is that of a stylizer that has it, where the file does not say.

    Raises ConfigError naming the file and the field.
    """
    whole = read_json(path, "a style.json, as `fprf stylize` writes it")
    try:
        if (
            not isinstance(whole, dict)
            or whole.get("format") != _STYLE_FORMAT
            or not isinstance(whole.get("style"), dict)
        ):
            raise ConfigError(
                f'expected an object with "format": {_STYLE_FORMAT} and "style", as `fprf stylize` writes it'
            )
        for key in whole:
            if key not in _STYLE_KEYS:  # a typing error would otherwise go unnoticed
                raise ConfigError(
                    f"unknown key {key!r}{nearest(key, list(_STYLE_KEYS))} (allowed: {', '.join(_STYLE_KEYS)})"
                )
        fields = whole["style"]
        if "fprf" in whole and "bold" not in fields:  # saved before there was light: all was painted
            fields = {**fields, "bold": 1.0}
        stylizer = fields.get("stylizer", {})
        if (
            isinstance(stylizer, dict) and stylizer.get("similarity") == "cosine"
        ):  # once a choice, now how it is always done
            fields = {
                **fields,
                "stylizer": {name: value for name, value in stylizer.items() if name != "similarity"},
            }
        style = from_json(fields, StyleConfig, packages=from_json(whole.get("plugins", {}), dict[str, str]))
        if "centred" not in stylizer and hasattr(style.stylizer, "centred"):
            style = slots.replace(style, "stylizer.centred", centred)
        hashes = from_json(whole.get("sha256", {}), dict[str, str])
        regions = from_json(whole.get("regions", {}), dict[str, tuple[float, ...]])
        encoder = from_json(whole.get("semantic_encoder", ""), str)
        for name in regions:
            if name.isdigit() or not name or ":" in name or "=" in name:
                raise ConfigError(
                    f"regions: {name!r} is no name; a name is no number and holds neither ':' nor '='"
                )
    except ConfigError as fault:
        raise ConfigError(f"{path}: {fault}") from fault
    return StyleFile(
        _with_paths(style, partial(_resolved, path)),
        regions,
        encoder,
        {_resolved(path, Path(text)): value for text, value in hashes.items()},
    )


def write_style(path: Path, file: StyleFile, made: Mapping[str, Any] | None = None) -> None:
    """Write the style with the hashes of its photographs as they are now; `made` is kept beside it for people
    to read.
    """
    # Paths go relative, so that the folder can be moved; hashes tell when a photograph changes.
    style = file.style
    masks = []
    for p in style.masks:
        if p != NO_MASK:
            masks.append(p)
    whole = {
        "format": _STYLE_FORMAT,
        "fprf": version("fprf"),
        "plugins": packages_of(style),
        "style": to_json(_with_paths(style, partial(_portable, path))),
        "sha256": {_portable(path, p).as_posix(): _hash(p) for p in (*style.references, *masks)},
        "semantic_encoder": file.semantic_encoder,
        "regions": {name: list(key) for name, key in file.regions.items()},
    }
    if made is not None:
        whole["made"] = made
    write_json(path, whole)


def style_key(file: StyleFile) -> str:
    """A hash of a style with the content of its photographs and masks: two styles have one key if they are alike."""
    style = file.style
    whole = {
        "style": to_json(_with_paths(style, Path.resolve)),
        "sha256": [_hash(path) for path in (*style.references, *style.masks) if path != NO_MASK],
        "regions": {name: list(key) for name, key in file.regions.items()},
    }
    return hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()[:16]


def check_photographs(path: Path, file: StyleFile) -> None:
    """Raise DataError where a photograph or mask of a style file is not the one that the style was saved
    with.
    """
    for photo in (*file.style.references, *file.style.masks):
        then = file.sha256.get(photo)
        if then is not None and photo.is_file() and (now := _hash(photo)) != then:
            if photo in file.style.masks:
                flag = "--masks"
            else:
                flag = "--references"
            raise DataError(
                f"{path}: {photo} has changed since the style was saved (sha256 {then[:12]}…, now {now[:12]}…); "
                f"restore it, or name all with {flag} to take them as they are"
            )


def with_folders(style: S, report: Callable[[str], None] = warnings.warn) -> S:
    """The style with the images of each folder in the folder's place, all with its weight, and of folders of
    masks the one that has the photograph's name (`datamanagers.masks`); one folder of masks is for all.

    Images of folders that cannot be read are left out, and `report` is given the reason, and told of photographs
    without a mask. Raises DataError for a folder without a readable image, ConfigError for a mask over a folder
    and for a folder of masks of which none fits.
    """
    style = replace(style, masks=_mask_of_each(style))
    folders = set()
    for path in style.references:
        if path.is_dir() and not is_scene(path):
            folders.add(path)
    if not folders and not any(mask.is_dir() for mask in style.masks):
        return style
    from ..datamanagers.images import IMAGE_SUFFIXES, photographs

    def within(folder: Path) -> list[Path]:
        # A folder of captures stands for these, where no photograph is among them.
        pictures = any(path.suffix.lower() in IMAGE_SUFFIXES for path in folder.iterdir())
        captures = [] if pictures else captures_in(folder)
        return captures or photographs([folder], report)

    # Of folders each image once, and none that is also named itself: that has a weight, and may have masks,
    # of its own.
    count = len(style.references)
    known = set(style.references)
    rows: list[tuple[Path, float, Path]] = []
    for path, weight, mask in zip(
        style.references, style.weights or (1.0,) * count, style.masks or (NO_MASK,) * count, strict=True
    ):
        if path in folders and mask != NO_MASK and not mask.is_dir():
            raise ConfigError(
                f"masks: {mask} is for one photograph, {path} is a folder; write none, a folder of masks, or name the "
                "photographs"
            )
        if path in folders:
            files = []
            for file in within(path):
                if file not in known:
                    files.append(file)
        else:
            files = [path]
        known |= {*files}
        for file in files:
            rows.append((file, weight, mask))
    references, weights, masks = zip(*rows, strict=True)
    return replace(
        style,
        references=references,
        weights=weights if style.weights else (),
        masks=_found_masks(references, masks, report) if style.masks else (),
    )


def _mask_of_each(style: StyleConfig) -> tuple[Path, ...]:
    """The masks, one a reference; one folder is for all that are photographs."""
    given = len(style.masks)
    if given == 0 or not style.references or given == len(style.references):
        return style.masks
    folder = style.masks[0]
    if given == 1 and folder.is_dir():
        return tuple(NO_MASK if is_scene(path) else folder for path in style.references)
    raise ConfigError(
        f"masks: {given} masks for {len(style.references)} references; give one each, a folder of them, or none"
    )


def _found_masks(
    references: Sequence[Path], masks: Sequence[Path], report: Callable[[str], None]
) -> tuple[Path, ...]:
    """The mask of each photograph, in the place of the folder that it lies in."""
    from ..datamanagers.masks import masks_in

    found = list(masks)
    for folder in {mask for mask in masks if mask != NO_MASK and mask.is_dir()}:
        members = [k for k, mask in enumerate(masks) if mask == folder]
        there = masks_in(folder, [references[k] for k in members], for_all=False)
        if not there.masks:
            raise ConfigError(f"masks: {' '.join(there.notes)}")
        for note in there.notes:
            report(note)
        for k, mask in zip(members, there.masks, strict=True):
            found[k] = NO_MASK if mask is None else mask
    return tuple(found)


def _with_paths(style: StyleConfig, change: Callable[[Path], Path]) -> StyleConfig:
    return replace(
        style,
        references=tuple(map(change, style.references)),
        masks=tuple(p if p == NO_MASK else change(p) for p in style.masks),
        between=None if style.between is None else change(style.between),
    )


def _resolved(file: Path, path: Path) -> Path:
    """Resolve a path of the file: relative to the file, else beside it, where a shared style has it."""
    path = as_path(path)
    whole = file.parent / path
    beside = file.parent / path.name
    if not whole.exists() and beside.exists():
        return beside
    return whole


def _portable(file: Path, path: Path) -> Path:
    """Make a path relative to a file in whose folder or below it lies, so that both can be moved; else
    absolute.
    """
    here = Path(os.path.abspath(file.parent))
    there = Path(os.path.abspath(path))
    if there.is_relative_to(here):
        return there.relative_to(here)
    return there


def _hash(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise DataError(
            f"{path}: cannot be read ({error.strerror}); check the path and its permissions"
        ) from error


@dataclass(frozen=True)
class Keyframe:
    """A frame, from 0, and its style file; None = the scene as it is."""

    frame: int
    style: Path | None

    def __post_init__(self) -> None:
        at_least("frame", self.frame, 0)


def read_keyframes(path: Path) -> tuple[Keyframe, ...]:
    """The keys of a file, by frame. Raises ConfigError naming the file and the key."""
    whole = read_json(
        path, 'a keyframe file: {"format": 1, "keyframes": [{"frame": 0, "style": "style.json"}]}'
    )
    try:
        if (
            not isinstance(whole, dict)
            or whole.keys() - {_SCHEMA_KEY} != {"format", "keyframes"}
            or whole["format"] != _STYLE_FORMAT
        ):
            raise ConfigError(
                f'expected an object with "format": {_STYLE_FORMAT} and "keyframes", and nothing else'
            )
        keys = from_json(whole["keyframes"], list[Keyframe], path="keyframes")
        if not keys or len({key.frame for key in keys}) < len(keys):
            raise ConfigError("keyframes: at least one is needed, and no two at one frame")
    except ConfigError as fault:
        raise ConfigError(f"{path}: {fault}") from fault
    # Paths are relative to the file.
    found = (key if key.style is None else replace(key, style=path.parent / key.style) for key in keys)
    return tuple(sorted(found, key=lambda key: key.frame))


def fade(frames: Sequence[int], at: int) -> tuple[int, int, float]:
    """Find the keys before and after a frame, as places in `frames` (sorted), and how far it is between them,
    in [0, 1].
    """
    after = next((i for i, frame in enumerate(frames) if frame > at), len(frames))
    if after == 0 or after == len(frames):
        only = min(after, len(frames) - 1)
        return only, only, 0.0
    way = (at - frames[after - 1]) / (frames[after] - frames[after - 1])
    return after - 1, after, way * way * (3 - 2 * way)
