"""The config of a run of fields. Imports no torch: help and parsing stay fast."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal, NamedTuple

from .blocks.config import LayoutConfig, SingleConfig
from .checks import at_least, between, positive
from .datamanagers.config import DataManagerConfig, RayBatchesConfig
from .errors import ConfigError, UsageError, WeightsError
from .fields.config import ContentFieldConfig, PlanesConfig, SemanticFieldConfig, SemanticPlanesConfig
from .plugins.config import Need
from .plugins.decoders.config import DecoderConfig, MlpDecoderConfig, pretrain_line
from .plugins.encoders.config import SEMANTICS, EncoderConfig, Vgg19Config
from .plugins.executors.config import ExecutorConfig, SerialConfig
from .plugins.losses.config import LossTermConfig
from .plugins.samplers.config import ProposalConfig, SamplerConfig
from .run_config import RESUMABLE, Reading, RunConfig

if TYPE_CHECKING:
    import torch

    from .datamanagers.scene import ParsedScene
    from .scenes import Partition, SceneLearner
    from .training.facts import Facts


@dataclass(frozen=True, kw_only=True)
class ContentConfig:
    """The content field: what it learns, and what turns that into colour."""

    encoder: EncoderConfig = Vgg19Config()
    """Encoder whose features carry content and style."""
    field: ContentFieldConfig = PlanesConfig()
    """Representation of density and content."""
    decoder: DecoderConfig = MlpDecoderConfig()
    """Frozen decoder from content features to colour."""
    moves_density: bool = True
    """Let the feature loss also move density, as in the paper; without, colour alone decides the geometry."""


@dataclass(frozen=True, kw_only=True)
class SemanticConfig:
    """The semantic field: what finds the fitting reference."""

    encoder: EncoderConfig | None = SEMANTICS
    """Encoder whose features the semantic field learns; none = no semantics, global styles alone."""
    field: SemanticFieldConfig = SemanticPlanesConfig()
    """Representation of the semantics."""
    dim: int = 64
    """Principal components of the encoder's features that are kept (all, if the encoder has fewer)."""
    samples: int = 48
    """Heaviest samples of a ray that carry semantics in training."""

    def __post_init__(self) -> None:
        at_least("semantic.dim", self.dim, 1)
        at_least("semantic.samples", self.samples, 1)


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """Weights of the training terms (means over the batch); a term of weight 0 is never computed."""

    rgb: float = 1.0
    """Squared error of the colour."""
    content: float = 0.01
    """Squared error of the rendered content features, in units of their variance."""
    semantic: float = 0.1
    """Absolute error of the rendered semantic features, in units of their standard deviation."""
    variation: float = 1e-4
    """Total variation of the content planes."""
    proposal_variation: float = 1e-4
    """Total variation of the proposal planes."""
    penalties: tuple[tuple[str, float], ...] = ()
    """Names and weights of other penalties of fields and samplers; those that are not named have weight 1."""
    penalty_every: int = 1
    """Steps between penalties, which then weigh as many times more."""
    interlevel: float = 1.0
    """Proposals must bound the field's weights from above."""
    distortion: float = 1e-3
    """Weights should gather at one place along a ray."""
    depth: float = 0.1
    """Rays through points of the reconstruction should end there (where `datamanager.depth_share` draws such
    rays). It falls to a hundredth in the course of training.
    """
    sky: float = 0.1
    """Rays into the sky should meet nothing before it (where the capture has masks of its sky)."""
    extra: LossTermConfig | None = None
    """A loss term of an installed package, by name."""

    def __post_init__(self) -> None:
        weights = (
            "rgb",
            "content",
            "semantic",
            "variation",
            "proposal_variation",
            "interlevel",
            "distortion",
            "depth",
            "sky",
        )
        for name in weights:
            at_least(f"loss.{name}", getattr(self, name), 0.0)
        names = []
        for name, _ in self.penalties:
            names.append(name)
        for name, weight in self.penalties:
            if name in ("variation", "proposal_variation"):
                raise ConfigError(f"loss.penalties: {name} has a field of its own; set loss.{name}")
            if names.count(name) > 1:
                raise ConfigError(f"loss.penalties: {name} is named twice; name it once")
            at_least(f"loss.penalties: {name}", weight, 0.0)
        at_least("loss.penalty_every", self.penalty_every, 1)
        if self.rgb == self.content == self.semantic == 0:
            raise ConfigError(
                "loss: rgb, content and semantic are all 0, so nothing would be learnt; raise one of them"
            )


@dataclass(frozen=True, kw_only=True)
class OptimizerConfig:
    """Adam with linear warm-up and cosine decay."""

    rate: float = 1e-2
    """Learning rate at its height."""
    final: float = 0.01
    """Share of the rate that is left at the end."""
    warm_up: int = 512
    """Steps of linear warm-up."""
    hold: int | None = None
    """Step from which the rate also falls as 1 / sqrt(step); none = only the cosine. Keeps long runs of small
    batches stable.
    """
    beta2: float = 0.99
    """Decay of the squared-gradient average."""
    eps: float = 1e-12
    """Keeps the step finite where the gradient vanishes."""

    def __post_init__(self) -> None:
        positive("optimizer.rate", self.rate)
        if self.hold is not None:
            at_least("optimizer.hold", self.hold, 1)
        between("optimizer.final", self.final, 0.0, 1.0)
        between("optimizer.beta2", self.beta2, 0.0, 1.0)
        positive("optimizer.eps", self.eps)


@dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """Rendering: from samples to pixels, and what may be skipped."""

    budget: float = 1 / 512
    """Largest weight per ray that may be dropped when rendering; bounds the colour error (0 = exact)."""
    train_budget: float = 1 / 512
    """The same bound while training."""
    resolution: float = 1.0
    """Share of an image's width and height that is rendered, in (0, 1]; what lies between is interpolated."""
    chunk: int = 8192
    """Rays rendered at a time on the CPU; an accelerator takes as many as half of its free memory holds, but
    no fewer.
    """
    background: tuple[float, float, float] | None = None
    """Colour behind everything; none = white where images have transparency, else nothing is assumed."""
    tone: tuple[float, float, float] | None = None
    """Factors that rendered red, green and blue are multiplied by; none = the scene as its views have it in
    common. `--tone` of a view says them where they were learnt.
    """

    def __post_init__(self) -> None:
        between("render.budget", self.budget, 0.0, 0.5)
        between("render.train_budget", self.train_budget, 0.0, 0.5)
        positive("render.resolution", self.resolution)
        between("render.resolution", self.resolution, 0.0, 1.0)
        at_least("render.chunk", self.chunk, 1)
        for part in self.tone or ():
            positive("render.tone", part)
        for part in self.background or ():
            between("render.background", part, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class StatisticsConfig:
    """The exact pass over the trained scene that styles build on."""

    rays: int = 65536
    """Rays, spread evenly over the training views."""
    regions: int = 16
    """Scene codes: clusters of the scene's own semantics."""

    def __post_init__(self) -> None:
        at_least("statistics.rays", self.rays, 64)
        at_least("statistics.regions", self.regions, 1)


FREE_IN_BLOCKS = (*RESUMABLE, "blocks", "executor", "statistics", "render")
"""Fields of a config that do not decide what a block of given bounds and rays learns."""


class _Pace(NamedTuple):
    """Speed of a kind of device at training fields, within a factor of two."""

    rays: float
    """Rays trained in a second by `fprf-lite`."""
    features: float
    """Seconds that the features of a million pixels take."""
    least: float
    """Pixels of an image that are trained on however few rays there are."""


_CPU_PACE = _Pace(rays=20e3, features=4.0, least=0.2e6)
"""Of two cores, by eye."""
_ACCELERATOR_PACE = _Pace(rays=1e6, features=0.2, least=1e6)
"""Of one GPU, by eye."""
PASSES = 4
"""Rays that larger images must leave for each of their pixels; by eye."""
_FEATURE_SHARE = 0.5
"""Share of a time limit that features may take before images are reduced below `least`, to a quarter of it at
most.
"""


@dataclass(frozen=True, kw_only=True)
class TrainConfig(RunConfig):
    """Everything that decides a run of fields."""

    kind: ClassVar[str] = "fields"

    steps: int = 30_000
    """Optimiser steps."""
    device: str = "auto"
    """cpu, cuda, mps, or auto."""
    device_memory: float = 0.5
    """Share of a GPU's free memory that images and feature targets may take in training; where they need more
    they stay in host memory, and each batch is copied one step ahead.
    """
    precision: Literal["float32", "tf32"] = "float32"
    """Of matrix products on CUDA in training: tf32 rounds their factors to 11 bits. docs/measurements.md has
    the error.
    """
    datamanager: DataManagerConfig = RayBatchesConfig()
    """Feeds training."""
    sampler: SamplerConfig = ProposalConfig()
    """Places samples along rays."""
    content: ContentConfig = ContentConfig()
    """Geometry and appearance."""
    semantic: SemanticConfig = SemanticConfig()
    """Semantics."""
    blocks: LayoutConfig = SingleConfig()
    """Layout of the blocks that the scene is cut into."""
    executor: ExecutorConfig = SerialConfig()
    """Executor that trains the blocks."""
    loss: LossConfig = LossConfig()
    """Weights of the training terms."""
    optimizer: OptimizerConfig = OptimizerConfig()
    """Optimiser and learning rates."""
    tones: bool | None = None
    """Learn how bright and how coloured each view was taken, starting from its exposure; the scene is what
    they have in common. none = where exposures differ, as the capture says or as its sparse points show.
    """
    poses: float = 0.0
    """Refine the cameras' poses with the scene, at this share of the learning rate (in radians, and in
    distances that views commonly see); 0 = they are as the capture says, 0.02 suits poses that are off by
    some pixels.
    """
    render: RenderConfig = RenderConfig()
    """Rendering and skipping."""
    statistics: StatisticsConfig = StatisticsConfig()
    """Scene statistics for styling."""

    def __post_init__(self) -> None:
        super().__post_init__()
        between("device_memory", self.device_memory, 0.0, 1.0)
        between("poses", self.poses, 0.0, 1.0)

    def build(
        self,
        scene: "ParsedScene",
        device: "torch.device",
        *,
        saved: "Facts | None" = None,
        progress: Callable[[int, int, str], None] | None = None,
    ) -> "SceneLearner | Partition":
        """Extract the features and build the model; blocks where the scene is cut."""
        from .blocks.partition import make_plan
        from .training.blocks import Blocks
        from .training.field_learner import FieldLearner
        from .training.field_setup import prepare

        plan = None
        if self.blocks.cuts:
            plan = make_plan(scene, self.blocks)
        if plan is None or len(plan.cells) == 1:
            return FieldLearner(self, prepare(self, scene, saved, progress), device)
        # One basis and one unit of the losses, of all training views, so that features mean the same in each
        # block.
        prepared = prepare(self, scene, saved, progress, space=plan.space)
        return Blocks(self, scene, plan, prepared.facts, prepared.basis)

    @property
    def reading(self) -> Reading:
        return Reading(self.device, self.datamanager.parser, self.datamanager.masks)

    def planned(self, scene: "ParsedScene", device: "torch.device") -> "TrainConfig":
        """At the size at which training sees each pixel often enough, and at which features take no more than
        their time.

        From the mean of the training images: the square root of their pixels over those wanted, rounded to a
        whole factor, so that images up to 2.25 times as large as wanted stay as they are.
        """
        if self.downscale is not None:
            return self
        sizes = scene.cameras.size[scene.train]
        if not len(sizes):
            return replace(self, downscale=1)
        if device.type == "cpu":
            pace = _CPU_PACE
        else:
            pace = _ACCELERATOR_PACE
        rays = float(self.steps * self.datamanager.batch_rays())
        if self.minutes is not None:
            rays = min(rays, 60 * self.minutes * pace.rays)
        wanted = max(pace.least, rays / PASSES / len(sizes))
        if self.minutes is not None:
            encoded = 1e6 * _FEATURE_SHARE * 60 * self.minutes / pace.features / len(sizes)
            wanted = min(wanted, max(encoded, pace.least / 4))
        factor = round(math.sqrt(float(sizes.double().prod(1).mean()) / wanted))
        return replace(self, downscale=max(1, factor))

    def changeable(self, before: RunConfig) -> tuple[str, ...]:
        """The same; blocks may be cut anew: those that the cut does not concern are kept."""
        former = getattr(before, "blocks", None)
        anew = self.blocks.cuts and isinstance(former, LayoutConfig) and former.cuts
        return FREE_IN_BLOCKS if anew else RESUMABLE

    def needs(self) -> list[Need]:
        """The same, and a decoder for the content encoder, whose weights are read where both could be
        built.
        """
        missing = super().needs()
        if any(need.what.startswith(("content.encoder", "content.decoder")) for need in missing):
            return missing
        try:
            encoder = self.content.encoder.build()
            self.content.decoder.build(encoder=encoder.identity, channels=encoder.channels, seed=self.seed)
        except WeightsError as fault:
            missing.append(Need(f"content.decoder: {fault}", pretrain_line(self.content.encoder)))
        return missing


def fields_only(config: RunConfig, root: Path) -> TrainConfig:
    """The config of a run of fields. Raises UsageError, with the way out, where it is of another kind."""
    if isinstance(config, TrainConfig):
        return config
    raise UsageError(
        f"{root}: is of {config.kind}, and this is for runs of fields alone; `fprf stylize`, `gallery`, `render`, `eval` and "
        "`export` know all kinds"
    )
