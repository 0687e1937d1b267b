"""3D Gaussians in training (Kerbl et al. 2023): one view a step, Adam, splits where views err.

A step renders a training view and moves what it shows against the gradient of

    L = (1 - ssim) mean |f * render - photograph| + ssim (1 - SSIM(f * render, photograph))        (Kerbl et al., Eq. 7)

where f are the factors of the view's own exposure (`Tones`), 1 where none are learnt. Where views err,
Gaussians are split, in the place of those that became transparent, and until there are as many as the config
allows: the relocation of 3DGS-MCMC (Kheradmand et al. 2024) with the halves of Kerbl et al.

Shapes: N Gaussians, M of them that are split, V views, K = (degree + 1)^2 harmonics of a colour channel. A
Gaussian is a row of R = 11 + 3 K float32 parameters, in the columns that `ops.rasterise.training` names:

    MEANS        3     in the world
    LOG_SCALES   3     natural logarithms of the standard deviations along the own axes
    QUATERNION   4     own axes to world, w x y z, of any length above 0
    LOGIT        1     opacity = 1 / (1 + exp(-logit)), in (0, 1)
    HARMONICS    3 K   colour = 0.5 + sum_k Y_k(direction) h_k, sRGB; coefficient after coefficient, that of degree 0 first

`share` in [0, 1) says how much of the schedule is over. Every draw is a function of (seed, step), so
parameters, Adam's moments and the step are all the state there is.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..interfaces import Figures, State
from ..ops.harmonics import HARMONIC
from ..ops.rasterise.gsplat import GsplatGaussians, Trainable, obstacle, trainable
from ..ops.rasterise.training import (
    HARMONICS,
    LOG_SCALES,
    LOGIT,
    MEANS,
    QUATERNION,
    Floats,
)
from ..progress import Display
from ..rendering.cameras import Cameras
from ..rendering.splines import rotations
from ..scenes import SceneLearner
from ..training import checkpoint
from ..training.camera_optimizers import moved_cameras, with_trend
from ..training.facts import Facts
from ..training.run import Known, Run
from .config import GaussiansConfig
from .gaussians import Gaussians, from_arrays, from_rows, from_tensors, tensors_of
from .initial import Points, curve_order, spacing
from .photographs import PhotographLevel
from .pose_trial import trial_gain
from .view_corrections import MOVES, ViewCorrections

_START_OPACITY = 0.3
"""Opacity of the first Gaussians; by eye."""
_START_WIDTH_SHARE = 0.7
"""Standard deviation of the first Gaussians, as a share of the distance to their neighbours; by eye."""
_SURROUNDINGS_OPACITY = 0.9
"""Opacity of the first Gaussians of the surroundings; by eye: what is far hides what is behind it."""
_LEARNING_RATES = {
    "means": 2.5e-3,
    "scales": 0.08,
    "quats": 0.016,
    "opacities": 0.1,
    "sh0": 0.07,
    "shN": 0.01,
}
"""Learning rates at the beginning, by gsplat's names, the means' in units of the scene scale. 0.6 and 1.5
times as much come to 0.07 dB less and 0.04 dB more on garden_seattle (training_trials.json).
"""
_FINAL_RATE_SHARE = 0.2
"""Share that is left of these, and of the decay, at the end of the training; by eye."""
_FINAL_MEANS_RATE_SHARE = 0.05
"""Share that is left of the means' rate; by eye."""
_HARMONICS_DECAY = 3e-3
"""Weight decay of the harmonics above degree 0, a step. From where no photograph looks they would become any
colour, which a style that refits cut colours brings into view as specks; by eye.
"""
_DECAY_EVERY_STEPS = 20
"""Steps between its uses, which then count as many times: it reads all Gaussians."""
_MAX_NAMED_PHOTOGRAPHS = 3
"""Blurred photographs that are named, at most."""
_MIN_RELOCATION_STEP = 200
"""Steps before the first relocation, while the first Gaussians settle; by eye."""
_MAX_RELOCATION_SHARE = 0.85
"""Share of the training after which nothing is moved any more, as it would not be learnt; by eye."""
_SORT_EVERY_RELOCATIONS = 5
"""Relocations between sorts in memory; by eye."""
_SORT_GROWTH_SHARE = 0.3
"""Growth of a relocation, as a share of the Gaussians, from which on they are sorted at once; by eye."""
_ERROR_VIEWS = 8
"""Views whose errors say where Gaussians are split; 16 gain nothing (training_trials.json)."""
_BLURRED_EVERY_EPOCHS = 8
"""Epochs of which one shows blurred views too. With 8 of 29 views moved by 7 to 13 pixels llff_flower comes
to 28.6 dB if all are shown alike, 29.1 without the eight, and 29.2 so; had none moved, to 29.7
(blurred.json).
"""
_MIN_LIVE_OPACITY = 0.005
"""Opacity below which a Gaussian is moved elsewhere: that of Kerbl et al. and of 3DGS-MCMC."""
_MAX_HALF_OPACITY = 0.995
"""Largest opacity of a half: beyond it gradients vanish; by eye."""
_MAX_SKY_SHARE = 0.7
"""Share of a Gaussian's weight in sky from which on it is moved; by eye."""
_MIN_SKY_PIXELS = 1.0
"""Weight in pixels of the views that is taken for a Gaussian with less, so that hardly seen ones stay; by
eye.
"""
_HALF_WIDTH_SHARE = 0.6
"""Size of a half along the longest axis, as a share of the Gaussian's; by eye: 1 / 1.6 in Kerbl et al."""
_HALF_DISTANCE_SHARE = 0.5
"""Distance of a half from the middle, as a share of the Gaussian's size; by eye."""
_HALF_OPACITY_SHARE = 0.85
"""Opacity of a half, as a share of the Gaussian's, since both overlap; by eye."""
_POSES_RATE = 5e-4
"""Rate of poses where a trial found that they are off (`GaussiansConfig.poses`)."""
_TRIAL_SHARE = 0.3
"""Share of the training after which the trial is made: photographs of half the size are half learnt."""
_MAX_TRIAL_VIEWS = 4
"""Views that are not learnt from before the trial, at most; by eye."""
_MIN_VIEWS_PER_TRIED = 4
"""Training views for each of them, at least: with fewer than so many in all, nothing is tried."""
_MEANS_DECAY = 0.95
"""Decay of running means of the losses; by eye."""
CPU = torch.device("cpu")

LimitWidths = Callable[[Trainable, int], None]
"""Cuts standard deviations in place after a step."""


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """Bounds on the count, places and widths of Gaussians."""

    room: int
    """Gaussians that there is memory for."""
    scene_scale: float
    """Unit of the means' learning rate, in world units."""
    near: float = 0.01
    """Nothing nearer to a camera is drawn."""
    inside: Callable[[Annotated[Tensor, "N 3"]], Annotated[Tensor, "N"]] | None = None
    """Mask of the means that are split or moved; None = all."""
    limit_widths: LimitWidths | None = None
    """Called after each step; None = no width is limited."""


@dataclass(frozen=True, kw_only=True)
class Stage:
    """The part of a whole schedule, and of the parameters, that a learner is given to train."""

    before: int = 0
    """Steps that its Gaussians were trained for elsewhere."""
    first: float = 0.0
    """Share of the schedule where its training begins."""
    last: float = 1.0
    """Share of the schedule where its training ends."""
    only: Literal["colours", "poses"] | None = None
    """Learn harmonics alone, or neither Gaussians nor factors; None = everything."""


@dataclass(frozen=True, kw_only=True)
class RunSource:
    """Source of a run."""

    known: Known
    """Content of scene.json."""
    points: str
    """Source of the first Gaussians."""


class GaussianLearner(SceneLearner):
    """Gaussians in training; `source` is given to learners of a run.

    `opaque` says that no photograph shows a background. Each step is then drawn over a colour of its own: over
    the same dark one in all steps, dark surfaces are learnt as holes (backgrounds.json).

    On a CUDA `device` they are drawn and moved there, where gsplat can; what is decided every tenth step or
    more rarely (widths, splits) is decided on the CPU.
    """

    def __init__(
        self,
        config: GaussiansConfig,
        levels: list[PhotographLevel],
        bounds: Bounds,
        *,
        corrections: ViewCorrections | None = None,
        stage: Stage | None = None,
        source: RunSource | None = None,
        opaque: bool = False,
        device: torch.device = CPU,
    ) -> None:
        self.config = config
        self.opaque = opaque
        self.levels = levels
        self.bounds = bounds
        self.corrections = corrections or ViewCorrections()
        self.stage = stage or Stage()
        self.source = source
        self.asked = device
        self.bands = (config.degree + 1) ** 2
        self.model: Trainable = trainable(bounds.room, self.bands, device)
        self.begun = 0
        """Gaussians at the start."""
        self.pixels = 0
        self.skipped = 0
        self.failed = 0
        """Steps in a row whose loss was not finite."""
        self.means: dict[str, float] = {}
        """Running means of the losses."""

    @property
    def device(self) -> torch.device:
        """Device of the Gaussians."""
        if isinstance(self.model, GsplatGaussians):
            return self.model.device
        return CPU

    @property
    def facts(self) -> Facts:
        assert self.source is not None  # learners of a run have it
        return self.source.known.facts

    def begin_at(self, points: Points, rng: np.random.Generator, surroundings: Points | None = None) -> None:
        """Put a Gaussian at each point: as wide as the points lie apart, in any direction; those of
        surroundings are opaque.
        """
        # Neighbours in space follow each other, so that tiles find what they show close together.
        order = curve_order(points.position)
        position = points.position[order]
        colour = points.colour[order]
        size = spacing(position) * _START_WIDTH_SHARE
        opacity = np.full(len(position), _START_OPACITY)
        if surroundings is not None:
            far = surroundings.position
            position = np.concatenate([position, far])
            colour = np.concatenate([colour, surroundings.colour])
            size = np.concatenate([size, spacing(far) * _START_WIDTH_SHARE])
            opacity = np.concatenate([opacity, np.full(len(far), _SURROUNDINGS_OPACITY)])
        # The same colour from everywhere: c = 0.5 + Y_0 h_0.
        harmonics = np.zeros((len(position), self.bands, 3), np.float32)
        harmonics[:, 0] = (colour - 0.5) / HARMONIC
        quaternions = rng.normal(size=(4, len(position))).T
        log_scales = np.repeat(np.log(size)[:, None], 3, 1)
        self.start_from(
            from_arrays(position, quaternions, log_scales, np.log(opacity / (1 - opacity)), harmonics)
        )

    def start_from(self, gaussians: Gaussians) -> None:
        """Begin with Gaussians, of the config's degree, as they are."""
        self.begun = len(gaussians)
        self.model.start(gaussians.rows.numpy())

    def step(self, index: int, share: float) -> None:
        """Learn from one view."""
        config = self.config
        only = self.stage.only
        step = self.stage.before + index
        share = self.stage.first + (self.stage.last - self.stage.first) * share
        # Coarse photographs first: half the size until `coarse`, a quarter until a third of that, and so on.
        level = self.levels[sum(share < config.coarse / 3**k for k in range(len(self.levels) - 1))]
        if self.corrections.undecided and share >= _TRIAL_SHARE:
            self._try_poses(level)
        view = self._view(level, step)
        target = self.corrections.moved(level[view], view)
        # Render, compare, and move every Gaussian that the view shows; nothing moves where the loss is not
        # finite.
        rates = self._learning_rates(share)
        factors = self.corrections.factors(view)
        measured = self.model.learn(
            target, background=self._background(step), ssim=config.ssim, rates=rates, factors=factors
        )
        if not math.isfinite(measured.l1 + measured.ssim):
            self.skipped = self.skipped + 1
            self.failed = self.failed + 1
            return
        self.failed = 0
        # Colours that no view shows fall back to their mean, and what grew too wide is cut.
        if step % _DECAY_EVERY_STEPS == 0 and only is None:
            decay = _DECAY_EVERY_STEPS * _HARMONICS_DECAY * _FINAL_RATE_SHARE**share
            self.model.multiply(slice(HARMONICS.start + 3, None), 1 - decay)
        if self.bounds.limit_widths is not None:
            self.bounds.limit_widths(self.model, step)
        if only != "poses":
            self.corrections.learn_tones(view, measured, config.rate, share)
        pace = _POSES_RATE if config.poses is None else config.poses
        self.corrections.learn_poses(view, target, measured, pace, share)
        # Gaussians move to where views err, but not while the first ones settle, nor so late that nothing
        # learns them.
        due = (step + 1) % config.relocate_every == 0 and only is None
        if due and step >= _MIN_RELOCATION_STEP and share < max(config.grow, _MAX_RELOCATION_SHARE):
            self._relocate_and_grow(step, level, share)
        # Running means, which start at the first value.
        self.pixels += target.width * target.height
        if not math.isfinite(measured.squared):  # no pixel of the view counts
            return
        for name, value in (("rgb", measured.squared), ("l1", measured.l1), ("ssim", measured.ssim)):
            self.means[name] = _MEANS_DECAY * self.means.get(name, value) + (1 - _MEANS_DECAY) * value

    def _background(self, step: int) -> tuple[float, float, float]:
        """The colour behind everything in a step: that of the config, or one of the step's own."""
        if not self.opaque or self.stage.only is not None:
            return self.config.background
        red, green, blue = np.random.default_rng((self.config.seed, step, 2)).random(3).tolist()
        return red, green, blue

    def _view(self, level: PhotographLevel, step: int) -> int:
        """The view of a step. Each epoch sees views once, in an order of its own: sharp ones, and all in
        every eighth.
        """
        every = self._learned(level)
        sharp = self._sharp(level)
        cycle, at = divmod(step, len(every) + (_BLURRED_EVERY_EPOCHS - 1) * len(sharp))
        epoch = _BLURRED_EVERY_EPOCHS * cycle
        turn = at
        if at >= len(every):
            later, turn = divmod(at - len(every), len(sharp))
            epoch = epoch + 1 + later
            every = sharp
        return int(every[np.random.default_rng((self.config.seed, epoch)).permutation(len(every))[turn]])

    def _try_poses(self, level: PhotographLevel) -> None:
        """Decide whether poses are refined: where moving views that nothing was learnt from helps to show
        them.
        """
        assert self.corrections.poses is not None  # it is undecided
        views = self._tried(level)
        # A copy, since a step changes moments.
        model = trainable(self.model.count, self.bands, self.asked)
        model.start(self.model.read())
        gain = trial_gain(
            model,
            [level[view] for view in views],
            [self.corrections.factors(view) for view in views],
            background=self.config.background,
            ssim=self.config.ssim,
            reach=self.corrections.poses.reach,
        )
        self.corrections.decide(gain)

    def _tried(self, level: PhotographLevel) -> list[int]:
        """Views, evenly over all, that are not learnt from until they have said whether poses are refined."""
        if not self.corrections.undecided:
            return []
        views = list(level)
        count = min(_MAX_TRIAL_VIEWS, len(views) // _MIN_VIEWS_PER_TRIED)
        return [views[(2 * number + 1) * len(views) // (2 * count)] for number in range(count)]

    def _learned(self, level: PhotographLevel) -> list[int]:
        """Views that are learnt from now."""
        tried = self._tried(level)
        return [view for view in level if view not in tried]

    def _sharp(self, level: PhotographLevel) -> list[int]:
        """Views that are not blurred at a scale; all where only poses or colours are learnt."""
        found: list[int] = []
        for view in self._learned(level):
            if self.stage.only is not None or view not in level.blurred:
                found.append(view)
        return found

    def _learning_rates(self, share: float) -> Annotated[Floats, "R"]:
        """Learning rates of the columns, when a share of the training is over; 0 of what is not learnt."""
        sizes = {"means": 3, "scales": 3, "quats": 4, "opacities": 1, "sh0": 3, "shN": 3 * (self.bands - 1)}
        parts = []
        for name, size in sizes.items():
            parts.append(np.full(size, _LEARNING_RATES[name]))
        rates = np.concatenate(parts)
        rates[MEANS] *= self.bounds.scene_scale
        falls = np.full(len(rates), _FINAL_RATE_SHARE**share)
        falls[MEANS] = _FINAL_MEANS_RATE_SHARE**share
        if self.stage.only == "colours":
            rates[: HARMONICS.start] = 0
        elif self.stage.only == "poses":
            rates[:] = 0
        scaled: Floats = (self.config.rate * rates * falls).astype(np.float32)
        return scaled

    def _relocate_and_grow(self, step: int, level: PhotographLevel, share: float) -> None:
        """Split Gaussians where views err: as many as became transparent, which move there, and as the number
        grows by.
        """
        draw = np.random.default_rng((self.config.seed, step, 1))
        model = self.model
        # Of each Gaussian: the errors of some views, their sky, and all of their pixels, each times its
        # weight there.
        sums = np.zeros((model.count, 3))
        for view in draw.permutation(self._sharp(level))[:_ERROR_VIEWS]:
            target = self.corrections.moved(level[view], view)
            sums += model.errors(target, self.config.background, self.corrections.factors(view))
        error, sky, seen = sums.T
        # The chance of a split: opacity times error, so that neither haze nor what is right already becomes
        # more.
        opacity = 1 / (1 + np.exp(-model.read(LOGIT)[:, 0].astype(np.float64)))
        chance = np.nan_to_num(error * opacity)
        # Used again elsewhere: what is transparent, and what shows almost only in the sky and so floats
        # before it.
        reusable = (opacity < _MIN_LIVE_OPACITY) | (sky > _MAX_SKY_SHARE * np.maximum(seen, _MIN_SKY_PIXELS))
        if self.bounds.inside is not None:
            inside = self.bounds.inside(torch.from_numpy(model.read(MEANS))).numpy()
            chance = chance * inside
            reusable = reusable & inside
        reused = np.flatnonzero(reusable)
        chance[reused] = 0
        # The number grows evenly on a logarithmic scale: begun (cap / begun)^(share / grow).
        cap = max(self.config.most, self.begun)
        wanted = int(self.begun * (cap / self.begun) ** min(1.0, share / self.config.grow))
        more = max(wanted - model.count, 0)
        # One half stays in its place, the other takes that of one that is used again, or a new one at the
        # end.
        many = min(len(reused) + more, int(np.count_nonzero(chance)))
        if many > 0:
            picked = draw.choice(model.count, many, replace=False, p=chance / chance.sum())
            to = np.concatenate([reused, np.arange(model.count, model.count + more)])[:many]
            model.split(picked, to, *halves(model.read(index=picked), opacity[picked]))
        # Neighbours in space drift apart in memory, and tiles slow down.
        if (step + 1) % (
            _SORT_EVERY_RELOCATIONS * self.config.relocate_every
        ) == 0 or more > _SORT_GROWTH_SHARE * model.count:
            model.reorder(curve_order(model.read(MEANS)))

    def figures(self) -> Figures:
        means = self.means | {"gaussians": float(self.model.count)}
        return Figures(means, self.pixels, self.skipped, self.failed, "the loss" if self.failed else "")

    def gaussians(self) -> Gaussians:
        """The Gaussians as they are now."""
        return from_rows(torch.from_numpy(self.model.read()))

    def state(self) -> State:
        """Gaussians; Adam's moments and the weight in the second, exposures, poses, the number at the
        start.
        """
        first, second, weight = (torch.from_numpy(part) for part in self.model.moments())
        tensors = {"first": first, "second": second, "weight": weight, "begun": torch.tensor(self.begun)}
        tensors |= self.corrections.tensors()
        return State(tensors_of(self.gaussians(), self.bounds.near), tensors)

    def load(self, state: State) -> None:
        """Go on from a checkpoint; without their moments, tones and poses go on as they are.

        Checkpoints of before have no weights: their second moments are taken as they are.
        """
        moments = state.optimizer
        rows = from_tensors(state.model).rows.numpy()
        self.begun = int(moments["begun"])
        self.failed = 0
        weight = moments["weight"].numpy() if "weight" in moments else 1
        self.model.start(rows, moments["first"].numpy(), moments["second"].numpy(), weight)
        self.corrections.load(moments)

    def begin(self, run: Run) -> str:
        assert self.source is not None  # learners of a run have it
        tones = "" if self.corrections.tones is None else ", tones"
        if self.device == CPU:
            where = ""
        else:
            where = f", on {self.device} by gsplat"
        line = f", {self.model.count} Gaussians at {self.source.points}{tones}{where}"
        blurred = sorted(self.levels[0].blurred)
        if blurred:
            names = []
            for view in blurred[:_MAX_NAMED_PHOTOGRAPHS]:
                names.append(Path(self.source.known.names[view]).name)
            if len(blurred) > len(names):
                names.append("...")
            line += f"; blurred, and so shown rarely: {len(blurred)} of {len(self.levels[0])}"
            line += f" ({', '.join(names)})"
        steps = self.config.limited(len(self.levels[0]))
        if steps < self.config.most_steps:
            line += (
                f"; at most {steps} steps: {self.config.most_passes} passes over the photographs (--passes)"
            )
        return line + left_out(self.asked)

    def finish(self, run: Run, display: Display) -> None:
        """Say what became of poses."""
        line = self.corrections.said()
        if line:
            display.say(line)


def refined(cameras: Cameras, train: Sequence[int], facts: Facts, saved: checkpoint.Saved) -> Cameras:
    """The cameras of all views where training put them; those that were held out follow the trend."""
    moves = saved.optimizer.get(MOVES)
    if moves is None or not bool(moves.any()):
        return cameras
    return moved_cameras(cameras, with_trend(moves, cameras, train, facts.reach))


def left_out(device: torch.device) -> str:
    """A line that says why Gaussians are not trained on a CUDA device; empty where they are."""
    why = obstacle(device) if device.type == "cuda" else None
    if why is None:
        return ""
    return f"\nnote: Gaussians are trained on the CPU, not on {device}: {why}"


def halves(
    rows: Annotated[Floats, "M R"], opacity: Annotated[NDArray[np.float64], "M"]
) -> tuple[Annotated[Floats, "M R"], Annotated[Floats, "M R"]]:
    """Split Gaussians in two along their longest axes: both are smaller, fainter and beside the middle."""
    first = rows.copy()
    which = np.arange(len(rows))
    longest = first[:, LOG_SCALES].argmax(1)
    size = first[which, LOG_SCALES.start + longest]
    # The longest axis in the world is a column of the rotation.
    turns: Floats = rotations(torch.from_numpy(first[:, QUATERNION])).numpy()
    across = turns[which, :, longest] * np.exp(size)[:, None]
    # Both halves are alike: shorter along that axis, and fainter, as they overlap.
    first[which, LOG_SCALES.start + longest] += math.log(_HALF_WIDTH_SHARE)
    each = np.clip(_HALF_OPACITY_SHARE * opacity, _MIN_LIVE_OPACITY, _MAX_HALF_OPACITY)
    first[:, LOGIT] = np.log(each / (1 - each))[:, None]
    # They lie on either side of the middle.
    second = first.copy()
    first[:, MEANS] += _HALF_DISTANCE_SHARE * across
    second[:, MEANS] -= _HALF_DISTANCE_SHARE * across
    return first, second
