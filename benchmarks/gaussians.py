"""The rasteriser of 3D Gaussians: kernels against the plain torch form, time and error; and what a step of
training costs.

    python -m benchmarks gaussians [--count 50000] [--threads 1] [--output FILE.json]
    python -m benchmarks gaussians --training [--threads 2] [--device cuda] [--output FILE.json]

A cloud in front of a camera of 500 x 375 pixels; most Gaussians are a pixel or two wide, as in a trained
scene. Seconds are the least of several calls: of wall time, and of processor time, which counts all threads.
The plain form runs once.

`--training` takes photographs and clouds of several sizes: seconds of a step, and MiB that the Gaussians and
one photograph take, of a process of its own or, on a CUDA device, of torch's memory there.
"""

import json
import math
import multiprocessing
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from fprf.ops import backend
from fprf.ops.rasterise.gsplat import obstacle, target_on, trainable
from fprf.ops.rasterise.rendering import Pinhole, Rasterised, lift, rasterise
from fprf.ops.rasterise.training import target_of

from .common import arguments, report

WIDTH = 500
HEIGHT = 375
BANDS = 4
CHANNELS = 32
SIZES = (504, 378), (1008, 756), (1600, 1200)
COUNTS = 60_000, 250_000, 1_000_000
RATES = 1e-4
"""Learning rate of all parameters of training steps."""


Cloud = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""Means, quaternions, log scales, logits, harmonics."""


def cloud(count: int) -> Cloud:
    draw = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=draw)

    depth = 2 + 6 * torch.rand(count, generator=draw)
    across = (torch.rand(count, 2, generator=draw) - 0.5) * torch.tensor([1.3, 1.0])
    means = torch.cat([across * depth[:, None], depth[:, None]], 1)
    pixel = depth / (0.8 * WIDTH)
    # Standard deviations of about a pixel where there are 50 000; fewer are larger, so that they cover the
    # image as well.
    scales = (math.sqrt(50_000 / count) * pixel).log()[:, None] + 0.5 * normal(count, 3)
    return means, normal(count, 4), scales, 2 * normal(count), 0.4 * normal(count, BANDS, 3)


def camera() -> Pinhole:
    focal = 0.8 * WIDTH
    intrinsics = torch.tensor([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]])
    return Pinhole(intrinsics, torch.eye(4), WIDTH, HEIGHT)


def least(call: Callable[[], object], times: int) -> dict[str, float]:
    wall = []
    processor = []
    for _ in range(times):
        before = time.perf_counter(), time.process_time()
        call()
        wall.append(time.perf_counter() - before[0])
        processor.append(time.process_time() - before[1])
    return {"seconds": min(wall), "processor_seconds": min(processor)}


def learn(given: Cloud, pull: Tensor) -> tuple[Tensor, ...]:
    """Gradients of the image's product with `pull`."""
    a, b, c, d, e = (x.detach().clone().requires_grad_() for x in given)
    found = rasterise(a, b, c, d, e, camera())
    return torch.autograd.grad((found.image * pull.to(found.image)).sum(), (a, b, c, d, e))


def measure(count: int, times: int) -> dict[str, Any]:
    given = cloud(count)
    pixels = torch.rand(HEIGHT, WIDTH, CHANNELS, generator=torch.Generator().manual_seed(1))
    pull = torch.randn(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(2))

    def render() -> Rasterised:
        return rasterise(*given, camera())

    fast = render()
    slopes = learn(given, pull)
    lift(*given[:4], camera(), pixels)
    rows = {
        "render": least(render, times),
        "render_and_gradients": least(lambda: learn(given, pull), times),
        f"lift_{CHANNELS}_channels": least(lambda: lift(*given[:4], camera(), pixels), times),
    }
    a, b, c, d, e = (x.double() for x in given)
    exact = a, b, c, d, e
    with backend.plain():
        rows["render_plain"] = least(render, 1)
        true = rasterise(*exact, camera())
        wanted = learn(exact, pull)
    apart = (fast.image.double() - true.image).abs()
    return {
        "gaussians": count,
        "pixels": WIDTH * HEIGHT,
        "counts": dict(fast.counts),
        "rows": rows,
        "pixels_per_second": WIDTH * HEIGHT / rows["render"]["seconds"],
        "pixels_per_processor_second": WIDTH * HEIGHT / rows["render"]["processor_seconds"],
        "times_plain": rows["render_plain"]["processor_seconds"] / rows["render"]["processor_seconds"],
        "mean_error": float(apart.mean()),
        "largest_error": float(apart.max()),
        "gradient_errors": [
            float((a.double() - b).norm() / b.norm()) for a, b in zip(slopes, wanted, strict=True)
        ],
    }


def step(size: tuple[int, int], count: int, times: int, threads: int, device: str) -> dict[str, Any]:
    """Seconds of a training step, and MiB of the Gaussians with their moments, and of a photograph."""
    torch.set_num_threads(threads)
    numba.set_num_threads(threads)
    width, height = size
    means, turns, scales, logits, harmonics = cloud(count)
    rows = torch.cat([means, scales, turns, logits[:, None], harmonics.flatten(1)], 1).numpy()
    view = camera()
    grown = torch.tensor([[width / WIDTH], [height / HEIGHT], [1.0]])
    view = view._replace(intrinsics=view.intrinsics * grown, width=width, height=height)
    photograph = np.random.default_rng(0).random((height, width, 3), np.float32)

    place = torch.device(device)

    def peak() -> float:
        if place.type == "cuda":
            return torch.cuda.max_memory_allocated(place) / 2**20
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

    if place.type == "cuda":
        torch.cuda.reset_peak_memory_stats(place)
    before = peak()
    model = trainable(count, BANDS, place)
    model.start(rows)
    target = target_of(view, photograph) if place.type == "cpu" else target_on(place, view, photograph)
    rates = np.full(rows.shape[1], RATES, np.float32)

    def learn_once() -> None:
        model.learn(target, background=(0.0, 0.0, 0.0), ssim=0.2, rates=rates)  # waits for the device

    learn_once()
    taken = least(learn_once, times)
    parts = (*target, *(target.there or ()))
    kept = sum(part.nbytes for part in parts if isinstance(part, np.ndarray | Tensor)) / 2**20
    return {"size": size, "gaussians": count, **taken, "mib": peak() - before, "mib_of_a_photograph": kept}


def training(times: int, threads: int, device: str) -> list[dict[str, Any]]:
    """`step` for all sizes and counts."""
    place = torch.device(device)
    if place.type == "cuda" and (why := obstacle(place)) is not None:
        raise SystemExit(f"error: {why}")
    found = []
    for size in SIZES:
        for count in COUNTS:
            given = size, count, times, threads, device
            if place.type == "cuda":
                found.append(step(*given))
            else:
                with multiprocessing.get_context("spawn").Pool(1) as pool:
                    found.append(pool.apply(step, given))
            print(json.dumps(found[-1]), flush=True)
    return found


def main(argv: list[str]) -> None:
    parser = arguments("gaussians", __doc__)
    parser.add_argument("--count", type=int, default=50_000)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--times", type=int, default=30)
    parser.add_argument("--training", action="store_true", help="what a step of training costs")
    parser.add_argument("--device", default="cpu", help="where steps of training run: cpu or cuda")
    parser.add_argument("--output", type=Path)
    args = parser.parse_args(argv)
    if args.training:
        found = {
            "threads": args.threads,
            "device": args.device,
            "steps": training(args.times, args.threads, args.device),
        }
        report(args.output, found)
        return
    torch.set_num_threads(args.threads)
    numba.set_num_threads(args.threads)
    found = {"threads": args.threads, **measure(args.count, args.times)}
    print(json.dumps(found, indent=1))
    report(args.output, found)
