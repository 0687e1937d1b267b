"""Training of a network by any loss: Adam, one cosine to zero by time or steps, checkpoints.

A batch is a function of (seed, step). The checkpoints lie in a folder beside the output until its weights are
written.
"""

import math
import time
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor, nn

from ..interfaces import Figures, Learner, State
from ..progress import Report
from ..training import checkpoint
from ..training.driver import Schedule, learn
from ..training.run import Run
from ..training.tasks import begin
from .config import PretrainConfig
from .photos import find_photos

WARM_UP = 0.02
"""Share of the run in which the rate rises."""
_CHECKPOINT_SECONDS = 60.0
"""Time between checkpoints: what an interrupt costs; by eye."""
_SPOKEN_SECONDS = 15.0
"""Time between lines of progress; by eye."""


def generator_of(seed: int, step: int) -> torch.Generator:
    """The generator of one step. Only 32 bits of a seed count, so seeds are spread over them."""
    return torch.Generator().manual_seed((seed * 0x9E3779B1 + step) % (1 << 32))


def training_folder(output: Path) -> Path:
    """Folder of an unfinished training of these weights."""
    return output.with_name(output.name + ".training")


class NetworkLearner(Learner):
    """A network in training. `loss` draws its batch from the generator of a step."""

    def __init__(
        self, network: nn.Module, loss: Callable[[torch.Generator], Tensor], config: PretrainConfig
    ) -> None:
        self.network = network
        self.loss = loss
        self.config = config
        self.optimizer = torch.optim.Adam(network.parameters(), config.rate)
        self.value = torch.zeros(())
        self.skipped = self.failed = self.seen = 0

    @property
    def device(self) -> torch.device:
        return next(self.network.parameters()).device

    def step(self, index: int, share: float) -> None:
        # Linear warm-up, then one cosine to zero over the whole schedule.
        warm = min(1.0, share / WARM_UP + 0.01)
        self.optimizer.param_groups[0]["lr"] = self.config.rate * warm * 0.5 * (1 + math.cos(math.pi * share))
        value = self.loss(generator_of(self.config.seed, index))
        self.optimizer.zero_grad(set_to_none=True)
        value.backward()  # type: ignore[no-untyped-call]
        self.value = value.detach()
        self.seen = self.seen + self.config.batch
        # A loss that is not finite changes nothing.
        finite = bool(torch.isfinite(self.value))
        self.skipped = self.skipped + (not finite)
        self.failed = 0 if finite else self.failed + 1
        if finite:
            self.optimizer.step()

    def figures(self) -> Figures:
        fault = "the loss" if self.failed else ""
        return Figures({"loss": float(self.value)}, self.seen, self.skipped, self.failed, fault)

    def state(self) -> State:
        return State(self.network.state_dict(), checkpoint.moments_of(self.optimizer))

    def load(self, state: State) -> None:
        checkpoint.restore(state, self.network, self.optimizer)
        self.failed = 0


def train(
    network: nn.Module,
    loss: Callable[[torch.Generator], Tensor],
    config: PretrainConfig,
    output: Path,
    say: Callable[[str], None],
) -> int:
    """Train in place until the budget is spent; the number of steps. A training of the same config and
    photographs goes on, another is dropped. The caller holds `training_folder(output)`, and removes it when
    the weights are written.

    Raises as `training.driver.learn`.
    """
    spoken = time.monotonic()

    def report(event: Report) -> None:
        nonlocal spoken
        now = time.monotonic()
        if now - spoken > _SPOKEN_SECONDS:
            say(f"step {event.step}  {100 * event.share:.0f} %  loss {event.losses['loss']:.5f}")
            spoken = now

    # The folder is a run's, as far as the driver needs one.
    run = Run(training_folder(output))
    schedule = Schedule(
        config.steps, None if config.steps is not None else config.minutes, _CHECKPOINT_SECONDS / 60
    )
    photos = []
    for path in find_photos(config.images)[: config.photos]:
        photos.append(zlib.crc32(path.read_bytes()))
    begin(run.root, repr((replace(config, device="auto"), photos)))
    if steps := checkpoint.steps(run.checkpoints):
        say(f"resumed at step {steps[-1]}")
    network.train()
    step, _ = learn(NetworkLearner(network, loss, config), run, schedule, report)
    network.eval()
    return step
