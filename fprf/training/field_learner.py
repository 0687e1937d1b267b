"""Fields in training: one batch of rays a step, Adam, and the paper's losses.

Batches and draws are functions of (seed, step), so a resumed run goes on as if never stopped. On CUDA the
host waits for the device only where figures are asked for: losses and faults stay on the device until then.
Batches are drawn there where their data fit, otherwise copied one step ahead.

Letters: R rays of a batch, S samples of a ray.
"""

import math
import shlex
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor

import torch
from torch import Tensor
from torch.profiler import record_function

from ..config import PASSES, OptimizerConfig, TrainConfig
from ..datamanagers.batches import generator_of
from ..datamanagers.scene import ParsedScene
from ..errors import CheckpointError
from ..fields.planes import Planes
from ..interfaces import DataManager, Figures, State
from ..memory import free_memory
from ..ops import adam
from ..ops.backend import tf32
from ..ops.triplane import HeldGradient
from ..progress import Display
from ..rendering.cameras import PixelRays
from ..rendering.renderer import TrainingStep, render_rays
from ..scenes import SceneLearner
from ..style.scene_style import to_tensors
from ..types import Batch, Rays
from . import checkpoint
from .camera_optimizers import rays_of_moving_cameras
from .facts import Facts
from .field_setup import Prepared
from .history import read_history
from .losses import check_penalties, extra_term, terms, total, wanted
from .model import Model, background_of, build_model
from .run import Run
from .style_pass import measure_style

SMOOTHING = 0.95
"""Decay of running means."""
CLEAR_EVERY = 100
"""Steps between looks for denormals. A first moment falls by 0.9^100 = 3e-5 until then."""
FAINT_FIRST = 1e-33
"""First moments below are cleared: after CLEAR_EVERY more steps they would be denormal (below 1.2e-38)."""
FAINT_SECOND = 1e-36
"""Second moments below are cleared. Their root, 1e-18, is far below any useful eps."""
LARGEST = 1.8e19
"""Norm of a gradient that Adam can square in float32 (3.4e38)."""
_FEW_STEPS = 600
"""Fewer are too few to judge by: a garden of ten views shows streaks on held-out ones after 350, at 19.8 dB
on the training views; flower and fox are at 22.9 and 27.1 dB on held-out views after 754 and 775.
"""


class FieldLearner(SceneLearner):
    """Fields in training: their model, its optimiser, and what lives between steps but is not saved: running
    means.

    `model` is one at its start, where it is not simply that of the config: a block in its surroundings, whose
    sampler was trained for `lead` steps before. The parts of a step carry names (`fprf.batch` ...) that a
    profiler sees; without one they cost microseconds.
    """

    def __init__(
        self,
        config: TrainConfig,
        prepared: Prepared,
        device: torch.device,
        model: Model | None = None,
        *,
        lead: int = 0,
    ) -> None:
        self.config = config
        self.prepared = prepared
        self._device = device
        self.lead = lead
        self.model = (build_model(config, prepared.facts) if model is None else model).to(device)
        chosen = config.optimizer
        betas = 0.9, chosen.beta2
        self.optimizer = torch.optim.Adam(
            self.model.learned(), lr=chosen.rate, betas=betas, eps=chosen.eps, fused=True
        )
        self.held = hold_gradients(self.model)
        self.tf32 = config.precision == "tf32" and device.type == "cuda"
        # A mistake in the config is told before features are moved and steps are taken.
        check_penalties(config.loss, self.model)
        self.extra = extra_term(config.loss)
        self.manager = prepared.manager
        if device.type != "cpu":
            # Data lie on the device where they fit: then batches are drawn there, without copies.
            free = None
            if device.type == "cuda":
                free = free_memory(device)
            self.manager = prepared.manager.to(device, room=int(config.device_memory * (free or 0)))
        self.batches = Batches(self.manager, device)
        self.through = PixelRays(prepared.scene.cameras)
        if (
            device.type != "mps" and not self.through.waits
        ):  # MPS has no float64: rays are made on the CPU, as those that wait
            self.through.to(device)
        self.background = background_of(prepared.facts, device)
        self.statistics = StepStatistics(device)
        self.rays = self.skipped = 0

    @property
    def device(self) -> torch.device:
        return self._device

    @property
    def facts(self) -> Facts:
        return self.prepared.facts

    def step(self, index: int, share: float) -> None:
        """Render a batch of rays, compare it with its pixels and features (paper, Eq. 3 and 4), and step."""
        with tf32(self.tf32):
            self._step(index, share)

    def _step(self, step: int, share: float) -> None:
        # The pixels of the step, and the rays through them: where poses are refined, of the cameras as they
        # are now.
        with record_function("fprf.batch"):
            drawn = self.batches(step)
            here = drawn
            if self.device.type == "mps":  # which has no float64
                here = drawn._replace(pixel=drawn.pixel.float())
            ahead = self.device.type == "cuda"
            batch = Batch._make(x if x is None else x.to(self.device, non_blocking=ahead) for x in here)
            rays, ends = self._rays(drawn if self.through.device.type == "cpu" else batch)
        for group in self.optimizer.param_groups:
            group["lr"] = rate(self.config.optimizer, step, share)
        draws = generator_of(self.config.seed, step, self.device, purpose="draws")
        # Colour, content and semantics along each ray; outputs that no loss needs are not computed.
        rendered = render_rays(
            rays,
            self.model.parts,
            want=wanted(self.config.loss, batch, self.extra),
            budget=self.config.render.train_budget,
            background=self.background,
            training=TrainingStep(
                step=step + self.lead,
                generator=draws,
                semantic_rays=len(batch.semantic) if batch.semantic is not None else None,
                semantic_samples=self.config.semantic.samples,
                content_moves_density=self.config.content.moves_density,
            ),
        )
        # Photographs differ in exposure: what is compared is the render as the view would have taken it.
        if self.model.tones is not None and rendered.rgb is not None:
            rendered = rendered._replace(rgb=rendered.rgb * self.model.tones(batch.view))
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
        for each in self.held:
            each.clear()
        self.optimizer.zero_grad(set_to_none=True)
        with record_function("fprf.backward"):
            loss.backward()  # type: ignore[no-untyped-call]
        # A loss or gradient that is not finite makes the norm so, and the device needs one comparison.
        norm = adam.gradient_norm(self.model.parameters())
        unfit = (~(torch.isfinite(loss.detach()) & (norm < LARGEST))).float()
        with record_function("fprf.optimizer"):
            if self.device.type == "cuda":
                # The host runs ahead and does not know: the optimiser then changes neither parameters,
                # moments nor its count of steps, as with torch's GradScaler.
                self.optimizer.found_inf = unfit  # type: ignore[attr-defined]
                self.optimizer.step()
            elif not bool(unfit):
                for each in self.held:
                    step_held(self.optimizer, each)
                self.optimizer.step()
                if (step + 1) % CLEAR_EVERY == 0:
                    clear_denormals(self.optimizer)
        kept = rendered.counts["kept"] / max(1, rendered.counts["samples"])
        self.statistics.add(parts | {"kept": torch.full((), kept, device=loss.device)}, unfit)
        self.rays += len(batch.rgb)

    def figures(self) -> Figures:
        """Running means, corrected for their start; a term that comes every few steps counts when it
        comes.
        """
        before = self.skipped
        (means, self.skipped, failed, names) = self.statistics.read()
        if self.skipped > before:
            fault = names or "the loss or a gradient"
        else:
            fault = ""
        return Figures(means, self.rays, self.skipped, failed, fault, means.pop("kept", 0.0))

    def state(self) -> State:
        return State(self.model.state_dict(), checkpoint.moments_of(self.optimizer))

    def load(self, state: State) -> None:
        checkpoint.restore(state, self.model, self.optimizer)
        self.statistics.failed.zero_()

    def begin(self, run: Run) -> str:
        """Write the basis of the semantics."""
        if self.prepared.basis is not None:
            run.save_tensors("basis", self.prepared.basis.tensors())
        facts = self.facts
        of_field = facts.of_field
        if of_field.dim:
            semantics = f", {of_field.dim} semantic"
        else:
            semantics = ", no semantic"
        tones = ", tones" if facts.exposure else ""
        return f", space {facts.space.kind}, {of_field.channels} content{semantics} channels{tones}"

    def finish(self, run: Run, display: Display) -> None:
        finish(run, display, self.config, self.model, self.prepared.scene)

    def _rays(self, batch: Batch) -> tuple[Rays, Tensor | None]:
        """The rays of a batch, and their parameters at its known distances."""
        # Rays are made in float64 in the world, then moved to the space of the field.
        there = self.through.device
        space = self.model.space
        origin, direction = self.through(batch.view.to(there), batch.pixel.to(there))
        ends = None
        if batch.distance is not None:
            ends = space.parameter(origin, direction, batch.distance.to(there)).to(self.device)
        if self.model.poses is not None:
            rays = rays_of_moving_cameras(space.rays(*self.model.poses(batch.view, origin, direction)))
        else:
            rays = space.rays(origin, direction)
        return Rays(*(x.to(self.device) for x in rays)), ends


class Batches:
    """Batches of a data manager. For an accelerator those in host memory are drawn one step ahead by a
    thread.
    """

    def __init__(self, manager: DataManager, device: torch.device) -> None:
        self.manager = manager
        self.device = device
        self._thread = ThreadPoolExecutor(
            1, thread_name_prefix="fprf-batches"
        )  # it starts with its first task
        self._next: tuple[int, Future[Batch]] | None = None

    def __call__(self, step: int) -> Batch:
        """The batch of a step, as the manager draws it, or in pinned memory."""
        if self._next is None:
            batch = self._draw(step)
        else:  # after going back it is another step than the one that was drawn ahead
            ahead, later = self._next
            batch = (later if ahead == step else self._thread.submit(self._draw, step)).result()
        if batch.rgb.device.type == "cpu" and self.device.type != "cpu":
            self._next = (step + 1, self._thread.submit(self._draw, step + 1))
        return batch

    def _draw(self, step: int) -> Batch:
        batch = self.manager.batch(step)
        if self.device.type != "cuda" or batch.rgb.device.type != "cpu":
            return batch
        # From pinned memory copies to the device need not be waited for.
        return Batch._make(None if x is None else x.pin_memory() for x in batch)


def hold_gradients(model: Model) -> list[HeldGradient]:
    """Hold the gradients of large tables of planes between steps."""
    found: list[HeldGradient] = []
    for module in model.modules():
        if isinstance(module, Planes):
            gradient = module.hold_gradient()
            if gradient is not None:
                found.append(gradient)
    return found


@torch.no_grad()
def step_held(optimizer: torch.optim.Adam, held: HeldGradient) -> None:
    """Take Adam's step of a table by the kernel that also clears its gradient; the optimiser, which keeps the
    moments, then finds no gradient of it. Where the kernel does not apply nothing changes.
    """
    table = held.table
    (group,) = optimizer.param_groups
    if table.grad is None or not adam.usable(table, table.grad, eps=group["eps"]):
        return
    state = optimizer.state[table]
    if not state:
        state["step"] = torch.zeros(())
        state["exp_avg"] = torch.zeros_like(table)
        state["exp_avg_sq"] = torch.zeros_like(table)
    state["step"] += 1
    beta1, beta2 = group["betas"]
    by = adam.AdamStep(group["lr"], beta1, beta2, group["eps"], int(state["step"]))
    adam.step(table, table.grad, adam.Moments(state["exp_avg"], state["exp_avg_sq"]), by)
    table.grad = None


def rate(config: OptimizerConfig, step: int, share: float) -> float:
    """Linear warm-up, then a cosine from `rate` to `final * rate`, and 1 / sqrt(step) from `hold` on."""
    if config.hold is None:
        late = 1.0
    else:
        late = math.sqrt(config.hold / max(config.hold, step))
    warm = min(1.0, (step + 1) / max(1, config.warm_up))
    cosine = 0.5 * (1 + math.cos(math.pi * share))
    return config.rate * warm * late * (config.final + (1 - config.final) * cosine)


class StepStatistics:
    """Running means of named scalars, and counts of those that were not finite, kept on their device until
    they are read.
    """

    def __init__(self, device: torch.device) -> None:
        self.names: list[str] = []
        # A row each: sums of values, sums of weights, how often not finite. MPS has no float64.
        self.rows = torch.zeros(
            3, 0, dtype=torch.float32 if device.type == "mps" else torch.float64, device=device
        )
        self.none = torch.full((), torch.nan, device=device)
        self.skipped = torch.zeros((), device=device)
        self.failed = torch.zeros((), device=device)
        self._present: dict[tuple[str, ...], Tensor] = {}

    @torch.no_grad()
    def add(self, values: Mapping[str, Tensor], unfit: Tensor) -> None:
        """One step's scalars. A name that is absent, or not finite, leaves its mean as it is; `unfit` is 1
        where the step was skipped, else 0.
        """
        self.skipped = self.skipped + unfit
        self.failed = (self.failed + 1) * unfit
        new = []
        for name in values:
            if name not in self.names:
                new.append(name)
        if new:
            self.names += new
            self.rows = torch.nn.functional.pad(self.rows, (0, len(new)))
            self._present.clear()
        given = tuple(values)
        if given not in self._present:
            # Filled on the device: a term that comes every few steps must not have the host wait for a copy.
            marks = []
            for name in self.names:
                marks.append(torch.full_like(self.none, float(name in values)))
            self._present[given] = torch.stack(marks).to(self.rows.dtype)
        parts = []
        for name in self.names:
            parts.append(values.get(name, self.none))
        row = torch.stack(parts).to(self.rows.dtype)
        # Where a value is not finite neither its sum nor its weight moves: the mean stays what it was.
        fit = torch.isfinite(row)
        means = SMOOTHING * self.rows[:2] + (1 - SMOOTHING) * torch.stack([row, self._present[given]])
        bad = self.rows[2] + self._present[given] * ~fit
        self.rows = torch.cat([torch.where(fit, means, self.rows[:2]), bad[None]])

    def read(self) -> tuple[dict[str, float], int, int, str]:
        """Means, steps skipped so far, the last ones in a row, and names of terms that were not finite since
        the last call.

        Means are corrected for their start, without names that never had a finite number. The host waits for
        the device once.
        """
        counts = torch.stack([self.skipped, self.failed]).to(self.rows.dtype)
        *numbers, skipped, failed = torch.cat([self.rows.flatten(), counts]).tolist()
        self.rows[2].zero_()
        # Both sums began at 0: their quotient is the mean over what was seen.
        value, weight, bad = (numbers[k * len(self.names) : (k + 1) * len(self.names)] for k in range(3))
        means = {}
        for name, v, w in zip(self.names, value, weight, strict=True):
            if w > 0:
                means[name] = v / w
        return (
            means,
            int(skipped),
            int(failed),
            ", ".join(name for name, b in zip(self.names, bad, strict=True) if b > 0),
        )


@torch.no_grad()
def clear_denormals(optimizer: torch.optim.Optimizer) -> None:
    """Set moments of Adam that are, or would soon be, denormal to zero; the parameters' next step is the same
    without them.
    """
    for state in optimizer.state.values():
        first = state.get("exp_avg")
        second = state.get("exp_avg_sq")
        if first is not None and second is not None:
            torch.hardshrink(first, FAINT_FIRST, out=first)
            torch.threshold_(second, FAINT_SECOND, 0.0)


def finish(run: Run, display: Display, config: TrainConfig, model: Model, scene: ParsedScene) -> None:
    """Measure and keep the scene's own style, and say what quality training reached."""
    display.say("measuring the scene's own style")
    run.save_tensors("style", to_tensors(measure_style(config, model, scene.cameras, scene.train)))
    display.say(training_summary(run, config, scene))


def training_summary(run: Run, config: TrainConfig, scene: ParsedScene) -> str:
    """One line on what a training reached, by its events.jsonl or those of its blocks, and the command that
    raises it.
    """
    try:
        trained = []
        for history in read_history(run.root):
            if history.values.get("psnr", [None])[-1] is not None:
                trained.append(history)
    except CheckpointError:
        trained = []
    if not trained:
        return "no step was made"
    # Of a run in blocks the whole is as good as its blocks; its steps are those of the one trained least.
    blocks = [history for history in trained if history.name] or trained
    steps = min(history.step[-1] for history in blocks)
    psnr = sum(history.values["psnr"][-1] or 0.0 for history in blocks) / len(blocks)
    rays = sum(history.step[-1] for history in trained) * config.datamanager.batch_rays()
    # How often each training pixel was seen tells whether more steps or finer images would help.
    passes = rays / int(scene.cameras.size[scene.train].prod(1).sum())
    reached = f"{steps:,} steps, {passes:.2g} rays for each pixel, {psnr:.1f} dB on the training views"
    # The next try is advised in the unit that ended this one.
    timed = config.minutes is not None and steps < config.steps
    again = f"fprf train {shlex.quote(str(run.root / 'config.json'))}"
    if timed:
        longer = f"--minutes {2 * (config.minutes or 0):g}"
    else:
        longer = f"--steps {max(2 * config.steps, _FEW_STEPS)}"
    if steps < _FEW_STEPS:
        return f"warning: too few steps to judge the scene by: {reached}; go on: {again} {longer}"
    size = config.downscale or 1
    if size > 1 and passes > PASSES:
        finer = f"; for more detail: --downscale {max(size - 1, 1):g} and another --output"
    else:
        finer = ""
    return f"{reached}; to raise it: {again} {longer}{finer}"
