"""Training of any kind of scene, from a config to a run folder.

`train` owns the folder: its lock, config, hashes of the images, facts, and what is resumed. `learn` owns the
loop: schedule, checkpoints, reports, interrupts, steps that are not finite, memory. What is learnt, and how,
belongs to the learner (`interfaces.Learner`) that the config builds.

The run folder is the only channel to whoever watches: they read its newest checkpoint and the end of
events.jsonl. `watch` asks for checkpoints more often while somebody looks; nothing else that they do reaches
training.
"""

import math
import shlex
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

from ..datamanagers.images import useless_masks
from ..datamanagers.parsers.config import recognise
from ..datamanagers.scene import ParsedScene
from ..errors import CheckpointError, DataError, NumericsError, Stopped, UsageError
from ..interfaces import Figures, Learner
from ..io.atomic import remove_unfinished
from ..memory import out_of_memory, shortage
from ..plugins.codec import leaves
from ..plugins.config import Need
from ..progress import LINE_SECONDS, Display, Listener, Report
from ..run_config import RunConfig
from ..scenes import Partition
from . import checkpoint
from .image_hashes import check_images, image_hashes, save_image_hashes
from .locks import lock_folder
from .prepare import device_of, planned, read_whole_scene, scene_at_size
from .run import Run

REPORT_SECONDS = 0.5
"""Time between reports; by eye."""
PATIENCE = 3
"""Steps in a row that are not finite after which a run goes back to its last checkpoint: it will not recover
by itself.
"""
WATCHED = ".watched"
"""File of a run folder that whoever looks at a training touches every second."""
_WATCH_SECONDS = 5.0
"""Age up to which that file says that somebody looks."""
_SAVING_SHARE = 0.05
"""Share of the time that checkpoints may take while somebody looks; by eye."""
_MIN_PAUSE = 2.0
"""Seconds between checkpoints, at least, while somebody looks."""
_MIN_REDUCED_PIXELS = 96
"""Pixels of an image's shorter side below which a `--downscale` that was asked for is probably a mistake; by
eye.
"""
_MAX_DIFFERENCES = 4
"""Differences of a run's config that a message names, at most."""


class Schedule(NamedTuple):
    """Length of a training, and intervals of saving."""

    steps: int | None
    """Number of steps; None = until the minutes are over."""
    minutes: float | None = None
    """Time limit; None = until all steps are made."""
    checkpoint_minutes: float = 5.0

    def share(self, step: int, seconds: float) -> float:
        """Share of the way, 0 to 1: by steps or by minutes, whichever is further."""
        if self.steps is None:
            share = 0.0
        elif self.steps:
            share = step / self.steps
        else:
            share = 1.0
        if self.minutes is not None:
            share = max(share, seconds / (60 * self.minutes))
        return min(1.0, share)


def schedule_of(config: RunConfig, views: int) -> Schedule:
    """The schedule of a config on so many training views."""
    return Schedule(config.limited(views), config.minutes, config.checkpoint_minutes)


def train(
    config: RunConfig,
    method: str,
    *,
    quiet: bool = False,
    changed_images: bool = False,
    listener: Listener | None = None,
) -> Path:
    """Train a scene to the end and return its run folder; an existing run there is resumed if its config and
    images fit.

    With `changed_images` they may be others than those that the run was begun with. `listener` is told of the
    progress, and stops the training by raising Stopped. Raises UsageError where
    packages, weights or the scene are missing, DataError where another process is training there.
    """
    output = config.output or default_output(config, method)
    config = replace(config, output=output)
    run = Run(output)
    # What is missing is said before there is a folder.
    with Display(quiet=quiet) as display:
        _check_needs(config, method, display)
        config.compile_kernels(device_of(config.reading.device), display.say)
    start = time.perf_counter()  # of the minutes
    with lock_folder(output), Display(quiet=quiet, listener=listener) as display:
        display.say(f"{method} on {config.data}, run folder {output}")
        # An existing run goes on with its own config and images; what was cut short there is removed.
        config = _going_on(run, config)
        if all(getattr(config, name) is not None for name in config.open):
            _check_same(run, config)  # before the scene is read, which may be elsewhere now
        whole = read_whole_scene(config)
        config = _sized(run, config, display, whole)
        _check_same(run, config)
        for folder in (output, *output.glob("blocks/*"), *output.glob("cells/*")):
            remove_unfinished(folder)
        # What the run found out when it was begun stays: its origin, and exposures that were measured then.
        saved = run.saved_facts()
        scene = scene_at_size(config, whole, saved)
        for note in scene.notes:
            display.say(f"note: {note}")
        if config.reading.masks and (said := useless_masks(scene)):
            display.say(said)
        hashes = image_hashes(scene)
        if run.exists and not changed_images:
            check_images(output, scene, hashes)
        # Reading photographs and extracting features takes minutes: nothing is written before it has worked.
        learner = config.build(scene, device_of(config.reading.device), saved=saved, progress=display.count)
        output.mkdir(parents=True, exist_ok=True)
        run.save_config(replace(config, output=None), method)  # the folder may be moved
        save_image_hashes(output, hashes)
        run.save_known(scene, config.data, learner.facts)
        spent = time.perf_counter() - start
        width, height = scene.cameras.size[0].tolist()
        shown = f"{scene.name}: {len(scene.train)} + {len(scene.test)} views of {width}x{height}"
        if isinstance(learner, Partition):
            display.say(shown)
            learner.train(run, display, spent=spent)
        else:
            display.say(shown + learner.begin(run))
            learn(learner, run, schedule_of(config, len(scene.train)), reporter(display, run), spent=spent)
            learner.finish(run, display)
        quoted = shlex.quote(str(output))
        seconds = time.perf_counter() - start
        display.say(
            f"done after {seconds:.0f} s: fprf stylize {quoted} --references PHOTO.jpg, fprf eval {quoted}"
        )
    return output


def default_output(config: RunConfig, method: str) -> Path:
    """runs/SCENE-METHOD."""
    if config.data is None:
        name = ""
    else:
        name = config.data.resolve().name
    return Path("runs") / f"{name or 'scene'}-{method}"


def learn(
    learner: Learner,
    run: Run | None,
    schedule: Schedule,
    report: Callable[[Report], None],
    *,
    spent: float = 0.0,
) -> tuple[int, float]:
    """Take steps, going on from the newest checkpoint of the run, until the schedule is over; `spent` seconds
    count as used.

    Returns how many steps are made, and the seconds of training, those of earlier starts included.

    Without a `run` nothing is saved. An interrupt, or Stopped, saves first, then goes on upwards. Steps that are not
    finite change nothing and are logged; PATIENCE of them in a row lead back to the last checkpoint: on CUDA
    with the next report. Raises NumericsError where there is none, or where that was of no use,
    OutOfMemoryError where a step finds too little memory.
    """
    # All draws are functions of (seed, step): a resumed training is bit for bit the one that never stopped.
    saved = None if run is None else _resume(learner, run)
    if saved is not None:
        step = saved.step
        seconds_before = saved.seconds
    else:
        step = 0
        seconds_before = spent
    # `step` steps are made, `clock` seconds used.
    first = step
    clock = seconds_before
    went_back = -1  # the step that faults led back to last
    begun = last_report = last_saved = time.perf_counter()
    pause = longest = 60 * schedule.checkpoint_minutes
    cost = 0.1  # seconds of a checkpoint, until one is measured
    figures: Figures | None = None

    def save() -> None:
        nonlocal last_saved, cost
        if run is not None:
            start = time.perf_counter()
            model, optimizer = learner.state()
            checkpoint.write(run.checkpoints, model, optimizer, step=step, seconds=clock)
            last_saved = time.perf_counter()
            cost = last_saved - start

    def measured(figures: Figures, share: float) -> Report:
        psnr = -10 * math.log10(max(figures.means.get("rgb", 1.0), 1e-10))
        speed = figures.rays / max(time.perf_counter() - begun, 1e-9)
        return Report(step, share, clock, psnr, speed, figures.kept, dict(figures.means), figures.skipped)

    with _SignalHandler() as signals:
        try:
            while (share := schedule.share(step, clock)) < 1:
                # A signal waits until the step before it is whole.
                if signals.asked:
                    raise KeyboardInterrupt
                learner.step(step, share)
                now = time.perf_counter()
                due = now - last_report > REPORT_SECONDS
                # An accelerator works ahead of the host, which waits for it only twice a second and at the
                # end.
                if (
                    due
                    or learner.device.type == "cpu"
                    or schedule.share(step + 1, seconds_before + now - begun) >= 1
                ):
                    # The only place where the host waits; faults of all steps since the last look come with
                    # it.
                    figures = learner.figures()
                    if figures.fault and run is not None:
                        run.log({"step": step, "skipped": figures.fault})
                    if figures.failed >= PATIENCE:
                        went_back = step = _go_back(learner, run, figures, step, went_back)
                        continue
                # The clock goes on from that of earlier starts, so that a time limit holds for all of them.
                step = step + 1
                clock = seconds_before + now - begun
                if due and figures is not None:
                    last_report = now
                    report(measured(figures, schedule.share(step, clock)))
                    # Who looks gets checkpoints as often as a twentieth of the time allows.
                    often = run is not None and is_watched(run.root)
                    if often:
                        pause = min(longest, max(_MIN_PAUSE, cost / _SAVING_SHARE))
                    else:
                        pause = longest
                if now - last_saved > pause:
                    save()
            if signals.asked:
                raise KeyboardInterrupt
        except (KeyboardInterrupt, Stopped):
            if not signals.hurried:  # else a step was cut in half
                save()
            raise
        except Exception as error:
            if not out_of_memory(error):
                raise
            # The step is lost, the last checkpoint is not.
            if run is None:
                steps = []
            else:
                steps = checkpoint.steps(run.checkpoints)
            if steps:
                kept = f"the checkpoint of step {steps[-1]} is kept"
            else:
                kept = "there is no checkpoint yet"
            remedy = f"lower --datamanager.rays (of fields), or begin anew with a larger --downscale ({kept})"
            raise shortage(f"training step {step}", error, remedy) from error
    # A run without steps is saved as well: it can be opened.
    if saved is None or step > saved.step:
        save()
    if step > first and figures is not None:
        report(measured(figures, 1.0))
    return step, clock


def _resume(learner: Learner, run: Run) -> checkpoint.Saved | None:
    """Load the newest intact checkpoint into the learner; None where the run has none yet."""
    # What a killed process left half written goes first; a damaged checkpoint is passed over, and logged.
    checkpoint.tidy(run.checkpoints)
    saved, damaged = checkpoint.load_latest(run.checkpoints)
    for line in damaged:
        run.log({"damaged": line})
    if saved is not None:
        try:
            learner.load(saved.state)
        except CheckpointError as error:
            raise CheckpointError(f"checkpoint of step {saved.step}: {error}") from error
    return saved


def _go_back(learner: Learner, run: Run | None, figures: Figures, step: int, before: int) -> int:
    """Load the newest checkpoint and return its step; a second time to the same one (`before`) would change
    nothing.
    """
    why = f"step {step}: {figures.fault or 'the loss'} is not finite for {PATIENCE} steps in a row"
    remedy = "lower the learning rate, or check the images"
    saved = None
    if run is not None:
        saved = checkpoint.load_latest(run.checkpoints)[0]
    if run is None or saved is None:
        raise NumericsError(f"{why}; {remedy}")
    if saved.step == before:
        raise NumericsError(f"{why}, again after going back to step {before}; {remedy}")
    learner.load(saved.state)
    run.log({"step": step, "gone_back_to": saved.step, "because": why})
    return saved.step


def watch(root: Path) -> None:
    """Tell the training in a run folder, if there is one, that somebody looks: to be called every second
    while they do.
    """
    with suppress(OSError):  # a run on a read-only disk is not being trained
        (root / WATCHED).touch()


def is_watched(root: Path) -> bool:
    """True where somebody has looked at a run within the last seconds."""
    try:
        return time.time() - (root / WATCHED).stat().st_mtime < _WATCH_SECONDS
    except OSError:
        return False


class _SignalHandler:
    """SIGINT and SIGTERM held back inside the block, and as before after it. Python lets only the main thread
    set handlers; in any other this changes nothing. A handler that was not set from Python stays: it could
    not be set again.
    """

    def __init__(self) -> None:
        self.asked = False
        """True after the first signal: training ends when the step is done."""
        self.hurried = False
        """True after the second: a step was cut in half, so what is in memory is not saved."""
        self.before: dict[int, Any] = {}

    def __enter__(self) -> "_SignalHandler":
        if threading.current_thread() is threading.main_thread():
            # Windows has SIGBREAK for a process group of its own.
            held = {signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGBREAK", signal.SIGTERM)}
            for number in held:
                if signal.getsignal(number) is not None:
                    self.before[number] = signal.signal(number, self.note)
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self.before.items():
            signal.signal(number, handler)

    def note(self, number: int, frame: FrameType | None) -> None:
        """Take note of a signal; the second raises KeyboardInterrupt wherever the program is."""
        self.hurried = self.asked
        self.asked = True
        if self.hurried:
            raise KeyboardInterrupt


def reporter(display: Display, run: Run, name: str = "training") -> Callable[[Report], None]:
    """Progress of what is trained in a folder: for the display, and every few seconds a line of its
    events.jsonl.
    """
    last = -LINE_SECONDS

    def report(event: Report) -> None:
        nonlocal last
        display.training(event, name)
        # events.jsonl grows by a line every few seconds, whatever the pace of reports; the last one always
        # counts.
        now = time.perf_counter()
        if now - last < LINE_SECONDS and event.share < 1:
            return
        last = now
        run.log(
            {
                "step": event.step,
                "share": round(event.share, 4),
                "seconds": round(event.seconds, 2),
                "psnr": round(event.psnr, 3),
                "rays_per_second": round(event.rays_per_second),
                "kept": round(event.kept, 4),
                "skipped_steps": event.skipped,
                "losses": {name: float(f"{value:.4g}") for name, value in event.losses.items()},
            }
        )

    return report


def _check_needs(config: RunConfig, method: str, display: Display) -> None:
    """Raise UsageError where something is missing that nothing downloads, after showing all that is
    missing.
    """
    needs = config.needs()
    if config.data is not None and all(need.downloaded for need in needs):
        return  # where the scene cannot be read its parser says so
    # Something is: then whether some parser reads the scene folder is told as well, before it is mended.
    if config.data is None:
        needs.insert(
            0, Need("no scene is named", "give --data FOLDER, or --data garden for the embedded scene")
        )
    elif config.reading.parser is None:
        try:
            recognise(config.data)
        except DataError as fault:
            needs.insert(0, Need("the scene", str(fault)))
    if len(needs) > 1:
        for need in needs:
            display.say(f"missing: {need.what}: {need.remedy}")
        raise UsageError(
            f"fprf train {method}: {len(needs)} things are missing; `fprf doctor {method}` looks again"
        )
    raise UsageError(f"fprf train {method}: {needs[0].what}: {needs[0].remedy}")


def _going_on(run: Run, config: RunConfig) -> RunConfig:
    """The config with what it leaves open as an existing run has decided it.

    Else a run would change its size with the machine or the minutes.
    """
    if not run.exists:
        return config
    old = run.load_config()[0]
    decided = {}
    for name in config.open:
        value = getattr(old, name, None)
        if getattr(config, name) is None and value is not None:
            decided[name] = value
    return replace(config, **decided)


def _sized(run: Run, config: RunConfig, display: Display, whole: ParsedScene) -> RunConfig:
    """The config with all decided that it still leaves open; `whole` is the scene at its own size."""
    if config.downscale is not None and config.downscale > 1 and not run.exists:
        width, height = scene_at_size(config, whole).cameras.size[0].tolist()
        if min(width, height) < _MIN_REDUCED_PIXELS:
            display.say(
                f"warning: {width}x{height} pixels are few: --downscale {config.downscale:g} counts from the images as they "
                "are delivered, also in a folder images_N; leave it out"
            )
    if any(getattr(config, name) is None for name in config.open):
        config = planned(config, whole)
        sizes = whole.cameras.scaled(config.downscale or 1).size
        width, height = sizes[whole.train[0] if len(whole.train) else 0].tolist()
        if config.minutes is not None:
            ends = f"{config.minutes:g} minutes"
        else:
            ends = f"{config.limited(len(whole.train)):,} steps"
        if config.downscale != 1:
            reduced = f" (1/{config.downscale:.3g}; --downscale 1 keeps them whole)"
        else:
            reduced = ""
        display.say(
            f"plan: {len(whole.train)} views at {width}x{height}{reduced}{config.described()}, {ends}"
        )
    return config


def _check_same(run: Run, config: RunConfig) -> None:
    """Raise UsageError where a folder holds a run with another config; only what `changeable` names may
    differ.
    """
    if not run.exists:
        return
    old, _ = run.load_config()
    # What the run itself left open was never decided there.
    free = (*config.changeable(old), *(name for name in config.open if getattr(old, name, None) is None))
    # Whole branches of the config may be free: what is compared are its leaves, by their paths.
    mine = leaves(config)
    theirs = leaves(old)
    changed = []
    for field in theirs | mine:
        if field.partition(".")[0] not in free and mine.get(field) != theirs.get(field):
            changed.append(field)
    if changed:
        shown = []
        for name in changed[:_MAX_DIFFERENCES]:
            shown.append(f"{name} {theirs.get(name, '-')} ({mine.get(name, '-')} is asked)")
        if len(changed) > _MAX_DIFFERENCES:
            more = f" and {len(changed) - _MAX_DIFFERENCES} others"
        else:
            more = ""
        # The first free name after this one, so that the line can be copied.
        other = next(
            path for k in range(2, 1000) if not (path := run.root.with_name(f"{run.root.name}-{k}")).exists()
        )
        raise UsageError(
            f"{run.root}: holds a run with {', '.join(shown)}{more}; go on with it by its own values, or begin another with "
            f"--output {shlex.quote(str(other))}"
        )
