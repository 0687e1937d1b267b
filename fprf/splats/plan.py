"""Size of the photographs and number of Gaussians that a time on this machine is best used for.

P pixels of a photograph, V training views, N Gaussians. On the machine that the constants were measured on a
step takes A s P + B N, where s is the share of the full size's pixels that a step sees on average: the first
steps see reduced ones. On a CUDA device with gsplat some steps are made to see what one takes there.

Size counts first, the number of Gaussians second. Five minutes of llff_flower at 1008 x 756 come to 28.0 dB
with 160 000 Gaussians, 27.9 with 120 000 (benchmarks/results/splat_training.json).
"""

import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from ..ops.rasterise.gsplat import target_on, trainable, usable
from ..ops.rasterise.reference import Pinhole
from ..ops.rasterise.training import compile_beside

if TYPE_CHECKING:
    from ..datamanagers.scene import ParsedScene
    from .config import GaussiansConfig

_PIXEL = 91e-9
_GAUSSIAN = 103e-9
"""A and B in seconds, on two x86-64 cores."""
_START = 6.0
"""Seconds before the first step, at least: reading photographs, first points."""
_STEPS = 900
_PASSES = 5
"""Steps, and passes over the views, below which photographs are reduced further."""
_SMALL = 640 * 360
"""Pixels of photographs that may be passed over `most_passes` times."""
_LEAST = 400 * 225
"""Pixels below which none is reduced for lack of time."""
_PATIENCE = 600.0
"""Seconds within which steps have to end where no minutes are given: larger photographs are reduced."""
_FEWEST = 60_000
_MOST = 1_000_000
_GROWTH = 0.6
"""Gaussians of a minute, the most of all, and the power of the time that their number grows with."""
_PROBE = 1 << 16
_REPEATS = 200
_REFERENCE = 55e-6
"""Numbers whose exponential is taken, how often, and the seconds of the fastest on one of the two cores named
above.
"""
_SIZES = ((480, 270), (1920, 1080))
_FIRST = 20
_TIMED = 10
_BESIDES = 1.4
"""Images of the steps that are made on a CUDA device, steps before any is timed, those of which the fastest
counts, and what a step of training takes in units of these, with all that is done between steps.
"""
_NOTICE_SECONDS = 3.0
"""Preparing kernels for longer than this means that they are compiled; by eye, as it takes a minute."""


def plan(config: "GaussiansConfig", scene: "ParsedScene", device: torch.device) -> "GaussiansConfig":
    """Return the config with all decided that it leaves open, for a scene at its own size; what is given
    stays.

    More minutes never give smaller photographs, fewer Gaussians or fewer steps.
    """
    sizes = scene.cameras.size[scene.train]
    if not len(sizes):
        return replace(config, downscale=config.downscale or 1, cap=config.most, passes=config.most_passes)
    views = len(sizes)
    pixels = float(sizes.double().prod(1).mean())
    longest = int(sizes.max())
    speed = device_speed(device)
    budget = None
    if config.minutes is not None:
        budget = max(1.0, 60 * config.minutes - _START)
    # The largest size at which the time is enough for some passes over the photographs.
    size = config.downscale or max(1, longest / config.longest)
    while True:
        small = pixels / size**2
        found = _of_size(config, small)
        each = _seconds(found, small, _FEWEST)
        steps = found.limited(views)
        times = speed(_share(found) * small)
        if budget is None:
            enough = steps * each <= _PATIENCE * times
        else:
            enough = budget * times / each >= max(_STEPS, _PASSES * views)
        smaller = math.floor(size) + 1
        if enough or config.downscale is not None or pixels / smaller**2 < _LEAST:
            break
        size = smaller
    # On the machine of the constants, so that a faster one has more Gaussians.
    if budget is None:
        seconds = steps * each
    else:
        seconds = min(budget * times, steps * each)
    cap = config.cap
    if cap is None:
        cap = min(_MOST, max(_FEWEST, 10_000 * round(_FEWEST / 10_000 * (seconds / 60) ** _GROWTH)))
        if not config.cells.cuts:
            cap = min(cap, max(1, int(views * pixels / size**2) // config.pixels_per_gaussian))
    return replace(found, downscale=size, cap=cap)


def _of_size(config: "GaussiansConfig", pixels: float) -> "GaussiansConfig":
    """The config for photographs of so many pixels: of large ones there is more to learn before they are
    known by heart.
    """
    if config.passes is not None:
        return config
    return replace(config, passes=round(config.most_passes * max(1.0, math.sqrt(pixels / _SMALL))))


def machine_speed() -> float:
    """Speed of this machine relative to the one of the constants, from the exponentials that its fastest core
    takes in time.
    """
    values = torch.linspace(-8.0, 0.0, _PROBE)
    best = math.inf
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for _ in range(_REPEATS):
            start = time.perf_counter()
            torch.exp(values)
            best = min(best, time.perf_counter() - start)
    finally:
        torch.set_num_threads(threads)
    # A step's work is spread over the cores but for a part.
    return _REFERENCE / best * math.pow(threads / 2, 0.8)


def device_speed(device: torch.device) -> Callable[[float], float]:
    """Speed of what trains, for images of so many pixels, relative to the machine of the constants."""
    try:
        if usable(device):
            return _card_speed(device)
    except torch.OutOfMemoryError:  # training takes less than these steps
        pass
    known = machine_speed()
    return lambda many: known


def _card_speed(device: torch.device) -> Callable[[float], float]:
    """The same of a CUDA device on which gsplat draws, by some steps there."""
    draw = np.random.default_rng(0)
    # Gaussians before a camera, about as wide as they lie apart.
    rows = 0.1 * draw.standard_normal((_FEWEST, 59), np.float32)
    depth = draw.uniform(2, 8, _FEWEST)
    rows[:, :2], rows[:, 2] = draw.uniform(-0.6, 0.6, (_FEWEST, 2)) * depth[:, None], depth
    rows[:, 3:6] += np.log(3e-3 * depth)[:, None]
    model = trainable(_FEWEST, 16, device)
    model.start(rows)
    pixels = []
    seconds = []
    for width, height in _SIZES:
        focal = 0.8 * width
        intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        camera = Pinhole(intrinsics, torch.eye(4), width, height)
        target = target_on(device, camera, draw.random((height, width, 3), np.float32))
        best = math.inf
        for step in range(_FIRST + _TIMED):
            start = time.perf_counter()
            model.learn(target, background=(0.0, 0.0, 0.0), ssim=0.2, rates=np.full(59, 1e-5, np.float32))
            if step >= _FIRST:
                best = min(best, time.perf_counter() - start)
            else:
                best = best
        pixels.append(width * height)
        seconds.append(_BESIDES * best)
    slope = max(0.0, (seconds[1] - seconds[0]) / (pixels[1] - pixels[0]))
    return lambda many: (
        (_PIXEL * many + _GAUSSIAN * _FEWEST) / max(seconds[0] + slope * (many - pixels[0]), 1e-4)
    )


def _seconds(config: "GaussiansConfig", pixels: float, gaussians: int) -> float:
    """Seconds of a step, on average, on the machine of the constants."""
    return _PIXEL * _share(config) * pixels + _GAUSSIAN * gaussians


def _share(config: "GaussiansConfig") -> float:
    """Share of the full size's pixels that a step sees on average."""
    coarse = config.coarse
    return (1 - coarse) + coarse * 2 / 3 / 4 + coarse / 3 / 16


def compile_kernels(device: torch.device, bands: int, say: Callable[[str], None]) -> None:
    """Compile what draws Gaussians in training with so many harmonics, where that was not done before.

    gsplat does not tell in advance whether it has to, so `say` is told after some seconds.
    """
    line = "compiling kernels, once after installation: this does not count towards --minutes"
    notice = threading.Timer(_NOTICE_SECONDS, say, [line])
    notice.start()
    try:
        if not usable(device):
            for process in compile_beside(bands):
                process.wait()
    finally:
        notice.cancel()
