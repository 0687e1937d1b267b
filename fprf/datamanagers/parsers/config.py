"""Parser configs, the files that each format is known by, and the choice among all parsers that are
installed.

Confidence of the built-in formats: 0.6 to 0.9 where files were prepared for training, 0.5 for a
reconstruction that comes with its images, 0.3 for raw recordings. Prepared folders often hold the
reconstruction that they were made of.
"""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from ...checks import at_least, between, positive
from ...errors import DataError
from ...plugins import registry
from ...plugins.config import PluginConfig

if TYPE_CHECKING:
    from ...interfaces import DataParser
    from ..scene import ParsedScene


ODM_FILES = "opensfm/reconstruction.json", "odm_report/shots.geojson"


class Recognised(NamedTuple):
    """A parser's confidence that it reads a folder."""

    confidence: float
    """In (0, 1]: the parser with the highest one reads the folder; a tie is an error."""
    reason: str
    """The file or folder that it was recognised by, for example `transforms.json`."""


def model_folders(data: Path) -> list[Path]:
    """Folders of COLMAP's models in a scene folder: sparse/0, sparse/1, ... sparse, the folder itself,
    colmap/sparse/0, ...
    """
    numbered = []
    for place in ("sparse", "colmap/sparse"):
        numbered.append(sorted(path for path in (data / place).glob("*")))
    folders = [*numbered[0], data / "sparse", data, *numbered[1]]
    found: list[Path] = []
    for each in folders:
        if (each / "cameras.bin").is_file() or (each / "cameras.txt").is_file():
            found.append(each)
    return found


def is_record(name: str) -> bool:
    """Return whether a file name is that of a TFRecord file or of one of its shards."""
    return re.search(r"^[^.].*\.tfrecord(-\d+-of-\d+)?$", name) is not None


def keyframes(data: Path) -> list[tuple[Path, Path]]:
    """Folders of Polycam's images and cameras, corrected ones first; they lie in `keyframes`, which `data`
    may be.
    """
    for root in (data / "keyframes", data):
        pairs = []
        for kind in ("corrected_", ""):
            pairs.append((root / f"{kind}images", root / f"{kind}cameras"))
        there = []
        for images, cameras in pairs:
            if images.is_dir() and next(cameras.glob("[!.]*.json"), None):
                there.append((images, cameras))
        if there:
            return there
    return []


def recording(data: Path) -> tuple[Path, Path] | None:
    """Record3D's metadata and its folder of images, or None."""
    names = (("metadata.json", "rgb"), ("metadata", "rgbd"), ("metadata", "rgb"), ("metadata.json", "rgbd"))
    pairs = ((data / file, data / images) for file, images in names)
    return next(((file, images) for file, images in pairs if file.is_file() and images.is_dir()), None)


def project_file(data: Path) -> Path | None:
    """File with the poses of an OpenDroneMap project, or None."""
    files = (data / name for name in ODM_FILES)
    return next((file for file in files if file.is_file()), None)


@dataclass(frozen=True, kw_only=True)
class DataParserConfig(PluginConfig):
    """Reads one format of scene folders."""

    group: ClassVar[str] = "fprf.dataparsers"

    def recognises(self, data: Path) -> Recognised | None:
        """The confidence that `data`, which may be absent or a file, is of this format, by file names alone;
        None = not.

        By default None: such a parser is used only where it is chosen by name.
        """
        return None

    def build(self) -> DataParser:
        """The parser."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class LlffConfig(DataParserConfig):
    """LLFF: `poses_bounds.npy` beside a folder of images, one row an image in the order of their names."""

    images: str = ""
    """Image folder; empty = `images`, else the `images_N` that is reduced least."""

    def recognises(self, data: Path) -> Recognised | None:
        if (data / "poses_bounds.npy").is_file():
            return Recognised(0.8, "poses_bounds.npy")
        return None

    def build(self) -> DataParser:
        from .llff import LlffParser

        return LlffParser(self)


@dataclass(frozen=True, kw_only=True)
class TransformsConfig(DataParserConfig):
    """Nerfstudio and instant-ngp `transforms.json`, or Blender's `transforms_train.json` and
    `transforms_test.json`.
    """

    file: str = ""
    """One JSON file of the folder, for example transforms_4.json; empty = transforms.json, else Blender's
    pair, else the only transforms*.json.
    """

    def recognises(self, data: Path) -> Recognised | None:
        """By `transforms.json` or `transforms_train.json`, with less confidence by the only other
        transforms*.json.
        """
        names = sorted(path.name for path in data.glob("transforms*.json"))
        known = []
        for name in names:
            if name in ("transforms.json", "transforms_train.json"):
                known.append(name)
        if known:
            return Recognised(0.9, known[0])
        if len(names) == 1:
            return Recognised(0.4, names[0])
        return None

    def build(self) -> DataParser:
        from .transforms import TransformsParser

        return TransformsParser(self)


@dataclass(frozen=True, kw_only=True)
class ColmapConfig(DataParserConfig):
    """A COLMAP sparse model, binary or text: of those in `sparse/*`, `sparse` and the folder itself that of
    the most images.
    """

    images: str = "images"
    """Image folder. `images_N` holds images reduced by N: the model's cameras are then scaled to their
    size.
    """

    def recognises(self, data: Path) -> Recognised | None:
        folder = next(iter(model_folders(data)), None)
        if folder is not None:
            return Recognised(0.5, f"a model in {folder}")
        return None

    def build(self) -> DataParser:
        from .colmap import ColmapParser

        return ColmapParser(self)


@dataclass(frozen=True, kw_only=True)
class GardenConfig(DataParserConfig):
    """The embedded scene: 25 photographs of a garden in Seattle, with their poses. Reads no folder."""

    def recognises(self, data: Path) -> Recognised | None:
        """By the path `garden`, where there is no such folder, or one that a run of it has begun or left."""
        left = data.is_dir() and (
            (data / "config.json").is_file() or all(each.name.startswith(".") for each in data.iterdir())
        )
        mine = data == Path("garden") and (left or not data.exists())
        if mine:
            return Recognised(0.1 if left else 1.0, "the embedded scene")
        return None

    def build(self) -> DataParser:
        from .transforms import GardenParser

        return GardenParser()


@dataclass(frozen=True, kw_only=True)
class BlockNerfConfig(DataParserConfig):
    """San Francisco Mission Bay: TFRecord files with exposure and rays of every pixel."""

    cameras: tuple[int, ...] = ()
    """Numbers of the cameras that are used; empty = all."""
    tolerance: float = 1.0
    """Pixels (root mean square) by which an image's rays may differ from those of the camera that is fitted
    to them.
    """

    def __post_init__(self) -> None:
        for number in self.cameras:
            at_least("parser.cameras", number, 0)
        positive("parser.tolerance", self.tolerance)

    def recognises(self, data: Path) -> Recognised | None:
        """By TFRecord files, at most three folders down."""
        names = (
            path.name
            for depth in ("*", "*/*", "*/*/*", "*/*/*/*")
            for path in data.glob(f"{depth}.tfrecord*")
        )
        record = next(filter(is_record, names), None)
        if record is not None:
            return Recognised(0.3, record)
        return None

    def build(self) -> DataParser:
        from .blocknerf import BlockNerfParser

        return BlockNerfParser(self)


@dataclass(frozen=True, kw_only=True)
class MegaNerfConfig(DataParserConfig):
    """Mega-NeRF's layout: `train` and `val`, each with `metadata/*.pt` and `rgbs`."""

    def recognises(self, data: Path) -> Recognised | None:
        if (data / "train/metadata").is_dir():
            return Recognised(0.7, "train/metadata")
        return None

    def build(self) -> DataParser:
        from .meganerf import MegaNerfParser

        return MegaNerfParser()


@dataclass(frozen=True, kw_only=True)
class PhotoTourismConfig(DataParserConfig):
    """Photographs from many hands: a COLMAP model with a table of what is for training."""

    list: str = ""
    """The table, a file of the folder; empty = its only *.tsv."""

    def recognises(self, data: Path) -> Recognised | None:
        """By the only *.tsv beside a model, or beside `dense` with a model."""
        tables = []
        for path in data.glob("[!.]*.tsv"):
            tables.append(path.name)
        modelled = model_folders(data) or model_folders(data / "dense")
        if len(tables) == 1 and modelled:
            return Recognised(0.6, tables[0])
        return None

    def build(self) -> DataParser:
        from .phototourism import PhotoTourismParser

        return PhotoTourismParser(self)


@dataclass(frozen=True, kw_only=True)
class PolycamConfig(DataParserConfig):
    """Polycam's raw data: `keyframes` with images and a JSON file for each camera, corrected ones first."""

    def recognises(self, data: Path) -> Recognised | None:
        folders = keyframes(data)
        if folders:
            return Recognised(0.3, str(folders[0][1]))
        return None

    def build(self) -> DataParser:
        from .polycam import PolycamParser

        return PolycamParser()


@dataclass(frozen=True, kw_only=True)
class Record3DConfig(DataParserConfig):
    """Record3D's LiDAR videos: `metadata.json` with `rgb`, or an unpacked .r3d."""

    frames: int = 300
    """At most so many images, evenly through the recording."""

    def __post_init__(self) -> None:
        at_least("parser.frames", self.frames, 1)

    def recognises(self, data: Path) -> Recognised | None:
        record = recording(data)
        if record is not None:
            return Recognised(0.3, record[0].name)
        return None

    def build(self) -> DataParser:
        from .record3d import Record3DParser

        return Record3DParser(self)


@dataclass(frozen=True, kw_only=True)
class OdmConfig(DataParserConfig):
    """OpenDroneMap's projects (ODM, WebODM): photographs with `opensfm/reconstruction.json` or
    `odm_report/shots.geojson`.
    """

    images: str = "images"
    """Folder of the photographs, of any size."""

    def recognises(self, data: Path) -> Recognised | None:
        record = project_file(data)
        if record is not None:
            return Recognised(0.3, record.name)
        return None

    def build(self) -> DataParser:
        from .odm import OdmParser

        return OdmParser(self)


def recognise(data: Path) -> DataParserConfig:
    """The parser with the highest confidence, with its defaults; `garden`, where no such folder exists, is
    the embedded scene.

    A parser that raises is skipped, with a warning on standard error. Raises DataError where no parser
    recognises the folder, or where several have the same confidence.
    """
    # Every installed parser is asked; those of the highest confidence are kept.
    group = DataParserConfig.group
    best = 0.0
    surest: dict[str, tuple[DataParserConfig, str]] = {}
    for name, entries in registry.installed(group).items():
        try:
            config = registry.make(group, name, DataParserConfig)
            answer = config.recognises(data)
            confidence, reason = answer or (0.0, "")
            between("confidence", confidence, 0.0, 1.0)
        except (Exception, SystemExit) as fault:  # a stranger's
            origin = ", ".join(each.origin for each in entries)
            reason = " ".join(f"{type(fault).__name__}: {fault}".split())
            print(f"warning: data parser {name!r} ({origin}) is skipped: {reason}", file=sys.stderr)
            continue
        if answer and confidence >= best:
            if confidence > best:
                surest = {name: (config, reason)}
            else:
                surest = {**surest, name: (config, reason)}
            best = confidence
    if len(surest) > 1:
        claims = " and by ".join(f"{name!r} ({reason})" for name, (_, reason) in surest.items())
        raise DataError(f"{data}: is recognised by {claims}; choose one with --datamanager.parser NAME")
    for config, _ in surest.values():
        return config
    # Nobody recognises it: say why.
    if not data.exists():
        raise DataError(f"{data}: no such folder; give a scene folder, or `garden` for the embedded one")
    if not data.is_dir():
        raise DataError(
            f"{data}: a file; give the scene folder that it lies in, and name it with the parser's own field"
        )
    names = sorted(path.name + "/" * path.is_dir() for path in data.iterdir())
    if names:
        content = f"{len(names)} entries ({', '.join(names[:5])}{', ...' if len(names) > 5 else ''})"
    else:
        content = "nothing"
    raise DataError(
        f"{data}: no transforms.json, sparse/0/cameras.bin or other file that a parser knows, but {content}; "
        "choose a parser with --datamanager.parser NAME, for Gaussians --parser NAME "
        f"({', '.join(registry.installed(group))}), or make poses with `fprf process`"
    )


def parse_scene(
    data: Path,
    downscale: float,
    parser: DataParserConfig | None,
    up: tuple[float, float, float] | None = None,
) -> ParsedScene:
    """The scene of a folder at 1/downscale of its size, by the parser that is named or, without one,
    recognised. `up` is the direction that points up, where it is asked for.

    Where the capture lies far from 0 the scene is in a local frame, whatever the parser
    (`ParsedScene.origin`).
    """
    from ..positions import with_north
    from ..scene import in_local_frame
    from ..up_direction import with_up

    chosen = recognise(data) if parser is None else parser
    scene = in_local_frame(chosen.build().parse(data, downscale))
    return with_north(with_up(scene, up))
