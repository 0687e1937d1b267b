"""Parser configs. `build` imports the implementation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from ...checks import at_least, positive
from ...plugins.config import PluginConfig

if TYPE_CHECKING:
    from ...interfaces import DataParser

__all__ = [
    "BlockNerfConfig",
    "ColmapConfig",
    "DataParserConfig",
    "LlffConfig",
    "MegaNerfConfig",
    "OdmConfig",
    "PhotoTourismConfig",
    "PolycamConfig",
    "Record3DConfig",
    "TownConfig",
    "TransformsConfig",
]


@dataclass(frozen=True, kw_only=True)
class DataParserConfig(PluginConfig):
    """Reads one capture format."""

    group: ClassVar[str] = "fprf.dataparsers"

    def build(self) -> DataParser:
        """The parser."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class LlffConfig(DataParserConfig):
    """LLFF: `poses_bounds.npy` beside a folder of images, one row an image in the order of their names."""

    images: str = ""
    """Image folder; empty = `images`, else the `images_N` that is reduced least."""

    def build(self) -> DataParser:
        """The parser."""
        from .llff import LlffParser

        return LlffParser(self)


@dataclass(frozen=True, kw_only=True)
class TransformsConfig(DataParserConfig):
    """Nerfstudio and instant-ngp `transforms.json`, or Blender's `transforms_train.json` and `transforms_test.json`."""

    file: str = ""
    """One JSON file of the folder, for example transforms_4.json; empty = transforms.json, else Blender's pair."""

    def build(self) -> DataParser:
        """The parser."""
        from .transforms import TransformsParser

        return TransformsParser(self)


@dataclass(frozen=True, kw_only=True)
class ColmapConfig(DataParserConfig):
    """A COLMAP sparse model, binary or text, in `sparse/0`, `sparse` or the folder itself."""

    images: str = "images"
    """Image folder. `images_N` holds images reduced by N: the model's cameras are then scaled to their size."""

    def build(self) -> DataParser:
        """The parser."""
        from .colmap import ColmapParser

        return ColmapParser(self)


@dataclass(frozen=True, kw_only=True)
class TownConfig(DataParserConfig):
    """The embedded scene: a small procedural town, rendered when it is asked for."""

    seed: int = 0
    """Decides where houses, trees and cars stand."""
    palette: str = "day"
    """Light and colours."""
    views: int = 40
    """Number of images."""
    width: int = 160
    """Pixels across an image."""
    height: int = 120
    """Pixels down an image."""
    extra: float = 0.0
    """Metres by which the street is longer than the usual 49: a scene for many blocks."""

    def __post_init__(self) -> None:
        at_least("parser.extra", self.extra, 0.0)
        at_least("parser.seed", self.seed, 0)
        at_least("parser.views", self.views, 2)
        at_least("parser.width", self.width, 8)
        at_least("parser.height", self.height, 8)

    def build(self) -> DataParser:
        """The parser."""
        from .town import TownParser

        return TownParser(self)


@dataclass(frozen=True, kw_only=True)
class BlockNerfConfig(DataParserConfig):
    """San Francisco Mission Bay: TFRecord files with exposure and rays of every pixel."""

    cameras: tuple[int, ...] = ()
    """Numbers of the cameras that are used; empty = all."""
    tolerance: float = 1.0
    """Pixels (root mean square) by which an image's rays may differ from those of the camera that is fitted to them."""

    def __post_init__(self) -> None:
        for number in self.cameras:
            at_least("parser.cameras", number, 0)
        positive("parser.tolerance", self.tolerance)

    def build(self) -> DataParser:
        """The parser."""
        from .blocknerf import BlockNerfParser

        return BlockNerfParser(self)


@dataclass(frozen=True, kw_only=True)
class MegaNerfConfig(DataParserConfig):
    """Mega-NeRF's layout: `train` and `val`, each with `metadata/*.pt` and `rgbs`."""

    def build(self) -> DataParser:
        """The parser."""
        from .meganerf import MegaNerfParser

        return MegaNerfParser(self)


@dataclass(frozen=True, kw_only=True)
class PhotoTourismConfig(DataParserConfig):
    """Photographs from many hands: a COLMAP model with a table of what is for training."""

    list: str = ""
    """The table, a file of the folder; empty = its only *.tsv."""

    def build(self) -> DataParser:
        """The parser."""
        from .phototourism import PhotoTourismParser

        return PhotoTourismParser(self)


@dataclass(frozen=True, kw_only=True)
class PolycamConfig(DataParserConfig):
    """Polycam's raw data: `keyframes` with images and a JSON file for each camera, corrected ones first."""

    def build(self) -> DataParser:
        """The parser."""
        from .polycam import PolycamParser

        return PolycamParser(self)


@dataclass(frozen=True, kw_only=True)
class Record3DConfig(DataParserConfig):
    """Record3D's LiDAR videos: `metadata.json` with `rgb`, or an unpacked .r3d."""

    frames: int = 300
    """At most so many images, evenly through the recording."""

    def __post_init__(self) -> None:
        at_least("parser.frames", self.frames, 1)

    def build(self) -> DataParser:
        """The parser."""
        from .record3d import Record3DParser

        return Record3DParser(self)


@dataclass(frozen=True, kw_only=True)
class OdmConfig(DataParserConfig):
    """OpenDroneMap's projects (ODM, WebODM): photographs with `opensfm/reconstruction.json` or `odm_report/shots.geojson`."""

    images: str = "images"
    """Folder of the photographs, of any size."""

    def build(self) -> DataParser:
        """The parser."""
        from .odm import OdmParser

        return OdmParser(self)
