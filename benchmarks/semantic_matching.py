"""Which encoder finds like with like: the matching rate on painted triplets, and the classes of the town in every light.

    python benchmarks/semantic_matching.py [--encoder NAME [--encoder.FIELD VALUE ...]] [--triplets DIR] [--output JSON]

One encoder a call; its row replaces the row of the same encoder in the output. Without triplets the town alone is measured.
"""

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from fprf.cli.parsing import parse
from fprf.errors import FprfError
from fprf.evaluation.semantic_matching import palette_match, semantic_matching
from fprf.evaluation.town_classes import town_cells
from fprf.evaluation.triplets import read_triplets
from fprf.interfaces import Encoder
from fprf.io.atomic import write_json
from fprf.plugins.encoders.config import BundledSemanticConfig, EncoderConfig
from fprf.town.palettes import PALETTES

HERE = Path(__file__).resolve().parents[1]
GOALS = {"matching": 0.80, "match": 0.90}


@dataclass(frozen=True, kw_only=True)
class BenchmarkConfig:
    """What to measure, and on what."""

    encoder: EncoderConfig = BundledSemanticConfig()
    """The semantic encoder."""
    colours: bool = False
    """Measure plain colours instead of the encoder: the floor."""
    triplets: Path = HERE.parent / "shared/data/pst"
    """Folder with content, style and segmentation."""
    palette: str = "day"
    """Palette of the town whose class centroids are used; the cells of all the others are classified."""
    seeds: tuple[int, ...] = (0, 1)
    """Towns."""
    views: int = 5
    """Views of each town."""
    size: tuple[int, int] = (256, 192)
    """Width and height of a view."""
    output: Path = HERE / "benchmarks/results/semantic_matching.json"
    """Where the rows are kept."""


class Colours(Encoder):
    @property
    def identity(self) -> str:
        return "colours"

    @property
    def channels(self) -> int:
        return 3

    def forward(self, image: Tensor) -> Tensor:
        return F.avg_pool2d(image, 8)


def measure(config: BenchmarkConfig) -> dict[str, object]:
    encoder = Colours() if config.colours else config.encoder.build()
    row: dict[str, object] = {"encoder": encoder.identity, "channels": encoder.channels}
    start = time.perf_counter()
    if config.triplets.is_dir():
        row |= {"triplets": semantic_matching(encoder, read_triplets(config.triplets))}
    cells = town_cells(encoder, list(PALETTES), seeds=config.seeds, views=config.views, size=config.size)
    row |= {"town": {"known": config.palette, **palette_match(cells, config.palette)}}
    return row | {"seconds": time.perf_counter() - start}


def main() -> int:
    torch.set_num_threads(1)
    try:
        config = parse(BenchmarkConfig(), sys.argv[1:], prog="semantic_matching.py", description=__doc__ or "")
        row = measure(config)
    except FprfError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    kept = json.loads(config.output.read_text())["rows"] if config.output.is_file() else []
    rows = [r for r in kept if r["encoder"] != row["encoder"]] + [row]
    write_json(config.output, {"goals": GOALS, "rows": rows})
    print(json.dumps({**row, "goals": GOALS}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
