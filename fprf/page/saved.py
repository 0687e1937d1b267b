"""Work of users on a scene's page, kept in the scene's folder: photographs, looks, keyframes.

`page/page.json` is a `PageFile`; `page/photographs/HASH.png` are the photographs as `uploads` wrote them, by
the hash of their bytes. A scene's folder can hold pages of several files of Gaussians: page, page-2, and so on.

Numbers of regions mean something on one state of a scene alone. Where looks have rules, the regions' keys are
kept too, by which each is found again after further training.
"""

import contextlib
import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

import msgspec
from msgspec import Struct

from ..errors import DataError
from ..io.atomic import write_bytes
from ..plugins.codec import from_json, to_json
from ..style.config import StyleConfig
from ..style.scene_style import SceneStyle
from .looks import Look, Photograph, RegionAction, RegionRule
from .messages import Camera
from .state import Made, PageKeyframe

_DOCUMENT = "page.json"
_HASH_CHARACTERS = 32
"""Of a photograph's name in the folder: 128 bits."""


class Regions(Struct, frozen=True):
    """Regions of the scene that rules were made on."""

    keys: tuple[tuple[float, ...], ...]
    """Centroid of each region's semantic features."""
    mean: tuple[float, ...]
    """Mean of the scene's semantic features."""


def regions_now(style: SceneStyle) -> Regions:
    """The regions of a scene as they are kept."""
    return Regions(tuple(tuple(row) for row in style.keys.tolist()), tuple(style.semantic_mean.tolist()))


def regions_before(regions: Regions, now: SceneStyle) -> SceneStyle | None:
    """The scene's style with regions that were kept; None where the scene has other semantics now."""
    keys = now.keys.new_tensor(regions.keys).reshape(len(regions.keys), len(regions.mean))
    if keys.shape[1] != now.keys.shape[1]:
        return None
    return now._replace(keys=keys, semantic_mean=now.semantic_mean.new_tensor(regions.mean))


class LookFile(Struct, frozen=True):
    """A look; photographs by their hash."""

    style: dict[str, Any]
    """Fields of StyleConfig."""
    mix: tuple[tuple[str, float], ...] = ()
    rules: tuple[tuple[int, RegionAction, str | None], ...] = ()


class KeyFile(Struct, frozen=True):
    """A keyframe."""

    camera: Camera
    look: LookFile


class PageFile(Struct, frozen=True):
    """The document; photographs by their hash."""

    format: Literal[1]
    """Counts up when an older fprf could not read it."""
    of: str
    """File of Gaussians, or empty: the run in whose folder it lies."""
    photographs: dict[str, str]
    """Names."""
    shelf: tuple[str, ...]
    look: LookFile
    kept: tuple[tuple[str, LookFile], ...] = ()
    keys: tuple[KeyFile, ...] = ()
    regions: Regions | None = None


def name_within(root: Path, path: Path) -> str:
    """The name of a file of Gaussians in a scene's page: by its place in the scene's folder, so that the folder can
    be renamed.
    """
    path = path.resolve()
    root = root.resolve()
    return str(path.relative_to(root) if path.is_relative_to(root) else path)


def folder_of(root: Path, of: str) -> Path:
    """The folder of a scene's page in `root`: one that holds what was made of `of`, or a new one."""
    path = root / "page"
    number = 1
    while (path / _DOCUMENT).exists():
        with contextlib.suppress(DataError):
            found = read_page(path)
            if found is not None and found.of == of:
                break
        number += 1
        path = root / f"page-{number}"
    return path


def read_page(folder: Path) -> PageFile | None:
    """Content of a folder, or None. Raises DataError for a page.json that is none of ours."""
    path = folder / _DOCUMENT
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    try:
        return msgspec.json.decode(data, type=PageFile)
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise DataError(f"{path}: not as this version writes it ({error}); it is left alone") from error


def photograph_file(folder: Path, digest: str) -> Path:
    """The file of a photograph by its hash. Raises DataError for what is none."""
    if not (digest.isalnum() and digest.isascii() and len(digest) == _HASH_CHARACTERS):
        raise DataError(f"{folder / _DOCUMENT}: {digest[:40]!r} is no hash of a photograph")
    return folder / "photographs" / f"{digest}.png"


def digest_of(data: bytes) -> str:
    """The hash of a photograph's file."""
    return hashlib.sha256(data).hexdigest()[:_HASH_CHARACTERS]


def made_of(page: PageFile, photographs: Mapping[str, Photograph]) -> Made:
    """Work of users, with photographs by their hash; of looks the photographs that are not among them are left
    out. Raises ConfigError for a style that this version does not know.
    """

    def look_of(file: LookFile) -> Look:
        mix = []
        for digest, weight in file.mix:
            if digest in photographs:
                mix.append((photographs[digest], weight))
        rules = []
        for region, action, of in file.rules:
            if of is None or of in photographs:
                rules.append(RegionRule(region, action, None if of is None else photographs[of]))
        style = from_json(file.style, StyleConfig)
        return Look(mix=tuple(mix), style=style, rules=frozenset(rules))

    keys = []
    for key in page.keys:
        keys.append(PageKeyframe(key.camera, look_of(key.look)))
    return Made(
        shelf=tuple(photographs[digest] for digest in dict.fromkeys(page.shelf) if digest in photographs),
        look=look_of(page.look),
        kept=tuple((name, look_of(look)) for name, look in page.kept),
        keys=tuple(keys),
    )


def write_page(
    folder: Path, made: Made, of: str, regions: Regions | None, digests: dict[Photograph, str]
) -> None:
    """Write what was made, and photographs that are not there yet; those that nothing needs any more go.

    `digests` keeps hashes of photographs for the next time. Raises WriteError where the system refuses.
    """
    used = {*made.shelf} | made.in_use
    for photograph in used - digests.keys():
        data = photograph.path.read_bytes()
        digests[photograph] = digest_of(data)
    for photograph in used:
        path = photograph_file(folder, digests[photograph])
        if not path.is_file():
            write_bytes(path, photograph.path.read_bytes())

    def file_of(look: Look) -> LookFile:
        rules = []
        for rule in sorted(look.rules, key=lambda rule: (rule.region, rule.action)):
            named = None if rule.photograph is None else digests[rule.photograph]
            rules.append((rule.region, rule.action, named))
        mix: dict[str, float] = {}
        for photograph, weight in look.mix:
            mix[digests[photograph]] = mix.get(digests[photograph], 0.0) + weight
        return LookFile(to_json(look.style), tuple(mix.items()), tuple(rules))

    # A photograph that was dropped twice is one file, and one photograph when it comes back.
    names: dict[str, str] = {}
    for photograph in (*made.shelf, *used):
        names.setdefault(digests[photograph], photograph.name)
    document = PageFile(
        format=1,
        of=of,
        photographs=names,
        shelf=tuple(dict.fromkeys(digests[each] for each in made.shelf)),
        look=file_of(made.look),
        kept=tuple((name, file_of(look)) for name, look in made.kept),
        keys=tuple(KeyFile(key.camera, file_of(key.look)) for key in made.keys),
        regions=regions,
    )
    write_bytes(folder / _DOCUMENT, msgspec.json.format(msgspec.json.encode(document), indent=1))
    _remove_others(folder, {digests[each] for each in used})


def _remove_others(folder: Path, used: Iterable[str]) -> None:
    """Remove photographs that the document does not name."""
    names = {f"{digest}.png" for digest in used}
    for path in (folder / "photographs").glob("*.png"):
        if path.name not in names:
            path.unlink(missing_ok=True)
