"""The embedded town: rendered once per settings into the user's cache, then read like any other scene."""

import os
from dataclasses import asdict, replace
from pathlib import Path

from ...errors import DataError
from ...interfaces import DataParser
from ..scene import Scene
from .config import TownConfig, TransformsConfig


class TownParser(DataParser):
    """Renders the town where there is none yet."""

    def __init__(self, config: TownConfig) -> None:
        self.config = config

    def parse(self, data: Path, downscale: int) -> Scene:
        """The scene. A town folder is read as it is; the literal `town` and paths that don't exist mean the town of the
        config's settings, from the cache. Raises DataError where a folder holds something else.
        """
        from ...town.write import TownSettings, is_town, write_town
        from .transforms import TransformsParser

        parser, c = TransformsParser(TransformsConfig()), self.config
        if is_town(data):
            return parser.parse(data, downscale)
        if data.exists() and data != Path("town"):
            raise DataError(f"{data}: no town.json, so this is not a town; give `town`, or choose another parser")
        settings = TownSettings(
            seed=c.seed, palette=c.palette, views=c.views, width=c.width, height=c.height, extra=float(c.extra)
        )
        folder = cache_folder() / f"town-{settings.key}"
        write_town(folder, **{k: v for k, v in asdict(settings).items() if k != "edition"})
        return replace(parser.parse(folder, downscale), name="town")


def cache_folder() -> Path:
    """Folder for generated scenes."""
    named = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(named) if named else Path.home() / ".cache") / "fprf"
