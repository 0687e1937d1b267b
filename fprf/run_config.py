"""The config of a run, whatever its scene is made of: what a kind of scene says about itself. Imports no torch."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from .checks import at_least, between, positive
from .datamanagers.parsers.config import DataParserConfig
from .errors import ConfigError, PluginError
from .plugins.config import Need
from .plugins.conversion import convert_fields
from .plugins.slots import slots

if TYPE_CHECKING:
    import torch

    from .datamanagers.scene import ParsedScene
    from .scenes import Partition, SceneLearner
    from .training.facts import Facts

RESUMABLE = (
    "steps",
    "minutes",
    "output",
    "data",
    "device",
    "device_memory",
    "precision",
    "checkpoint_minutes",
)
"""Fields of a run's config that may differ when a run is resumed."""
_MAX_IMAGE_PIXELS = 640 * 360
"""Pixels of an image, at most, where nobody says how far to reduce them: each step sees a whole one; by eye."""


class Reading(NamedTuple):
    """Reading of a run's capture, and the device that it is trained on."""

    device: str = "cpu"
    """cpu, cuda, mps or auto."""
    parser: DataParserConfig | None = None
    """Format of the scene folder; None = recognised from what lies in it."""
    masks: bool = True
    """Training and metrics leave out what the capture's masks name."""


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Fields of every run, whatever its scene is made of.

    A kind of scene is a subclass with `build`, returned by a method (entry point in `fprf.methods`), and a
    function that opens its runs, by the name `kind` in the group `fprf.scenes` (`training.loading.open_run`).
    """

    kind: ClassVar[str] = ""
    """Entry point in `fprf.scenes` of the function that opens such a run."""
    open: ClassVar[tuple[str, ...]] = ("downscale",)
    """Fields whose value may be None, which `planned` decides before a run begins."""

    data: Path | None = None
    """Scene folder, which must be named; `garden` is the embedded one."""
    up: tuple[float, float, float] | None = None
    """Direction that points up in the capture's own axes; none = as its format says, else as its cameras are held, or
    against the view of those that look down. Suns, shadows and north count from it; a line says where it is a guess.
    """
    output: Path | None = None
    """Run folder; by default runs/SCENE-METHOD. A folder with a run in it is resumed."""
    downscale: int | float | None = None
    """Factor, at least 1, by which the delivered images are reduced; none = found from their size and number,
    the rays of the training and the device (docs/formats.md), and saved with the run.
    """
    steps: int | None = 30_000
    """Optimiser steps; none only where a kind of scene says for itself how many."""
    minutes: float | None = None
    """Wall-clock limit, features included; the schedule ends with whichever comes first, steps or minutes."""
    seed: int = 0
    """Every draw is a function of it."""
    checkpoint_minutes: float = 5.0
    """Time between checkpoints."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.downscale is not None:
            at_least("downscale", self.downscale, 1)
        if self.steps is not None:
            at_least("steps", self.steps, 0)
        between("seed", self.seed, 0, 2**31 - 1)
        if self.minutes is not None:
            positive("minutes", self.minutes)
        positive("checkpoint_minutes", self.checkpoint_minutes)

    def build(
        self,
        scene: "ParsedScene",
        device: "torch.device",
        *,
        saved: "Facts | None" = None,
        progress: Callable[[int, int, str], None] | None = None,
    ) -> "SceneLearner | Partition":
        """Build what learns a scene, with its images read; imports its implementation.

        `saved` are the facts of a run that goes on: nothing that was measured for them is measured again.
        `progress` is told `(done, total, what)` of what takes long.
        """
        raise ConfigError(
            f"{type(self).__name__} does not say how it is trained; its method has to give a config that does"
        )

    def compile_kernels(self, device: "torch.device", say: Callable[[str], None]) -> None:
        """Compile what training needs compiled once after installation, before its time is counted.

        `say` is told one line where that takes long. Here there is nothing to compile.
        """

    @property
    def reading(self) -> Reading:
        """Reading of the capture, and the device that it is trained on."""
        return Reading()

    def limited(self, views: int) -> int:
        """Optimiser steps on so many training views."""
        assert self.steps is not None
        return self.steps

    def planned(self, scene: "ParsedScene", device: "torch.device") -> "RunConfig":
        """The config with what it leaves open decided, from a scene at its own size and the device that will
        train.

        Here images are reduced until none has more pixels than 640 x 360.
        """
        if self.downscale is not None:
            return self
        largest = int(scene.cameras.size.prod(1).max())
        return replace(self, downscale=max(1, math.ceil(math.sqrt(largest / _MAX_IMAGE_PIXELS))))

    def calibrated(self, scene: "ParsedScene") -> "ParsedScene":
        """The scene with what a planned config corrects in its cameras; here as it is."""
        return scene

    def described(self) -> str:
        """Describe the plan beyond the views and their size, for the line that is shown before training."""
        return ""

    def changeable(self, before: "RunConfig") -> tuple[str, ...]:
        """Fields that may differ from those that a run was begun with when it goes on."""
        return RESUMABLE

    def needs(self) -> list[Need]:
        """Packages and weights that training needs and that are not here, each opened by the path of its
        slot.

        Raises PluginError where a plug-in cannot say what it needs.
        """
        missing = []
        for slot in slots(self):
            try:
                needs = () if slot.value is None else tuple(slot.value.needs())
            except Exception as error:  # a stranger's
                raise PluginError(
                    f"{slot.path}: cannot say what it needs ({type(error).__name__}: {error})"
                ) from error
            missing += [need._replace(what=f"{slot.path}: {need.what}") for need in needs]
        return missing
