"""Which parser a scene folder wants, from what lies in it."""

from pathlib import Path

from ...errors import DataError
from ..scene import Scene
from .blocknerf import record_files
from .colmap import model_folder
from .config import (
    BlockNerfConfig,
    ColmapConfig,
    DataParserConfig,
    LlffConfig,
    MegaNerfConfig,
    OdmConfig,
    PhotoTourismConfig,
    PolycamConfig,
    Record3DConfig,
    TownConfig,
    TransformsConfig,
)
from .odm import project_file
from .polycam import keyframes
from .record3d import recording

__all__ = ["parse_scene", "recognise"]


def recognise(data: Path) -> DataParserConfig:
    """The parser for a folder, with its defaults: transforms before LLFF before others; `town` is the embedded scene.

    The path `town`, where no such folder exists, is the embedded scene. Raises DataError saying what was looked for and
    what lies there.
    """
    if not data.exists():
        if data == Path("town"):
            return TownConfig()
        raise DataError(f"{data}: no such folder; give a scene folder, or `town` for the embedded scene")
    if not data.is_dir():
        raise DataError(f"{data}: a file; give the scene folder that it lies in, and name it with the parser's own field")
    manifests = sorted(path.name for path in data.glob("transforms*.json"))
    if {"transforms.json", "transforms_train.json"} & set(manifests):
        return TransformsConfig()
    if (data / "poses_bounds.npy").is_file():
        return LlffConfig()
    if (data / "train/metadata").is_dir():
        return MegaNerfConfig()
    if len(list(data.glob("*.tsv"))) == 1 and model_folder(data if model_folder(data) else data / "dense") is not None:
        return PhotoTourismConfig()
    if model_folder(data) is not None:
        return ColmapConfig()
    if len(manifests) == 1:
        return TransformsConfig(file=manifests[0])
    if record_files(data):
        return BlockNerfConfig()
    if keyframes(data) is not None:
        return PolycamConfig()
    if recording(data) is not None:
        return Record3DConfig()
    if project_file(data) is not None:
        return OdmConfig()
    raise DataError(
        f"{data}: no transforms.json, transforms_train.json, poses_bounds.npy or sparse/0/cameras.bin, "
        f"but {_content(data)}; choose the parser by name, or make poses with `fprf process`"
    )


def parse_scene(data: Path, downscale: int, parser: DataParserConfig | None) -> Scene:
    """The scene of a folder at 1/downscale of its size, by the parser that is named or, without one, recognised."""
    chosen = recognise(data) if parser is None else parser
    return chosen.build().parse(data, downscale)


def _content(data: Path) -> str:
    names = sorted(path.name + "/" * path.is_dir() for path in data.iterdir())
    return f"{len(names)} entries ({', '.join(names[:5])}{', ...' if len(names) > 5 else ''})" if names else "nothing"
