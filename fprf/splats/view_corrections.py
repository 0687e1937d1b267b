"""Corrections of training views that are learnt with a scene of Gaussians: exposures and poses.

Each view counts its own steps of Adam: with moments of all views together, one that is seen every thousandth
step moved by the root of a thousand times the rate, and far scenes got worse.
"""

import math
from collections.abc import Mapping
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..ops.rasterise.training import Floats, Learnt, Target
from ..training.camera_optimizers import Poses, Tones, rotated

MOVES = "poses.moves"
"""Name in checkpoints of where views were moved: `Poses.moved_by`."""
_GAIN_RATE = 5e-3
"""Learning rate of the logarithms of a view's factors, whenever it is seen; by eye."""
_EXPONENT_RATE = 2e-3
"""Learning rate of the exponent that all views share; by eye."""
_FINAL_CORRECTION_SHARE = 0.1
"""Share that is left of these rates, and of that of poses, at the end of the training; by eye."""
_FIRST_DECAY = 0.9
"""Decay of Adam's first moment: that of Kingma and Ba 2015."""
_SECOND_DECAY = 0.999
"""Decay of Adam's second moment: that of Kingma and Ba 2015."""
_MIN_TRIAL_GAIN = 0.1
"""Decibels that pixels which a trial left out must gain for poses to be refined: at 0.29 and 0.16 held-out
views gained (llff_flower, llff_fern), at 0.06 and 0.05 they lost as given (fox, m360_bonsai).
"""
_CHOICE = "poses.choice"
"""Name in checkpoints of whether poses are refined: 0 not decided, 1 they are, 2 they are not."""
_GAIN = "poses.gain"
"""Name in checkpoints of what the trial gained, decibels."""
_ADAM_EPS = 1e-8
"""Keeps a step finite where the gradient was always 0: that of Kingma and Ba 2015."""


class AdamState(NamedTuple):
    """A parameter and what Adam knows of it, by the names of checkpoints; all are changed in place."""

    value: Tensor
    first: Tensor
    second: Tensor
    steps: Tensor
    """Of each row."""

    @classmethod
    def beginning(cls, value: Tensor) -> "AdamState":
        """The state before the first step."""
        steps = torch.zeros(value.shape[:1])
        return cls(value, torch.zeros_like(value), torch.zeros_like(value), steps)

    def row(self, row: int) -> "AdamState":
        """The state of one row; it shares the memory."""
        return AdamState(self.value[row], self.first[row], self.second[row], self.steps[row])

    def step(self, gradient: Tensor, rate: float) -> None:
        """One step (Kingma and Ba 2015, Algorithm 1)."""
        self.steps.add_(1)
        self.first.lerp_(gradient, 1 - _FIRST_DECAY)
        self.second.lerp_(gradient.square(), 1 - _SECOND_DECAY)
        deviation = (self.second / (1 - _SECOND_DECAY**self.steps)).sqrt()
        self.value.sub_(rate * self.first / (1 - _FIRST_DECAY**self.steps) / (deviation + _ADAM_EPS))


class ViewCorrections:
    """Factors of the views' colours (`tones`) and where each was taken (`poses`); None = not learnt."""

    def __init__(
        self, tones: Tones | None = None, poses: Poses | None = None, *, decided: bool = True
    ) -> None:
        """Where it is not `decided` whether poses are refined they stay until `decide`."""
        self.tones = tones
        self.poses = poses
        self.choice = 1 if decided else 0
        self.gain: float | None = None
        """Decibels that the trial gained; None where there was none yet."""
        self.states: dict[str, AdamState] = {}
        for kind, module in (("tones", tones), ("poses", poses)):
            if module is not None:
                for name, parameter in module.named_parameters():
                    self.states[f"{kind}.{name}"] = AdamState.beginning(parameter.detach())

    def moved(self, target: Target, view: int) -> Target:
        """A photograph, taken from where its pose is now."""
        if self.poses is None or self.choice != 1:
            return target
        move = self.poses.moved_by()[view]
        axes = rotated(torch.from_numpy(target.axes), move[:3].expand(3, 3))
        return target.seen_from(axes.numpy(), target.centre + move[3:].numpy())

    @property
    def undecided(self) -> bool:
        """True where nothing has said yet whether poses are refined."""
        return self.poses is not None and self.choice == 0

    def said(self) -> str:
        """A line about what became of poses; empty where none could be refined."""
        if self.poses is None or self.choice == 0:
            return ""
        why = "" if self.gain is None else f" (a trial gained {self.gain:.2f} dB)"
        if self.choice != 1:
            return f"poses: as given{why}"
        moves = self.poses.moves().detach()[self.poses.learned]
        turn = math.degrees(float(moves[:, :3].norm(dim=1).mean()))
        shift = float(moves[:, 3:].norm(dim=1).mean())
        return (
            f"poses: refined{why}, by {turn:.3f} degrees and {shift:.2%} of the distance that views see, on average; "
            "held-out views follow the trend"
        )

    def decide(self, gain: float) -> None:
        """Refine poses from here on where a trial gained enough, decibels."""
        self.gain = gain
        self.choice = 1 if gain >= _MIN_TRIAL_GAIN else 2

    def factors(self, view: int) -> Annotated[Floats, "3"] | None:
        """Factors of renders of a view; None = 1."""
        if self.tones is None:
            return None
        factors: Floats = self.tones(torch.tensor([view]))[0].detach().numpy()
        return factors

    @torch.no_grad()
    def learn_tones(self, view: int, measured: Learnt, rate: float, share: float) -> None:
        """Move the exposure of a view, when a share of the training is over; `rate` 1 is the usual one."""
        if self.tones is None:
            return
        # The factor is exp(gain + exponent * exposure): a slope by the exponent is that by the gain, times
        # the exposure.
        pull = torch.from_numpy(measured.pull)
        rate = rate * _FINAL_CORRECTION_SHARE**share
        self.states["tones.gain"].row(view).step(pull, _GAIN_RATE * rate)
        if self.tones.exponent.requires_grad:
            slope = pull.sum() * self.tones.exposure[view]
            self.states["tones.exponent"].step(slope, _EXPONENT_RATE * rate)

    @torch.no_grad()
    def learn_poses(self, view: int, target: Target, measured: Learnt, rate: float, share: float) -> None:
        """Move the pose of a view, when a share of the training is over."""
        if self.poses is None or self.choice != 1:
            return
        # The gradient of a rotation vector is taken for that of a further turn: exact to first order in how
        # far views turn.
        gradient = torch.from_numpy(measured.of_camera)
        of_turn = torch.from_numpy(target.axes).T @ gradient[:3]
        slope = torch.cat([of_turn, self.poses.reach * gradient[3:]]).float()
        self.states["poses.offset"].row(view).step(slope, rate * _FINAL_CORRECTION_SHARE**share)

    def tensors(self) -> dict[str, Tensor]:
        """Copies for a checkpoint."""
        tensors = {}
        for name, state in self.states.items():
            for key, part in state._asdict().items():
                tensors[f"{name}.{key}"] = part.clone()
        if self.poses is not None:
            tensors[MOVES] = self.poses.moved_by()
            tensors[_CHOICE] = torch.tensor(self.choice)
        if self.gain is not None:
            tensors[_GAIN] = torch.tensor(self.gain, dtype=torch.float64)
        return tensors

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Go on from a checkpoint; what it does not hold stays as it is."""
        for name, state in self.states.items():
            for key, part in state._asdict().items():
                if f"{name}.{key}" in tensors:
                    part.copy_(tensors[f"{name}.{key}"])
        if _CHOICE in tensors:
            self.choice = int(tensors[_CHOICE])
        if _GAIN in tensors:
            self.gain = float(tensors[_GAIN])
