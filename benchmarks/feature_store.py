"""Feature targets: size and error against the exact guided filter for each stride, and the time of a batch.

    python -m benchmarks feature_store [--shared ../shared] [--output benchmarks/results/feature_store.json]

Errors are root mean squares over all pixels and the first 32 channels, half precision included, divided by the standard
deviation of the exact filter's output; the worst of the photographs is given. Times are seconds of one core (thread time).
"""

import math
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from fprf.datamanagers import features as store_files
from fprf.datamanagers.config import GuidedConfig
from fprf.datamanagers.features import extract
from fprf.datamanagers.images import load_image
from fprf.interfaces import Encoder
from fprf.ops import guided
from fprf.plugins.encoders.config import RandomConfig, Vgg19Config

from .common import RESULTS, SHARED, arguments, report

PHOTOS = ("scenes/llff_flower/images_8", "scenes/street_lund/images", "scenes/fox/images")
MEASURED = 32
EPS = 1e-3
Row = dict[str, str | float | None]


def photographs(shared: Path, longer: int, shorter: int) -> list[Tensor]:
    """One of each scene as [H W 3] in [0, 1], portrait or landscape as it is."""
    result = []
    for name in PHOTOS:
        path = sorted((shared / "data" / name).iterdir())[3]
        upright = load_image(path).shape[0] > load_image(path).shape[1]
        image = load_image(path, (shorter, longer) if upright else (longer, shorter))
        result.append(torch.from_numpy(image).float() / 255)
    return result


def dense(coefs: Tensor, guide: Tensor) -> Tensor:
    """Coefficients at every pixel: [H W C]."""
    every = F.interpolate(coefs.permute(3, 2, 0, 1), guide.shape[:2], mode="bilinear")
    return ((every[:3] * guide.permute(2, 0, 1)[:, None]).sum(0) + every[3]).permute(1, 2, 0)


def subsampled(features: Tensor, guide: Tensor, radius: int, by: int) -> Tensor:
    """The usual fast guided filter: guide and features subsampled, coefficients upsampled."""
    small = guide[by // 2 :: by, by // 2 :: by].contiguous()
    maps = F.interpolate(features[None], small.shape[:2], mode="bilinear")[0]
    reach = max(1, round(radius / by))
    return dense(guided.coefficients(maps, small, radius=reach, eps=EPS, stride=1, fineness=math.inf), guide)


def relative(found: Tensor, truth: Tensor) -> float:
    return float((found - truth).square().mean().sqrt() / truth.flatten(0, 1).var(0).mean().sqrt())


def row(name: str, value: float, unit: str, goal: float | None = None, peer: float | None = None) -> Row:
    rounded = None if peer is None else float(f"{peer:.4g}")
    return {"name": name, "figure": float(f"{value:.4g}"), "unit": unit, "goal": goal, "peer": rounded}


def accuracy(label: str, encoder: Encoder, guides: list[Tensor], strides: tuple[int, ...]) -> list[Row]:
    """Error and size per stride, and the subsampling filter as the peer at the same stride."""
    radius = round(GuidedConfig().radius * min(guides[0].shape[:2]))
    errors: dict[int, list[float]] = {s: [] for s in strides}
    peers: dict[int, list[float]] = {s: [] for s in strides}
    seconds: dict[int, list[float]] = {s: [] for s in strides}
    size: dict[int, int] = {}
    full = []
    for guide in guides:
        maps = encoder(guide.permute(2, 0, 1)[None])[0].float()
        some = maps[:MEASURED]
        start = time.thread_time()
        truth = dense(guided.coefficients(some, guide, radius=radius, eps=EPS, stride=1, fineness=math.inf), guide)
        full.append((time.thread_time() - start) * len(maps) / len(some))
        for stride in strides:
            start = time.thread_time()
            coefs = guided.coefficients(maps, guide, radius=radius, eps=EPS, stride=stride)
            seconds[stride].append(time.thread_time() - start)
            entry = store_files.pack(coefs, (guide.shape[0], guide.shape[1]))
            size[stride] = entry.coefs.numel() * 2
            errors[stride].append(relative(dense(entry.plain()[:, :, :MEASURED], guide), truth))
            peers[stride].append(relative(subsampled(some, guide, radius, stride), truth))
    rows = [row(f"{label}: exact filter", statistics.median(full), "seconds_per_image")]
    for stride in strides:
        goal = 0.02 if stride == min(8, (2 * radius + 1) // 5) else None
        rows += [
            row(f"{label}, stride {stride}: error", max(errors[stride]), "feature_std", goal, max(peers[stride])),
            row(f"{label}, stride {stride}: size", size[stride] / 2**20, "mib_per_image"),
            row(f"{label}, stride {stride}: coefficients", statistics.median(seconds[stride]), "seconds_per_image"),
        ]
    return rows


def milliseconds(call: Callable[[], object], repeat: int = 50) -> float:
    call()
    times = []
    for _ in range(repeat):
        start = time.thread_time()
        call()
        times.append(time.thread_time() - start)
    return 1e3 * statistics.median(times)


def lookup() -> list[Row]:
    """4096 rays over 43 views of 135x240."""
    images = [torch.randint(256, (135, 240, 3), dtype=torch.uint8) for _ in range(43)]
    view, pixel, rgb = torch.randint(43, (4096,)), torch.rand(4096, 2) * torch.tensor([240.0, 135.0]), torch.rand(4096, 3)
    rows = []
    for channels, goal in ((48, 4.0), (128, None)):
        with tempfile.TemporaryDirectory() as folder:
            encoder = RandomConfig(channels=channels, stride=8).build()
            store = extract(Path(folder), range(43), images.__getitem__, encoder, GuidedConfig())
            taken = milliseconds(lambda store=store: store.at(view, pixel, rgb))
        rows.append(row(f"4096 rays x {channels} channels of 43 views", taken, "milliseconds_of_one_core", goal))
    return rows


def main(argv: list[str]) -> None:
    parser = arguments("feature_store", __doc__)
    parser.add_argument("--shared", type=Path, default=SHARED)
    parser.add_argument("--output", type=Path, default=RESULTS / "feature_store.json")
    options = parser.parse_args(argv)
    torch.manual_seed(0)
    torch.set_num_threads(1)
    rows = lookup()
    if (options.shared / "data").is_dir():
        large, small = photographs(options.shared, 504, 378), photographs(options.shared, 240, 135)
        encoders = {
            "random, cells of 2": RandomConfig(channels=128, stride=2).build(),
            "random, cells of 8": RandomConfig(channels=64, stride=8).build(),
        }
        weights = options.shared / "weights/vgg19_imagenet.safetensors"
        if weights.is_file():
            encoders["vgg19 relu2_1"] = Vgg19Config(weights=weights).build()
        for name, encoder in encoders.items():
            rows += accuracy(f"{name}, 378x504", encoder, large, (4, 8, 12))
            rows += accuracy(f"{name}, 135x240", encoder, small, (2, 4, 8))
    short = [
        r["name"] for r in rows if isinstance(r["goal"], float) and isinstance(r["figure"], float) and r["figure"] > r["goal"]
    ]
    report(options.output, {"rows": rows, "falls_short": short})
    for r in rows:
        print(f"{r['name']:55} {r['figure']:>10} {r['unit']}" + (f"  (peer {r['peer']})" if r["peer"] is not None else ""))
    print("falls short:", ", ".join(map(str, short)) or "nothing")
