"""Time and error of decoding JPEG photographs, against OpenCV's bare decoder on the same bytes.

    python -m benchmarks images [--repeats 7] [--output benchmarks/results/images.json]

Photographs are made here: four of 0.5 and four of 12 megapixels. Both sides decode them in a thread pool, at full size and
reduced to a third as a scene's cameras would ask for it; sides alternate, and the least time of each counts. OpenCV reads no
colour profile and turns no orientation: it is what decoding costs at least, and how fprf decoded before it used Pillow.
"""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from fprf.datamanagers.images import Image, load_image

from .common import RESULTS, arguments, report

SIZES = {"0.5 MP": (832, 624), "12 MP": (4032, 3024)}
COUNT, REDUCED = 4, 3


def photograph(size: tuple[int, int], seed: int) -> Image:
    """Blobs of several scales and some noise: a JPEG of it has as many bytes a pixel as a photograph."""
    draw = np.random.default_rng(seed)
    made = np.zeros((size[1], size[0], 3), np.float32)
    for cells in (4, 16, 64, 256):
        coarse = draw.normal(0, 36, (cells, cells, 3)).astype(np.float32)
        made += cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)
    return np.clip(made + 128 + draw.normal(0, 3, made.shape), 0, 255).astype(np.uint8)


def by_opencv(path: Path, size: tuple[int, int] | None) -> Image:
    found = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    pixels = cv2.cvtColor(found, cv2.COLOR_BGR2RGB)
    return np.asarray(pixels if size is None else cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)


def seconds(load: Callable[[Path], Image], paths: list[Path]) -> float:
    begun = time.perf_counter()
    with ThreadPoolExecutor() as pool:
        list(pool.map(load, paths))
    return time.perf_counter() - begun


def main(argv: list[str]) -> int:
    parser = arguments("images", __doc__)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--output", type=Path, default=RESULTS / "images.json")
    chosen = parser.parse_args(argv)
    rows = []
    with TemporaryDirectory() as folder:
        for name, size in SIZES.items():
            paths = [Path(folder) / f"{name} {k}.jpg" for k in range(COUNT)]
            for k, path in enumerate(paths):
                cv2.imwrite(str(path), photograph(size, k), [cv2.IMWRITE_JPEG_QUALITY, 93])
            for reduced in (False, True):
                wanted = (size[0] // REDUCED, size[1] // REDUCED) if reduced else None
                sides: dict[str, Callable[[Path], Image]] = {
                    "fprf": lambda path, wanted=wanted: load_image(path, wanted),
                    "opencv": lambda path, wanted=wanted: by_opencv(path, wanted),
                }
                times: dict[str, list[float]] = {side: [] for side in sides}
                for _ in range(chosen.repeats):
                    for side, load in sides.items():
                        times[side].append(seconds(load, paths))
                least = {side: min(each) / COUNT for side, each in times.items()}
                apart = max(
                    int(np.abs(np.subtract(*(load(p).astype(np.int16) for load in sides.values()))).max()) for p in paths
                )
                rows.append({"photographs": name, "reduced": reduced, "seconds_each": least,
                             "ratio": least["fprf"] / least["opencv"], "largest_difference": apart})  # fmt: skip
                print(f"{name}, {'reduced' if reduced else 'full size'}: {rows[-1]['ratio']:.2f} of OpenCV's time, "
                      f"largest difference {apart}")  # fmt: skip
    report(chosen.output, {"benchmark": "images", "count": COUNT, "rows": rows})
    return 0
