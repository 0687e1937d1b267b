"""Size of the photographs and number of Gaussians that a time on this machine is best used for; the lens of captures
that come without one (`lens_estimate`).

P pixels of a photograph, V training views, N Gaussians. On the machine that the constants are meant for a step
takes A s P + B N, where s is the share of the full size's pixels that it sees: the first steps see reduced
ones. Where minutes are given each size has its share of the time, else of the steps. On a CUDA device with
gsplat some steps are made to see what one takes there.

Size counts first, the number of Gaussians second.
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
from .lens_estimate import estimate_k1

if TYPE_CHECKING:
    from ..datamanagers.scene import ParsedScene
    from .config import GaussiansConfig

# What a step takes on the machine of the constants, two x86-64 cores. Fitted to whole trainings of llff_fern at
# 504x378 and llff_flower at 1008x756 with 60 000 Gaussians, on a machine of 1.47 times its speed: 12.1 and 22.6
# ms a step of a time limit are expected, 11.0 and 20.3 were taken.

_SECONDS_PER_PIXEL = 75e-9
"""A."""
_SECONDS_PER_GAUSSIAN = 115e-9
"""B: on that machine 62 to 93e-9, of 60 000 to a million (training_steps.json)."""
_START_SECONDS = 6.0
"""Seconds before the first step, at least: reading photographs, first points; by eye."""

# What the size of the photographs is decided by.

_MIN_STEPS = 900
"""Steps below which photographs are reduced further; by eye."""
_MIN_PASSES = 5
"""Passes over the views below which photographs are reduced further; by eye."""
_SMALL_PIXELS = 640 * 360
"""Pixels of photographs that may be passed over `most_passes` times; of larger ones there is more to learn."""
_MIN_PIXELS = 400 * 225
"""Pixels below which no photograph is reduced for lack of time; by eye."""
_MAX_UNTIMED_SECONDS = 600.0
"""Seconds within which steps have to end where no minutes are given: larger photographs are reduced."""

# What the number of Gaussians is decided by.

_MIN_PLANNED_GAUSSIANS = 60_000
"""Gaussians of a minute, and of less."""
_MAX_PLANNED_GAUSSIANS = 1_000_000
"""Gaussians of any time, at most: bounds the memory, 0.7 GB in training (training_steps.json)."""
_GROWTH_POWER = 0.6
"""Power of the time that the number of Gaussians grows with; by eye: 160 000 in five minutes, with which
llff_flower comes to 28.0 dB, and to 27.9 with 120 000 (splat_training.json).
"""
_NOTICE_SECONDS = 3.0
"""Preparing kernels for longer than this means that they are compiled; by eye, as it takes a minute."""
_GAUSSIANS_STEP = 10_000
"""Their number is a multiple of this."""

# How fast this machine is.

_EXPONENTIALS = 1 << 16
"""Numbers whose exponential is taken."""
_EXPONENTIAL_REPEATS = 200
"""Repetitions: the fastest counts, as other work only slows it down."""
_REFERENCE_SECONDS = 55e-6
"""Seconds of the fastest on one of the two cores named above."""
_REFERENCE_CORES = 2
"""Cores of the machine of the constants."""
_CORES_POWER = 0.8
"""Power of the number of cores that the speed grows with: a part of a step is done by one; by eye."""

# How fast a CUDA device is, by steps that are made there.

_TIMED_SIZES = ((480, 270), (1920, 1080))
"""Width and height of their images: what a pixel takes follows from the difference."""
_WARM_UP_STEPS = 20
"""Steps before any is timed; by eye."""
_TIMED_STEPS = 10
"""Steps of which the fastest counts; by eye."""
_WHOLE_STEP_RATIO = 1.4
"""Cost of a training step in units of these, with all that is done between steps; by eye."""
_MIN_CARD_SECONDS = 1e-4
"""Seconds of a step there, at least: what launching its kernels takes, whatever the size; by eye."""


def plan(config: "GaussiansConfig", scene: "ParsedScene", device: torch.device) -> "GaussiansConfig":
    """Return the config with all decided that it leaves open, for a scene at its own size; what is given
    stays.

    More minutes never give smaller photographs, fewer Gaussians or fewer steps.
    """
    sizes = scene.cameras.size[scene.train]
    if config.k1 is None:
        config = replace(config, k1=estimate_k1(scene))
    if not len(sizes):
        return replace(config, downscale=config.downscale or 1, cap=config.most, passes=config.most_passes)
    views = len(sizes)
    pixels = float(sizes.double().prod(1).mean())
    longest = int(sizes.max())
    speed = device_speed(device)
    budget = None
    if config.minutes is not None:
        budget = max(1.0, 60 * config.minutes - _START_SECONDS)
    # The largest size at which the time is enough for some passes over the photographs.
    size = config.downscale or max(1, longest / config.longest)
    while True:
        small = pixels / size**2
        found = _of_size(config, small)
        each = _seconds(found, small, _MIN_PLANNED_GAUSSIANS)
        steps = found.limited(views)
        times = speed(_share(found) * small)
        if budget is None:
            enough = steps * each <= _MAX_UNTIMED_SECONDS * times
        else:
            within = budget * times * _steps_a_second(found, small, _MIN_PLANNED_GAUSSIANS)
            enough = within >= max(_MIN_STEPS, _MIN_PASSES * views)
        smaller = math.floor(size) + 1
        if enough or config.downscale is not None or pixels / smaller**2 < _MIN_PIXELS:
            break
        size = smaller
    # On the machine of the constants, so that a faster one has more Gaussians.
    if budget is None:
        seconds = steps * each
    else:
        seconds = min(budget * times, steps * each)
    cap = config.cap
    if cap is None:
        wanted = _MIN_PLANNED_GAUSSIANS / _GAUSSIANS_STEP * (seconds / 60) ** _GROWTH_POWER
        cap = _GAUSSIANS_STEP * round(wanted)
        cap = min(_MAX_PLANNED_GAUSSIANS, max(_MIN_PLANNED_GAUSSIANS, cap))
        if not config.cells.cuts:
            cap = min(cap, max(1, int(views * pixels / size**2) // config.pixels_per_gaussian))
    return replace(found, downscale=size, cap=cap)


def _of_size(config: "GaussiansConfig", pixels: float) -> "GaussiansConfig":
    """The config for photographs of so many pixels: of large ones there is more to learn before they are
    known by heart.
    """
    if config.passes is not None:
        return config
    return replace(config, passes=round(config.most_passes * max(1.0, math.sqrt(pixels / _SMALL_PIXELS))))


def machine_speed() -> float:
    """Speed of this machine relative to the one of the constants, from the exponentials that its fastest core
    takes in time.
    """
    values = torch.linspace(-8.0, 0.0, _EXPONENTIALS)
    best = math.inf
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for _ in range(_EXPONENTIAL_REPEATS):
            start = time.perf_counter()
            torch.exp(values)
            best = min(best, time.perf_counter() - start)
    finally:
        torch.set_num_threads(threads)
    # A step's work is spread over the cores but for a part.
    return _REFERENCE_SECONDS / best * math.pow(threads / _REFERENCE_CORES, _CORES_POWER)


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
    rows = 0.1 * draw.standard_normal((_MIN_PLANNED_GAUSSIANS, 59), np.float32)
    depth = draw.uniform(2, 8, _MIN_PLANNED_GAUSSIANS)
    rows[:, :2] = draw.uniform(-0.6, 0.6, (_MIN_PLANNED_GAUSSIANS, 2)) * depth[:, None]
    rows[:, 2] = depth
    rows[:, 3:6] += np.log(3e-3 * depth)[:, None]
    model = trainable(_MIN_PLANNED_GAUSSIANS, 16, device)
    model.start(rows)
    pixels = []
    seconds = []
    for width, height in _TIMED_SIZES:
        focal = 0.8 * width
        intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        camera = Pinhole(intrinsics, torch.eye(4), width, height)
        target = target_on(device, camera, draw.random((height, width, 3), np.float32))
        best = math.inf
        for step in range(_WARM_UP_STEPS + _TIMED_STEPS):
            start = time.perf_counter()
            model.learn(target, background=(0.0, 0.0, 0.0), ssim=0.2, rates=np.full(59, 1e-5, np.float32))
            if step >= _WARM_UP_STEPS:
                best = min(best, time.perf_counter() - start)
        pixels.append(width * height)
        seconds.append(_WHOLE_STEP_RATIO * best)
    slope = max(0.0, (seconds[1] - seconds[0]) / (pixels[1] - pixels[0]))

    def speed(many: float) -> float:
        reference = _SECONDS_PER_PIXEL * many + _SECONDS_PER_GAUSSIAN * _MIN_PLANNED_GAUSSIANS
        return reference / max(seconds[0] + slope * (many - pixels[0]), _MIN_CARD_SECONDS)

    return speed


def _seconds(config: "GaussiansConfig", pixels: float, gaussians: int) -> float:
    """Seconds of a step, on average over the steps, on the machine of the constants."""
    return _SECONDS_PER_PIXEL * _share(config) * pixels + _SECONDS_PER_GAUSSIAN * gaussians


def _steps_a_second(config: "GaussiansConfig", pixels: float, gaussians: int) -> float:
    """Steps in a second, on average over the time, on the machine of the constants."""
    steps = 0.0
    for part, share in _sizes(config):
        steps += part / (_SECONDS_PER_PIXEL * share * pixels + _SECONDS_PER_GAUSSIAN * gaussians)
    return steps


def _share(config: "GaussiansConfig") -> float:
    """Share of the full size's pixels that a step sees, on average over the steps."""
    return sum(part * share for part, share in _sizes(config))


def _sizes(config: "GaussiansConfig") -> tuple[tuple[float, float], ...]:
    """Parts of the training, and the share of the full size's pixels that their steps see."""
    coarse = config.coarse
    return (coarse / 3, 1 / 16), (coarse * 2 / 3, 1 / 4), (1 - coarse, 1.0)


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
