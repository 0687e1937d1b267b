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
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

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
    Learnt,
    Target,
)
from ..rendering.cameras import Cameras
from ..rendering.splines import rotations
from ..scenes import SceneLearner
from ..training import checkpoint
from ..training.camera_optimizers import Poses, Tones, moved_cameras, rotated
from ..training.facts import Facts
from ..training.run import Known, Run
from .config import GaussiansConfig
from .gaussians import Gaussians, from_arrays, from_rows, from_tensors, tensors_of
from .initial import Points, curve_order, spacing
from .photographs import Level

_START_OPACITY = 0.3
_START_SCALE = 0.7
_FAR_OPACITY = 0.9
"""First Gaussians: opacity, standard deviation as a share of the distance to their neighbours, opacity far
away.
"""
_RATES = {"means": 2.5e-3, "scales": 0.08, "quats": 0.016, "opacities": 0.1, "sh0": 0.07, "shN": 0.01}
"""Learning rates at the beginning, the means' in units of the scene scale. They fall to a fifth, the means'
to a twentieth.
"""
_DECAY = 3e-3
_DECAY_EVERY = 20
"""Weight decay of the harmonics above degree 0, a step, and the steps between its uses; it falls as the rates
do. From where no photograph looks they would become any colour, which a style that refits cut colours brings
into view as specks.
"""
_GAIN_RATE = 0.005
_EXPONENT_RATE = 2e-3
"""Learning rates of the logarithms of a view's factors, whenever it is seen, and of the exponent. They fall
to a tenth.
"""
_NAMED = 3
"""Blurred photographs that are named, at most."""
_SETTLE = 200
_SORT_EVERY = 5
_LAST = 0.85
"""Steps before the first relocation; relocations between sorts; share of training after which nothing is
moved any more.
"""
_ERROR_VIEWS = 8
"""Views whose errors say where Gaussians are split."""
_BLURRED_EVERY = 8
"""Epochs of which one shows blurred views too. With 8 of 29 views moved by 7 to 13 pixels llff_flower comes
to 28.6 dB if all are shown alike, 29.1 without the eight, and 29.2 so; had none moved, to 29.7
(benchmarks/results/blurred.json).
"""
_DEAD = 0.005
"""Opacity below which a Gaussian is moved elsewhere."""
_SKY = 0.7
_SEEN = 1.0
"""Share of a Gaussian's weight in sky, and its least weight in pixels of these views, from which on it is
moved.
"""
_SPLIT_SIZE = 0.6
_SPLIT_DISTANCE = 0.5
_SPLIT_OPACITY = 0.85
"""Halves: size and distance from the middle along the longest axis, as shares of its size; share of the
opacity.
"""
_SMOOTHING = 0.95
"""Decay of running means."""
CPU = torch.device("cpu")
MOVES = "poses.moves"
"""Name in checkpoints of where views were moved: `Poses.moved_by`."""
_KEPT = "value", "first", "second", "steps"
"""Names in checkpoints of the parameter of a correction, its moments, and the steps of each view."""

LimitWidths = Callable[[Trainable, int], None]
"""Cuts standard deviations in place after a step."""


class Stage(NamedTuple):
    """The part of a whole schedule that a learner is given to train."""

    before: int = 0
    """Steps that its Gaussians were trained for elsewhere."""
    first: float = 0.0
    last: float = 1.0
    """Shares of the schedule where its training begins and ends."""


class GaussianLearner(SceneLearner):
    """Gaussians in training. `scene_scale` is the unit of the means' learning rate, in world units.

    There is room for `room` of them. Only those whose means are `inside` are split or moved; None = all.
    After each step `limit_widths` may cut the standard deviations; None = none is limited. Nothing nearer to
    a camera than `near` is drawn. With `tones` each view's factors are learnt as well, with `poses` where
    each view was taken. `only` colours learns harmonics alone, `only` poses neither Gaussians nor factors.
    `known` is what scene.json will hold, for learners of a run; `origin` says where the first Gaussians come
    from. On a CUDA `device` they are drawn and moved there, where gsplat can; what is decided every tenth
    step or more rarely (widths, splits) is decided on the CPU.
    """

    def __init__(
        self,
        config: GaussiansConfig,
        levels: list[Level],
        scene_scale: float,
        room: int,
        inside: Callable[[Annotated[Tensor, "N 3"]], Annotated[Tensor, "N"]] | None = None,
        limit_widths: LimitWidths | None = None,
        *,
        near: float = 0.01,
        tones: Tones | None = None,
        poses: Poses | None = None,
        only: Literal["colours", "poses"] | None = None,
        stage: Stage | None = None,
        known: Known | None = None,
        origin: str = "",
        device: torch.device = CPU,
    ) -> None:
        self.inside = inside
        self.limit_widths = limit_widths
        self.near = near
        self.known = known
        self.origin = origin
        self.config = config
        self.levels = levels
        self.scene_scale = scene_scale
        self.stage = stage or Stage()
        self.bands = (config.degree + 1) ** 2
        self.model: Trainable = trainable(room, self.bands, device)
        self.asked = device
        self.begun = self.pixels = self.skipped = self.failed = 0
        self.means: dict[str, float] = {}
        self.tones = tones
        self.poses = poses
        self.only = only
        self.corrections = {
            f"{kind}.{name}": (
                each.detach(),
                torch.zeros_like(each),
                torch.zeros_like(each),
                torch.zeros(each.shape[:1]),
            )
            for kind, module in (("tones", tones), ("poses", poses))
            for name, each in (module.named_parameters() if module is not None else ())
        }
        """Corrections of views by name: the parameter, its moments and the steps of each view (`_KEPT`)."""

    @property
    def device(self) -> torch.device:
        """Where the Gaussians are."""
        if isinstance(self.model, GsplatGaussians):
            return self.model.device
        return CPU

    @property
    def facts(self) -> Facts:
        assert self.known is not None  # learners of a run have it
        return self.known.facts

    def begin_at(self, points: Points, rng: np.random.Generator, surroundings: Points | None = None) -> None:
        """Put a Gaussian at each point: as wide as the points lie apart, in any direction; those of
        surroundings are opaque.
        """
        # Neighbours in space follow each other, so that tiles find what they show close together.
        order = curve_order(points.position)
        position = points.position[order]
        colour = points.colour[order]
        size = spacing(position) * _START_SCALE
        opacity = np.full(len(position), _START_OPACITY)
        if surroundings is not None:
            far = surroundings.position
            position = np.concatenate([position, far])
            colour = np.concatenate([colour, surroundings.colour])
            size = np.concatenate([size, spacing(far) * _START_SCALE])
            opacity = np.concatenate([opacity, np.full(len(far), _FAR_OPACITY)])
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
        step = self.stage.before + index
        share = self.stage.first + (self.stage.last - self.stage.first) * share
        # Coarse photographs first: half the size until `coarse`, a quarter until a third of that, and so on.
        level = self.levels[sum(share < config.coarse / 3**k for k in range(len(self.levels) - 1))]
        view = self._view(level, step)
        target = self._target(level, view)
        # Render, compare, and move every Gaussian that the view shows; nothing moves where the loss is not
        # finite.
        rates = self._learning_rates(share)
        factors = self._factors(view)
        measured = self.model.learn(
            target, background=config.background, ssim=config.ssim, rates=rates, factors=factors
        )
        if not math.isfinite(measured.l1 + measured.ssim):
            self.skipped = self.skipped + 1
            self.failed = self.failed + 1
            return
        self.failed = 0
        # Colours that no view shows fall back to their mean, and what grew too wide is cut.
        if step % _DECAY_EVERY == 0 and self.only is None:
            self.model.multiply(slice(HARMONICS.start + 3, None), 1 - _DECAY_EVERY * _DECAY * 0.2**share)
        if self.limit_widths is not None:
            self.limit_widths(self.model, step)
        self._correct_view(view, target, measured, share)
        # Gaussians move to where views err, but not while the first ones settle, nor so late that nothing
        # learns them.
        due = (step + 1) % config.relocate_every == 0 and self.only is None
        if due and step >= _SETTLE and share < max(config.grow, _LAST):
            self._relocate_and_grow(step, level, share)
        # Running means, which start at the first value.
        self.pixels += target.width * target.height
        if not math.isfinite(measured.squared):  # no pixel of the view counts
            return
        for name, value in (("rgb", measured.squared), ("l1", measured.l1), ("ssim", measured.ssim)):
            self.means[name] = _SMOOTHING * self.means.get(name, value) + (1 - _SMOOTHING) * value

    def _view(self, level: Level, step: int) -> int:
        """The view of a step. Each epoch sees views once, in an order of its own: sharp ones, and all in
        every eighth.
        """
        every = list(level)
        sharp = self._sharp(level)
        cycle, at = divmod(step, len(every) + (_BLURRED_EVERY - 1) * len(sharp))
        epoch = _BLURRED_EVERY * cycle
        turn = at
        if at >= len(every):
            later, turn = divmod(at - len(every), len(sharp))
            epoch = epoch + 1 + later
            every = sharp
        return int(every[np.random.default_rng((self.config.seed, epoch)).permutation(len(every))[turn]])

    def _sharp(self, level: Level) -> list[int]:
        """Views that are not blurred at a scale; all where only poses or colours are learnt."""
        found: list[int] = []
        for view in level:
            if self.only is not None or view not in level.blurred:
                found.append(view)
        return found

    def _target(self, level: Level, view: int) -> Target:
        """A photograph, taken from where its pose is now."""
        target = level[view]
        if self.poses is None:
            return target
        move = self.poses.moved_by()[view]
        axes = rotated(torch.from_numpy(target.axes), move[:3].expand(3, 3))
        return target.seen_from(axes.numpy(), target.centre + move[3:].numpy())

    def _factors(self, view: int) -> Annotated[Floats, "3"] | None:
        """Factors of renders of a view; None = 1."""
        return None if self.tones is None else self.tones(torch.tensor([view]))[0].detach().numpy()

    def _learning_rates(self, share: float) -> Annotated[Floats, "R"]:
        """Learning rates of the columns, when a share of the training is over; 0 of what is not learnt."""
        sizes = {"means": 3, "scales": 3, "quats": 4, "opacities": 1, "sh0": 3, "shN": 3 * (self.bands - 1)}
        rates = np.concatenate([np.full(size, _RATES[name]) for name, size in sizes.items()])
        rates[MEANS] *= self.scene_scale
        falls = np.full(len(rates), 0.2**share)
        falls[MEANS] = 0.05**share
        if self.only is not None:
            rates[: HARMONICS.start if self.only == "colours" else None] = 0
        scaled: Floats = (self.config.rate * rates * falls).astype(np.float32)
        return scaled

    @torch.no_grad()
    def _correct_view(self, view: int, target: Target, measured: Learnt, share: float) -> None:
        """Move the exposure and the pose of a view by a step of Adam; their rates fall to a tenth.

        Each view counts its own steps: with moments of all views together, one that is seen every thousandth
        step moved by the root of a thousand times the rate, and far scenes got worse.
        """
        if self.tones is not None and self.only != "poses":
            # The factor is exp(gain + exponent * exposure): a slope by the exponent is that by the gain,
            # times the exposure.
            pull = torch.from_numpy(measured.pull)
            rate = self.config.rate * 0.1**share
            _adam_step([each[view] for each in self.corrections["tones.gain"]], pull, _GAIN_RATE * rate)
            if self.tones.exponent.requires_grad:
                slope = pull.sum() * self.tones.exposure[view]
                _adam_step(self.corrections["tones.exponent"], slope, _EXPONENT_RATE * rate)
        if self.poses is not None:
            # The gradient of a rotation vector is taken for that of a further turn: exact to first order in
            # how far views turn.
            gradient = torch.from_numpy(measured.of_camera)
            slope = torch.cat(
                [torch.from_numpy(target.axes).T @ gradient[:3], self.poses.reach * gradient[3:]]
            ).float()
            _adam_step(
                [each[view] for each in self.corrections["poses.offset"]],
                slope,
                self.config.poses * 0.1**share,
            )

    def _relocate_and_grow(self, step: int, level: Level, share: float) -> None:
        """Split Gaussians where views err: as many as became transparent, which move there, and as the number
        grows by.
        """
        draw = np.random.default_rng((self.config.seed, step, 1))
        model = self.model
        # Of each Gaussian: the errors of some views, their sky, and all of their pixels, each times its
        # weight there.
        sums = np.zeros((model.count, 3))
        for view in draw.permutation(self._sharp(level))[:_ERROR_VIEWS]:
            sums += model.errors(self._target(level, view), self.config.background, self._factors(view))
        error, sky, seen = sums.T
        # The chance of a split: opacity times error, so that neither haze nor what is right already becomes
        # more.
        opacity = 1 / (1 + np.exp(-model.read(LOGIT)[:, 0].astype(np.float64)))
        chance = np.nan_to_num(error * opacity)
        # Used again elsewhere: what is transparent, and what shows almost only in the sky and so floats
        # before it.
        reusable = (opacity < _DEAD) | (sky > _SKY * np.maximum(seen, _SEEN))
        if self.inside is not None:
            inside = self.inside(torch.from_numpy(model.read(MEANS))).numpy()
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
        if (step + 1) % (_SORT_EVERY * self.config.relocate_every) == 0 or more > 0.3 * model.count:
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
        for name, kept in self.corrections.items():
            tensors |= {f"{name}.{key}": each.clone() for key, each in zip(_KEPT, kept, strict=True)}
        if self.poses is not None:
            tensors[MOVES] = self.poses.moved_by()
        return State(tensors_of(self.gaussians(), self.near), tensors)

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
        for name, kept in self.corrections.items():
            for key, each in zip(_KEPT, kept, strict=True):
                if f"{name}.{key}" in moments:
                    each.copy_(moments[f"{name}.{key}"])

    def begin(self, run: Run) -> str:
        most = self.config.limited(len(self.levels[0]))
        passes = f"; at most {most} steps: {self.config.most_passes} passes over the photographs (--passes)"
        names = self.known.names if self.known is not None else ()
        dull = sorted(self.levels[0].blurred)
        few = ", ".join(Path(names[view]).name for view in dull[:_NAMED]) + (
            ", ..." if len(dull) > _NAMED else ""
        )
        if dull:
            blur = f"; blurred, and so shown rarely: {len(dull)} of {len(self.levels[0])} ({few})"
        else:
            blur = ""
        light = ", tones" if self.tones is not None else ""
        if self.device == CPU:
            where = ""
        else:
            where = f", on {self.device} by gsplat"
        limit = passes if most < self.config.most_steps else ""
        line = f", {self.model.count} Gaussians at {self.origin}{light}{where}{blur}{limit}"
        return line + left_out(self.asked)


def refined(cameras: Cameras, saved: checkpoint.Saved) -> Cameras:
    """The cameras of all views where training put them."""
    moves = saved.optimizer.get(MOVES)
    return cameras if moves is None else moved_cameras(cameras, moves)


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
    first[which, LOG_SCALES.start + longest] += math.log(_SPLIT_SIZE)
    each = np.clip(_SPLIT_OPACITY * opacity, _DEAD, 0.995)
    first[:, LOGIT] = np.log(each / (1 - each))[:, None]
    # They lie on either side of the middle.
    second = first.copy()
    first[:, MEANS] += _SPLIT_DISTANCE * across
    second[:, MEANS] -= _SPLIT_DISTANCE * across
    return first, second


def _adam_step(kept: Sequence[Tensor], gradient: Tensor, rate: float) -> None:
    """One step of Adam (Kingma and Ba 2015, Algorithm 1), in place, on a value, its two moments and the
    number of steps.
    """
    value, first, second, steps = kept
    steps += 1
    first.lerp_(gradient, 1 - 0.9)
    second.lerp_(gradient.square(), 1 - 0.999)
    value -= rate * first / (1 - 0.9**steps) / ((second / (1 - 0.999**steps)).sqrt() + 1e-8)
