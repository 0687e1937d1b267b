"""Photo Tourism with a list: a COLMAP model of photographs from many hands, and a table of which are for
training.

The table (`*.tsv`: filename, id, split, dataset) is that of NeRF in the Wild; photographs without an id or
not in it are left out. The model lies in the folder or in `dense`.
"""

import csv
from dataclasses import replace
from pathlib import Path

from ...errors import DataError
from ...interfaces import DataParser
from ..scene import ParsedScene
from .colmap import ColmapParser
from .config import ColmapConfig, PhotoTourismConfig, model_folders
from .files import name_of


class PhotoTourismParser(DataParser):
    """A COLMAP model and its table."""

    def __init__(self, config: PhotoTourismConfig) -> None:
        self.config = config

    def parse(self, data: Path, downscale: float) -> ParsedScene:
        """The listed photographs. Raises DataError where the table names none of the model's."""
        # The table says which photographs are used; their poses are those of the model beside it.
        if self.config.list:
            tables = [data / self.config.list]
        else:
            tables = sorted(data.glob("[!.]*.tsv"))
        if len(tables) != 1:
            raise DataError(
                f"{data}: {len(tables)} tables *.tsv; exactly one is needed, or its name in parser.list"
            )
        table = tables[0]
        if not table.is_file():
            raise DataError(f"{table}: no such table; name one of the folder's with parser.list")
        if not model_folders(data) and (data / "dense").is_dir():
            inner = data / "dense"
        else:
            inner = data
        scene = ColmapParser(ColmapConfig()).parse(inner, downscale, read_list(table))
        if not len(scene.train):
            raise DataError(
                f"{table}: none of its training photographs is in the model of {inner}; is it another scene's?"
            )
        return replace(scene, name=name_of(data))


def read_list(path: Path) -> dict[str, str]:
    """`train` or `test` by file name, of the photographs that have an id. Raises DataError."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file, delimiter="\t"))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{path}: cannot be read ({error}); download the table again") from error
    # Photographs without an id were left out of the split.
    views = {}
    for number, row in enumerate(rows, 2):
        name = row.get("filename")
        split = row.get("split")
        id_ = row.get("id")
        if not name or split is None or id_ is None:
            raise DataError(
                f"{path}: line {number} lacks filename, id or split; they are columns apart by tabs"
            )
        if not id_.strip() or id_.strip().lower() == "nan":
            continue
        if split not in ("train", "test"):
            raise DataError(f"{path}: line {number}: split is {split!r}; train and test are known")
        views[name] = split
    return views
