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
        from ...town.write import is_town
        from .transforms import TransformsParser

        if is_town(data):
            return TransformsParser(TransformsConfig()).parse(data, downscale)
        if data.exists() and data != Path("town"):
            raise DataError(f"{data}: no town.json, so this is not a town; give `town`, or choose another parser")
        scene = TransformsParser(TransformsConfig()).parse(self._rendered(), downscale)
        return replace(scene, name="town")

    def _rendered(self) -> Path:
        from ...town.write import TownSettings, write_town

        c = self.config
        settings = TownSettings(
            seed=c.seed, palette=c.palette, views=c.views, width=c.width, height=c.height, extra=float(c.extra)
        )
        folder = cache_folder() / f"town-{settings.key}"
        write_town(folder, **{k: v for k, v in asdict(settings).items() if k != "edition"})
        return folder


def cache_folder() -> Path:
    """Folder for generated scenes."""
    named = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(named) if named else Path.home() / ".cache") / "fprf"
