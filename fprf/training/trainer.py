"""The training loop. Batches and draws are functions of (seed, step), so a resumed run goes on as if never stopped.

On CUDA the host waits for the device only at reports, twice a second: losses and faults stay on the device until then.
Batches are drawn there where their data fit, otherwise copied one step ahead.
"""

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import torch
from torch import Tensor
from torch.profiler import record_function

from ..config import TrainConfig
from ..datamanagers.batches import generator_of
from ..errors import NumericsError
from ..interfaces import DataManager
from ..memory import free_memory, out_of_memory, shortage
from ..ops.precision import tf32
from ..rendering.cameras import PixelRays
from ..rendering.renderer import render_rays
from ..types import Batch, Rays
from . import checkpoint
from .camera_optimizers import moving, toned
from .loop import (
    CLEAR_EVERY,
    PATIENCE,
    StepStatistics,
    clear_denormals,
    held_back,
    progress,
    rate,
    unfit_gradients,
    unfit_step,
    unfit_terms,
)
from .losses import check_penalties, extra_term, terms, total, wanted
from .model import Facts, Model, background_of, build_model
from .prepare import Prepared, device_of
from .run import Run

REPORT_SECONDS = 0.5
"""Time between reports."""


class Report(NamedTuple):
    """Progress of training."""

    step: int
    share: float
    """Share of the way, 0 to 1."""
    seconds: float
    psnr: float
    """Of the training rays, smoothed."""
    rays_per_second: float
    kept: float
    """Share of the samples that met the content network."""
    losses: dict[str, float]
    skipped: int
    """Steps skipped because their loss or a gradient was not finite."""


def optimizer_of(config: TrainConfig, model: Model) -> torch.optim.Optimizer:
    """Adam on all that the model learns."""
    knobs = config.optimizer
    return torch.optim.Adam(model.learned(), lr=knobs.rate, betas=(0.9, knobs.beta2), eps=knobs.eps, fused=True)


def train(
    config: TrainConfig,
    prepared: Prepared,
    run: Run,
    report: Callable[[Report], None],
    *,
    spent: float = 0.0,
    model: Model | None = None,
    lead: int = 0,
) -> Model:
    """Train, or go on from the newest checkpoint, until the steps or the minutes are over; `spent` seconds count as used.

    `model` is one at its start, where it is not simply that of the config: a block in its surroundings, whose sampler was
    trained for `lead` steps before. An interrupt saves first, then goes on upwards. Steps that are not finite change nothing
    and are logged; several in a row lead back to the last checkpoint: on CUDA with the next report, where the last steps
    before it failed. Raises NumericsError where there is none, or where that was of no use, OutOfMemoryError where a step
    finds too little memory.
    """
    device = device_of(config.device)
    model = (build_model(config, prepared.facts) if model is None else model).to(device)
    optimizer = optimizer_of(config, model)
    checkpoint.tidy(run.checkpoints)
    saved, damaged = checkpoint.load_latest(run.checkpoints)
    for line in damaged:
        run.log({"damaged": line})
    if saved is not None:
        checkpoint.restore(saved, model, optimizer)
    loop = Loop(config, prepared, model, optimizer, device, lead)
    step, before = (saved.step, saved.seconds) if saved is not None else (0, spent)
    start = last_saved = last_report = time.perf_counter()
    clock, again = before, -1
    with held_back() as stop:
        try:
            while progress(config, step, clock) < 1:
                stop.obey()
                result = loop.step(step, progress(config, step, clock))
                now = time.perf_counter()
                due = now - last_report > REPORT_SECONDS
                if due or progress(config, step + 1, before + now - start) >= 1:
                    loop.read_faults()
                if loop.fault is not None:
                    run.log({"step": step, "skipped": loop.fault})
                if loop.failed >= PATIENCE:
                    again = step = _go_back(run, loop, step, again)
                    continue
                step += 1
                clock = before + now - start
                if due:
                    last_report = now
                    report(result(progress(config, step, clock), clock))
                if now - last_saved > 60 * config.checkpoint_minutes:
                    checkpoint.save(run.checkpoints, model, optimizer, step=step, seconds=clock)
                    last_saved = time.perf_counter()
            stop.obey()
        except KeyboardInterrupt:
            if not stop.hurried:
                checkpoint.save(run.checkpoints, model, optimizer, step=step, seconds=clock)
            raise
        except Exception as error:
            if not out_of_memory(error):
                raise
            raise shortage(f"training step {step}", error, _less(run)) from error
    if saved is None or step > saved.step:
        checkpoint.save(run.checkpoints, model, optimizer, step=step, seconds=clock)
    if loop.steps:
        report(loop.summary(step, 1.0, clock))
    return model


def _less(run: Run) -> str:
    """Advice where there is not enough memory for a step."""
    steps = checkpoint.steps(run.checkpoints)
    kept = f"the checkpoint of step {steps[-1]} is kept" if steps else "there is no checkpoint yet"
    return f"lower --datamanager.rays, or begin anew with a larger --downscale ({kept})"


def _go_back(run: Run, loop: "Loop", step: int, again: int) -> int:
    """Put the newest checkpoint back and return its step; a second time to the same one (`again`) would change nothing."""
    why = f"step {step}: {loop.fault} is not finite for {PATIENCE} steps in a row"
    remedy = "lower --optimizer.rate, or check the images"
    saved, _ = checkpoint.load_latest(run.checkpoints)
    if saved is None:
        raise NumericsError(f"{why}; {remedy}")
    if saved.step == again:
        raise NumericsError(f"{why}, again after going back to step {again}; {remedy}")
    checkpoint.restore(saved, loop.model, loop.optimizer)
    loop.reset_failures()
    run.log({"step": step, "gone_back_to": saved.step, "because": why})
    return saved.step


class Loop:
    """Training step by step, and what lives between steps but is not saved: running means for the display.

    Its parts carry names (`fprf.batch` ...) that a profiler sees; without one they cost microseconds.
    """

    def __init__(
        self,
        config: TrainConfig,
        prepared: Prepared,
        model: Model,
        optimizer: torch.optim.Optimizer,
        device: torch.device,
        lead: int = 0,
    ) -> None:
        self.lead = lead
        self.config, self.model, self.optimizer, self.device = config, model, optimizer, device
        self.facts: Facts = prepared.facts
        self.deferred = device.type == "cuda"
        """True where the host reads faults only with the reports."""
        self.tf32 = config.precision == "tf32" and device.type == "cuda"
        self.half = config.precision == "bfloat16" and device.type != "cpu"
        check_penalties(config.loss, model)
        self.extra = extra_term(config.loss)
        self.manager = prepared.manager
        if device.type != "cpu":
            free = free_memory(device) if device.type == "cuda" else None
            self.manager = prepared.manager.to(device, room=int(config.device_memory * (free or 0)))
        self.batches = Batches(self.manager, device)
        self.through = PixelRays(prepared.scene.cameras)
        if device.type != "mps" and not self.through.waits:  # MPS has no float64: rays are made on the CPU, as those that wait
            self.through.to(device)
        self.background = background_of(prepared.facts, device)
        self.statistics = StepStatistics(device)
        self.steps = self.skipped = self.failed = 0
        self.fault: str | None = None
        """Names of what was not finite in the last step, or since faults were last read; None where all was well."""
        self.rays = 0
        self.begun = time.perf_counter()

    def step(self, step: int, share: float) -> Callable[[float, float], Report]:
        """One step; the answer makes a report when one is due."""
        with tf32(self.tf32):
            self._step(step, share)
        return lambda share, seconds: self.summary(step + 1, share, seconds)

    def _step(self, step: int, share: float) -> None:
        with record_function("fprf.batch"):
            drawn = self.batches(step)
            batch = _moved(drawn, self.device)
            rays, ends = self._rays(drawn if self.through.device.type == "cpu" else batch)
        for group in self.optimizer.param_groups:
            group["lr"] = rate(self.config.optimizer, step, share)
        draws = generator_of(self.config.seed, step, self.device, purpose="draws")
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.half):
            rendered = render_rays(
                rays,
                self.model.parts,
                want=wanted(self.config.loss, batch, self.extra),
                budget=self.config.render.train_budget,
                background=self.background,
                step=step + self.lead,
                generator=draws,
                semantic_rays=len(batch.semantic) if batch.semantic is not None else None,
                semantic_samples=self.config.semantic.samples,
                content_moves_density=self.config.content.moves_density,
            )
        rendered = toned(rendered, self.model.tones, batch.view)
        with record_function("fprf.losses"):
            parts = terms(
                self.config.loss,
                self.facts,
                rendered,
                batch,
                self.model,
                step=step,
                ends=ends,
                extra=self.extra,
                generator=draws,
            )
            loss = total(self.config.loss, parts, share)
        self.optimizer.zero_grad(set_to_none=True)
        if self.deferred:
            self._step_deferred(loss)
        else:
            self._step_checked(loss, parts, step)
        kept = rendered.counts["kept"] / max(1, rendered.counts["samples"])
        self.statistics.add(parts | {"kept": torch.full((), kept, device=loss.device)})
        self.steps, self.rays = self.steps + 1, self.rays + len(batch.rgb)

    def _step_checked(self, loss: Tensor, parts: dict[str, Tensor], step: int) -> None:
        """Check the loss and the gradients, then step."""
        self.fault = unfit_terms(loss, parts)
        if self.fault is None:
            with record_function("fprf.backward"):
                loss.backward()  # type: ignore[no-untyped-call]
            self.fault = unfit_gradients(self.model.named_parameters())
        if self.fault is None:
            with record_function("fprf.optimizer"):
                self.optimizer.step()
            if (step + 1) % CLEAR_EVERY == 0:
                clear_denormals(self.optimizer)
            self.failed = 0
        else:
            self.skipped, self.failed = self.skipped + 1, self.failed + 1

    def _step_deferred(self, loss: Tensor) -> None:
        """Step, unless the device finds a loss or gradient that is not finite."""
        self.fault = None
        with record_function("fprf.backward"):
            loss.backward()  # type: ignore[no-untyped-call]
        flag = unfit_step(loss, self.model.parameters())
        with record_function("fprf.optimizer"):
            # As torch's GradScaler does: the optimiser then changes neither parameters, moments nor its count of steps.
            self.optimizer.found_inf = flag  # type: ignore[attr-defined]
            self.optimizer.step()
        self.statistics.count_skipped(flag)

    def read_faults(self) -> None:
        """Fetch what the device found in the steps since the last call."""
        if self.deferred:
            skipped, self.failed, names = self.statistics.faults()
            self.fault = (names or "a gradient") if skipped > self.skipped else None
            self.skipped = skipped

    def reset_failures(self) -> None:
        """Count failures in a row anew."""
        self.failed = 0
        self.statistics.failed.zero_()

    def summary(self, step: int, share: float, seconds: float) -> Report:
        """Running means, corrected for their start; a term that comes every few steps counts when it comes."""
        means = self.statistics.means()
        losses = {name: value for name, value in means.items() if name != "kept"}
        rgb = torch.tensor(losses.get("rgb", 1.0)).clamp_min(1e-10)
        speed = self.rays / (time.perf_counter() - self.begun)
        return Report(step, share, seconds, float(-10 * rgb.log10()), speed, means.get("kept", 0.0), losses, self.skipped)

    def _rays(self, batch: Batch) -> tuple[Rays, Tensor | None]:
        """The rays of a batch, and their parameters at its known distances."""
        there, space = self.through.device, self.model.space
        origin, direction = self.through(batch.view.to(there), batch.pixel.to(there))
        ends = None
        if batch.distance is not None:
            ends = space.parameter(origin, direction, batch.distance.to(there)).to(self.device)
        if self.model.poses is not None:
            rays = moving(space.rays(*self.model.poses(batch.view, origin, direction)))
        else:
            rays = space.rays(origin, direction)
        return Rays(*(x.to(self.device) for x in rays)), ends


class Batches:
    """Batches of a data manager. For an accelerator those in host memory are drawn one step ahead by a thread."""

    def __init__(self, manager: DataManager, device: torch.device) -> None:
        self.manager, self.device = manager, device
        self._thread: ThreadPoolExecutor | None = None
        self._next: tuple[int, Future[Batch]] | None = None

    def __call__(self, step: int) -> Batch:
        """The batch of a step, as the manager draws it, or in pinned memory."""
        if self._next is None:
            batch = self.manager.batch(step)
            if batch.rgb.device.type != "cpu" or self.device.type == "cpu":
                return batch
        elif self._next[0] == step:
            batch = self._next[1].result()
        else:  # after going back
            batch = self._later(step).result()
        self._next = (step + 1, self._later(step + 1))
        return batch

    def _later(self, step: int) -> "Future[Batch]":
        if self._thread is None:
            self._thread = ThreadPoolExecutor(1, thread_name_prefix="fprf-batches")
        return self._thread.submit(self._pinned, step)

    def _pinned(self, step: int) -> Batch:
        batch = self.manager.batch(step)
        return Batch._make(x if x is None or self.device.type != "cuda" else x.pin_memory() for x in batch)


def _moved(batch: Batch, device: torch.device) -> Batch:
    if device.type == "mps":  # which has no float64
        batch = batch._replace(pixel=batch.pixel.float())
    return Batch._make(x if x is None else x.to(device, non_blocking=device.type == "cuda") for x in batch)
