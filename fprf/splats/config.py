"""Configs of runs of 3D Gaussians and of views of a capture, and which files are captures by name. Imports no
torch.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

from ..blocks.config import LayoutConfig, SingleConfig
from ..checks import at_least, between, positive
from ..datamanagers.parsers.config import DataParserConfig
from ..errors import ConfigError
from ..plugins.conversion import convert_fields
from ..plugins.encoders.config import SEMANTICS, EncoderConfig
from ..plugins.executors.config import ExecutorConfig, SerialConfig
from ..run_config import RESUMABLE, Reading, RunConfig

if TYPE_CHECKING:
    import torch

    from ..datamanagers.scene import ParsedScene
    from ..scenes import Partition, SceneLearner
    from ..training.facts import Facts

_DEFAULT_CAP = 60_000
"""Gaussians where neither the user nor a plan says how many: those of a minute (`plan`)."""
_DEFAULT_PASSES = 280
"""Passes over the photographs where neither says how many; by eye, for photographs of 640 x 360 pixels."""
_DEFAULT_STEPS = 10_000
"""Steps where neither they nor minutes are given; by eye."""
_MAX_TIMED_STEPS = 100_000
"""Steps where minutes are given: more than there is time for."""


UNTRAINED = ("semantic", "regions", "semantic_size", "executor")
"""Fields of `GaussiansConfig` that nothing which is trained depends on."""


@dataclass(frozen=True, kw_only=True)
class GaussianSemanticsConfig:
    """Semantics of Gaussians: features of rendered views, carried back to what they show. Nothing is trained
    for them.
    """

    encoder: EncoderConfig = SEMANTICS
    """Encoder whose features find the fitting reference."""


@dataclass(frozen=True, kw_only=True)
class LookConfig:
    """Views of a capture, from which its regions and statistics are found."""

    up: tuple[float, float, float] | None = None
    """Direction that points up in the capture's own axes; none = as the file says, else away from its ground,
    else 0 -1 0: most captures have y down. One line says which.
    """
    north: tuple[float, float, float] | None = None
    """Direction of north in the capture's own axes; none = as the file says, else not known: azimuths of suns count
    from the direction of the first view.
    """
    inside: bool | None = None
    """Look from within, as in rooms and streets, or around an object; none = found out."""
    views: int = 32
    """Views that are looked at."""
    size: tuple[int, int] = (320, 240)
    """Their width and height in pixels."""
    regions: int = 16
    """Semantic regions of the scene, at least 1."""
    activated: bool = False
    """Read opacities all in [0, 1] as such, not as logits, sizes that are all positive as such, not as
    logarithms, and colours in [0, 1] or [0, 255] in the place of harmonics. One line says where a capture
    looks so.
    """
    semantic: GaussianSemanticsConfig = GaussianSemanticsConfig()
    """Semantics."""

    def __post_init__(self) -> None:
        convert_fields(self)
        at_least("views", self.views, 1)
        at_least("regions", self.regions, 1)
        at_least("size", min(self.size), 32)


@dataclass(frozen=True, kw_only=True)
class GaussiansConfig(RunConfig):
    """3D Gaussians, trained from photographs."""

    kind: ClassVar[str] = "gaussians"
    open: ClassVar[tuple[str, ...]] = ("downscale", "cap", "passes", "k1")

    device: str = "auto"
    """cpu, cuda, or auto. On CUDA they are trained where gsplat is installed (`pip install 'fprf[cuda]'`),
    else on the CPU.
    """
    steps: int | None = None
    """Optimiser steps: one view each. none = 10 000, or with minutes as many as there is time for."""
    passes: int | None = None
    """Passes over the training views at most, whatever `steps` and `minutes` say: more of them learn few
    photographs by heart. Not in cells. none = 280, and more for photographs of more than 640 x 360 pixels.
    """
    parser: DataParserConfig | None = None
    """Format of the scene folder; none = recognised from what lies in it."""
    masks: bool = True
    """Leave out, in training and metrics, what the capture's masks name (`masks/` beside the images, or
    `mask_path`).
    """
    tones: bool | None = None
    """Learn how bright and how coloured each view was taken, starting from its exposure; the scene is what
    they have in common. none = where exposures differ, as the capture says or as its sparse points show.
    """
    poses: float | None = None
    """Refine the cameras' poses with the scene: how far a view may move whenever it is seen, in radians and
    in distances that views commonly see. It falls to a tenth. 0 = they are as the capture says, 0.002 suits
    poses that are off by some pixels. none = 0.0005 where a trial finds, by pixels that it left out, that
    poses are off; never in cells.
    """
    k1: float | None = None
    """Radial distortion of views that come without a lens, within 0.3 of 0: tangents r from the axis are shown at
    r (1 + k1 r²). none = that with which features matched between posed views lie on their epipolar lines, where it
    clearly fits better than none.
    """
    initial: int = 40_000
    """Gaussians at the start, at most: the reconstruction's points, else points matched between the posed
    views.
    """
    surroundings: int = 500
    """Further Gaussians on a distant sphere at the start: they hold sky, and fill what no photograph shows.
    Only cells split them. At most a tenth of `cap`; 0 = none.
    """
    cap: int | None = None
    """Gaussians at the end, at most; none = by the minutes and this machine's speed, and saved with the
    run.
    """
    longest: int = 1600
    """Longest side in pixels, at most, to which photographs are reduced where `downscale` is not given. Where
    the minutes are too few for that size they are reduced further.
    """
    pixels_per_gaussian: int = 20
    """Pixels of all training views for each Gaussian, at least: few photographs get fewer Gaussians. Not in
    cells.
    """
    degree: int = 2
    """Degree of the harmonics of view-dependent colours, 0 to 3."""
    ssim: float = 0.2
    """Share of 1 - SSIM in the loss; the rest is the absolute error."""
    coarse: float = 0.6
    """Share of training that sees the photographs reduced: at half their size, large ones at less in the
    first third of it.
    """
    grow: float = 0.6
    """Share of training within which the number grows to `cap`."""
    relocate_every: int = 100
    """Steps between moves of transparent Gaussians to where views err."""
    rate: float = 1.0
    """Factor of all learning rates."""
    cells: LayoutConfig = SingleConfig()
    """Layout of the cells that the scene is cut into: parts of space that are trained apart, each with a part of
    the time and of the Gaussians. They need points of a reconstruction.
    """
    overview: float = 0.9
    """Share of steps and minutes in which the whole scene is trained at half the size before its cells go on
    from there.
    """
    executor: ExecutorConfig = SerialConfig()
    """Executor that trains cells: one after the other, or several at a time."""
    semantic: GaussianSemanticsConfig = GaussianSemanticsConfig()
    """Semantics; another encoder needs no training anew."""
    regions: int = 24
    """Semantic regions of the scene (with 16, 24, 32 of them 89, 91, 91 % of the town's pixels take from the
    right class).
    """
    semantic_size: int = 240
    """Longest side in pixels, at most, of the views that semantics are found in and of references as they are
    encoded: at 240 the bundled encoder tells things apart best (docs/gaussians.md).
    """
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Colour behind everything, also where images have transparency. Where none has, each step of training has
    another one behind, so that dark surfaces become opaque.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("initial", "pixels_per_gaussian", "regions", "relocate_every"):
            at_least(name, getattr(self, name), 1)
        for name in ("cap", "passes"):
            if (value := getattr(self, name)) is not None:
                at_least(name, value, 1)
        at_least("longest", self.longest, 32)
        at_least("surroundings", self.surroundings, 0)
        at_least("semantic_size", self.semantic_size, 32)
        if self.degree not in range(4):
            raise ConfigError(f"degree: {self.degree}; 0, 1, 2 or 3 are possible")
        for name in ("grow", "overview", "rate"):
            positive(name, getattr(self, name))
        for name in ("ssim", "coarse", "grow"):
            between(name, getattr(self, name), 0.0, 1.0)
        if self.poses is not None:
            between("poses", self.poses, 0.0, 1.0)
        if self.k1 is not None:
            between("k1", self.k1, -0.3, 0.3)
        between("overview", self.overview, 0.0, 0.9)
        for part in self.background:
            between("background", part, 0.0, 1.0)

    def build(
        self,
        scene: "ParsedScene",
        device: "torch.device",
        *,
        saved: "Facts | None" = None,
        progress: Callable[[int, int, str], None] | None = None,
    ) -> "SceneLearner | Partition":
        """Read the photographs and find the first points; cells where there are to be some."""
        from .setup import build

        if not self.cells.cuts:
            return build(self, scene, saved, device=device)
        from ..blocks.windows import cut_into_windows
        from .cells import Cells

        cells = cut_into_windows(scene, self.cells)
        if len(cells) == 1:
            return build(replace(self, cells=SingleConfig()), scene, saved, device=device)
        return Cells(self, scene, cells, saved, device=device)

    def compile_kernels(self, device: "torch.device", say: Callable[[str], None]) -> None:
        """gsplat's kernels for a CUDA device, or those of the CPU."""
        from .plan import compile_kernels

        compile_kernels(device, (self.degree + 1) ** 2, say)

    def planned(self, scene: "ParsedScene", device: "torch.device") -> "GaussiansConfig":
        """Size and number of Gaussians, as `splats.plan` finds them."""
        from .plan import plan

        return plan(self, scene, device)

    def calibrated(self, scene: "ParsedScene") -> "ParsedScene":
        """With `k1` in the views that come without a lens."""
        from .lens_estimate import with_k1

        return replace(scene, cameras=with_k1(scene.cameras, self.k1 or 0.0))

    @property
    def may_refine(self) -> bool:
        """True where poses are refined, or a trial may say so."""
        if self.poses is None:
            return not self.cells.cuts
        return self.poses > 0

    @property
    def most(self) -> int:
        """`cap`; where neither the user nor a plan has said it, 60 000."""
        return self.cap or _DEFAULT_CAP

    @property
    def most_passes(self) -> int:
        """`passes`; where neither the user nor a plan has said it, 280."""
        return self.passes or _DEFAULT_PASSES

    @property
    def most_steps(self) -> int:
        """`steps`; where they are not given, 10 000, or 100 000 where minutes are."""
        if self.steps is not None:
            return self.steps
        if self.minutes is None:
            return _DEFAULT_STEPS
        return _MAX_TIMED_STEPS

    @property
    def reading(self) -> Reading:
        return Reading(self.device, self.parser, self.masks)

    def changeable(self, before: RunConfig) -> tuple[str, ...]:
        """The same, and all that nothing which is trained depends on."""
        return *RESUMABLE, *UNTRAINED

    def limited(self, views: int) -> int:
        """At most so many passes over them."""
        return min(self.most_steps, self.most_passes * views)

    def described(self) -> str:
        lens = f", a lens with k1 {self.k1:.4f}" if self.k1 else ""
        return f", up to {self.most:,} Gaussians{lens}"
