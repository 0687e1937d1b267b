"""Interfaces of plug-ins: one abstract class a kind, with shapes. The one file that a plug-in author
reads, but for kinds of scenes.

A plug-in is built by its config's `build(...)`; configs live in the `config.py` next to the built-ins and
import no torch. A contract in `fprf.testing` checks an implementation, and fails with one sentence:

    kind        class            from -> to                                  contract
    images      Encoder          [B 3 H W] -> [B C h w]                      check_encoder
    fields      ContentField     [N 3] -> density [N], content [M C]         check_content_field
                SemanticField    [N 3] -> [N D]                              check_semantic_field
                Sampler          rays -> edges [R E]                         check_sampler
                Decoder          content [N C] -> colours [N 3]              check_decoder
                LossTerm         render, batch -> scalar                     check_loss_term
    styles      Stylizer         content [N C], semantic [N D] -> [N C]      check_stylizer
    photographs DataParser       folder -> scene                             check_parser
                DataManager      step -> batch of R pixels                   check_data_manager
    scale       BlockLayout      site -> cells                               check_layout
                Executor         tasks -> results                            check_executor
    Gaussians   CaptureFormat    bytes <-> Gaussians                         check_capture_format
    scenes      Scene, SceneView, SceneLearner, Partition: a kind of scene, built by `RunConfig.build`

`CaptureFormat` is in `fprf/splats/files/base.py`, since it speaks of Gaussians, what makes a kind of scene in
`fprf/scenes.py`, since it speaks of runs and looks; all others are below. To add

    a stylizer           its config in `fprf/plugins/stylizers/config.py`, its class in a file beside; group fprf.stylizers
    a file format        one file in `fprf/splats/files`, a `CaptureFormat`; group fprf.captures
    a kind of scene      a `RunConfig` (`fprf/run_config.py`) and what `fprf/scenes.py` names; groups fprf.methods and
                         fprf.scenes. `tests/test_scene_plugin.py` is a whole one

and an entry point in the named group of `pyproject.toml`, where each group has a line that says the same.

    letter  axis                 letter  axis                 letter  axis
    B       images               C       content channels     T       style codes
    N M     points               D       semantic channels    K       regions of the scene
    R E     rays, edges          L       latent channels      H W     pixels; h w cells of features

Tensors are float32 unless their inputs are of another type; device and type of results follow the inputs. A
function of points treats each alone: the same in any batch, and of none none.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from .types import Batch, Cell, FieldSample, Rays, Rendered, Sampled, Site, Want

if TYPE_CHECKING:
    from .datamanagers.features import FeatureStore
    from .datamanagers.scene import ParsedScene
    from .rendering.space import Space

Task = TypeVar("Task")
Result = TypeVar("Result")


class Encoder(nn.Module, ABC):
    """Images to features. Frozen; deterministic; normalises its input itself; may be called by several
    threads at once.

    Takes images of any size from one pixel on, and keeps their aspect; features of an image do not depend on
    its batch.
    """

    @property
    @abstractmethod
    def identity(self) -> str:
        """Identity of an encoder: name, layer, settings and a hash of the weights. Keys caches and
        decoders.
        """

    @property
    @abstractmethod
    def channels(self) -> int:
        """Channels of the features."""

    @abstractmethod
    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B C h w"]:
        """Features of sRGB images in [0, 1], aligned to the whole image: cell (i, j) covers its h-th and w-th
        part.
        """

    def cutout(
        self, image: Annotated[Tensor, "B 3 H W"], opacity: Annotated[Tensor, "B H W"]
    ) -> Annotated[Tensor, "B C h w"]:
        """Features of what images show that are transparent in places; colours are premultiplied by the
        opacity in [0, 1].

        This mean over a white and a black backdrop serves any encoder: neither alone decides what a single
        thing is. Override it where an encoder can leave the backdrop out. Cells that show nothing may hold
        anything finite.
        """
        behind = 1 - opacity[:, None]
        features: Tensor = self((image + behind).clamp(0, 1))
        # Where less than 1/200 shows through, both backdrops give one picture, and encoders take most of the
        # time.
        if float(behind.mean((1, 2, 3)).amax()) > 0.005:
            features = (features + self(image.clamp(0, 1))) / 2
        return features


class Regularised(nn.Module, ABC):
    """A network with penalties on its own parameters."""

    @abstractmethod
    def penalties(self) -> dict[str, Tensor]:
        """Regularisers by name, each a scalar, the same names at each call.

        The weights of 'variation' and 'proposal_variation' are `loss.variation` and
        `loss.proposal_variation`; any other name has weight 1 unless `loss.penalties` names it, so the scalar
        should include its own weight. One name in several parts is added up.
        """


class ContentField(Regularised):
    """Points to density and content features (paper, scene content field). Stateless between calls.

    Every parameter has a gradient, through the density or the content, and is drawn from the seed of `build`
    alone.
    """

    @abstractmethod
    def density(self, points: Annotated[Tensor, "N 3"]) -> FieldSample:
        """Density per space unit, at least 0, and a latent [N L] for `content`, at points of the unit cube
        [-1, 1]^3.
        """

    @abstractmethod
    def content(
        self, latent: Annotated[Tensor, "M L"], view: Annotated[Tensor, "M 3"]
    ) -> Annotated[Tensor, "M C"]:
        """Content features of some of the points, by their latents and unit viewing directions."""

    def colour(
        self, latent: Annotated[Tensor, "M L"], view: Annotated[Tensor, "M 3"], decoder: "Decoder"
    ) -> Annotated[Tensor, "M 3"]:
        """sRGB in [0, 1] of these points as they are: their content, decoded.

        Asked where nobody needs the content itself; a field may join its last linear map with the first of
        the decoder.
        """
        rgb: Tensor = decoder(self.content(latent, view))
        return rgb


class SemanticField(Regularised):
    """Points to semantic features, without direction (paper, scene semantic field). Never moves density."""

    @abstractmethod
    def forward(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N D"]:
        """Semantic features at points of the unit cube."""


class Sampler(Regularised):
    """Rays to sample edges. May own proposal fields, which live in the unit cube: `space.locate` leads
    there.
    """

    @property
    def fields(self) -> nn.ModuleList:
        """The fields that `forward` asks for density, points of the unit cube [N 3] to [N]; none unless it
        says so.

        A scene of blocks puts others in their place, which route points to the blocks' own.
        """
        return nn.ModuleList()

    @abstractmethod
    def forward(
        self, rays: Rays, *, space: "Space", step: int | None, generator: torch.Generator | None
    ) -> Sampled:
        """Edges `s` in [0, 1] and `t` in [near, far] of each ray, [R E] with E >= 2, sorted; t =
        space.distance(s, near, far).

        `step` is that of the training, None in a view. A function of rays, step and generator; None =
        deterministic.
        """


class Decoder(nn.Module, ABC):
    """Content features to colour, point by point (paper, D_VGG): those of the scene as it is, and those of a
    style.

    `build` returns parameters that all scenes share with `requires_grad` False; those with `requires_grad`
    True belong to one scene, are trained with it and are saved in its checkpoints.
    """

    @abstractmethod
    def forward(self, content: Annotated[Tensor, "N C"]) -> Annotated[Tensor, "N 3"]:
        """sRGB in [0, 1], for any features."""

    @property
    def layers(self) -> "Sequence[tuple[Annotated[Tensor, 'O I'], Annotated[Tensor, 'O'] | None]] | None":
        """Weights and biases of linear maps with ReLU between them and a sigmoid behind, where that is all that
        `forward` does; None = it is more.
        """
        return None


class Stylizer(nn.Module, ABC):
    """Content features to stylised content features, point by point. Knows nothing of rays.

    On Gaussians the content is the colour, C = 3, and a style is one affine map of colours for each of them,
    which acts on their harmonics. It is found from what becomes of black and of each channel alone, so either
    `forward` is affine in content where semantics are given, f(a x + (1 - a) y) = a f(x) + (1 - a) f(y), or
    the config has `colours` above 0, which carries the colours of each region over in the place of it
    (`splats.restyle`).
    """

    @property
    @abstractmethod
    def needs(self) -> Want:
        """`Want.CONTENT`, with `Want.SEMANTIC` if it reads semantic features."""

    @abstractmethod
    def forward(
        self, content: Annotated[Tensor, "N C"], semantic: Annotated[Tensor, "N D"] | None
    ) -> Annotated[Tensor, "N C"]:
        """The features in the new style, at full strength. `semantic` is None unless `needs` asks for it."""

    def shared(
        self, content: Annotated[Tensor, "N C"], semantic: Annotated[Tensor, "N D"] | None
    ) -> tuple[Annotated[Tensor, "N C"], Annotated[Tensor, "N K"] | None]:
        """`forward`, and the points' shares of the scene's regions (`style.scene_style.Membership`), if it
        has found them.

        What follows, such as strengths and colours by region, then need not find them again.
        """
        return self(content, semantic), None

    @abstractmethod
    def match(self, semantic: Annotated[Tensor, "N D"]) -> Annotated[Tensor, "N T"]:
        """Attention of each point to each style code, at least 0; rows sum to 1."""

    def region_match(self, keys: Annotated[Tensor, "K D"]) -> Annotated[Tensor, "K T"]:
        """Share of each style code in each of the scene's regions, whose mean semantics are `keys`; rows sum
        to 1.

        A stylizer that mixes regions point by point returns what it mixes: `match` of the keys, which lie in
        several regions, is mixed already.
        """
        return self.match(keys)


class State(NamedTuple):
    """The tensors of a checkpoint."""

    model: Mapping[str, Tensor]
    """All that a render needs."""
    optimizer: Mapping[str, Tensor]
    """State for further steps alone: moments, counts."""


class Figures(NamedTuple):
    """Measurements of the last steps of a learner."""

    means: Mapping[str, float]
    """Running means of the loss terms by name; `rgb` is the mean squared error of colours in [0, 1]."""
    rays: int
    """Pixels that it has learnt from since it was built."""
    skipped: int = 0
    """Steps since it was built that changed nothing, because their loss or gradients were not finite."""
    failed: int = 0
    """The last ones of these in a row."""
    fault: str = ""
    """Names of what was not finite since the figures were last read; empty where nothing was."""
    kept: float = 1.0
    """Share of the samples along rays that met the content network."""


class Learner(ABC):
    """Anything that is learnt step by step; `training.driver.learn` does the rest.

    Every draw is a function of (seed, index), so that `state` and the number of steps are all that a resumed
    training needs.
    """

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """Device of its parameters. On the CPU figures are read after each step; elsewhere twice a second,
        since the host waits for the device.
        """

    @abstractmethod
    def step(self, index: int, share: float) -> None:
        """Take one optimiser step, the `index`-th, when a `share` of the schedule in [0, 1) is over.

        A step whose loss or gradients are not finite changes nothing but `figures`.
        """

    @abstractmethod
    def figures(self) -> Figures:
        """Measurements of the last steps; the host may wait for the device."""

    @abstractmethod
    def state(self) -> State:
        """Everything that was learnt."""

    @abstractmethod
    def load(self, state: State) -> None:
        """Go on from a `state`. Raises CheckpointError where it is that of another config."""


class Parts(NamedTuple):
    """Modules that a scene is rendered with."""

    space: "Space"
    sampler: Sampler
    field: ContentField
    semantic: SemanticField | None
    decoder: Decoder


class LossTerm(ABC):
    """A training term beside the built-in ones. Without parameters: nothing of it is saved.

    It runs in every step: nothing in it may wait for the device (no `.item()`, no `bool` of a tensor).
    """

    @property
    @abstractmethod
    def needs(self) -> Want:
        """Outputs of the renderer that it needs; `Want.DENSITY` where weights and sample edges are enough."""

    @abstractmethod
    def __call__(
        self,
        rendered: Rendered,
        batch: Batch,
        parts: Parts,
        *,
        step: int,
        generator: torch.Generator | None,
    ) -> Tensor:
        """The unweighted term, a scalar: by convention a mean over the rays.

        Gradients go through `weights` [R S] of `rendered`, its colour and its features, not through depth and
        opacity. `semantic`, and targets of the batch, are None where the scene or the method has none.
        `parts` are the scene's space and networks. Draws come from the generator of the step; None =
        deterministic.
        """


class BlockLayout(ABC):
    """Division of a scene into blocks of fields or cells of Gaussians: geometry only, no parameters."""

    @abstractmethod
    def cut(self, site: Site) -> list[Cell]:
        """At least one cell in the frame of the site, all with one border; one alone means that the scene is
        not cut.

        What no cell holds stays as the whole scene has it. Outer cells may have no end. Raises ConfigError where
        the site allows no such cells, in words that go on after the scene's name.
        """


class DataParser(ABC):
    """A scene folder to a `datamanagers.scene.ParsedScene`. Decodes no image."""

    @abstractmethod
    def parse(self, data: Path, downscale: float) -> "ParsedScene":
        """The scene at 1/downscale of the delivered size. Raises DataError with file, finding and remedy."""


class DataManager(ABC):
    """Training batches and views of one scene."""

    content_store: "FeatureStore | None"
    """Targets of the content field: their channels and the unit of their loss; None where nobody asked."""
    semantic_store: "FeatureStore | None"
    """Targets of the semantic field, with the basis that they are expressed in."""

    @abstractmethod
    def batch(self, step: int) -> Batch:
        """The pixels of a step: a pure function of (seed, step), so that a resumed run sees the same ones.

        In host memory, or on the device of `to`. For an accelerator those in host memory are drawn by another
        thread, one step ahead.
        """

    def to(self, device: torch.device, *, room: int) -> "DataManager":
        """A data manager of the same batches that draws them on a device, from at most `room` bytes held
        there.

        By default itself, which draws in host memory.
        """
        return self

    @abstractmethod
    def image(self, view: int) -> Annotated[Tensor, "H W 3"]:
        """One view as a float image in [0, 1]."""


class Executor(ABC):
    """Runs independent tasks (blocks, frames), here or on many machines."""

    @abstractmethod
    def map(self, function: Callable[[Task], Result], tasks: Sequence[Task]) -> list[Result]:
        """Results in the order of the tasks."""
