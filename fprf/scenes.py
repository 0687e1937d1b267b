"""Interfaces of scenes: to be looked at (`Scene`, `SceneView`) and to be learnt (`SceneLearner`,
or `Partition` in parts).

A kind of scene is a `RunConfig` (`fprf/run_config.py`) whose `build` gives a SceneLearner, and a function that
opens its runs, as `open_fields` of `fprf/training/loading.py` does; entry points in the groups fprf.methods and
fprf.scenes. `tests/test_scene_plugin.py` is a whole one. What is made of points and images alone is in
`fprf/interfaces.py`, whose letters hold here as well.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, TypeAlias

import torch
from torch import Tensor

from .errors import UsageError
from .interfaces import Decoder, Learner
from .types import Origin, View

if TYPE_CHECKING:
    from .datamanagers.basis import Basis
    from .datamanagers.scene import ParsedScene
    from .progress import Display
    from .rendering.cameras import Cameras
    from .rendering.north import North
    from .splats.gaussians import GaussianRows
    from .style.dictionary import Encoders
    from .style.look import Restyle
    from .style.scene_style import SceneStyle
    from .training.facts import Facts
    from .training.run import Run

Values: TypeAlias = Callable[
    [Annotated[Tensor, "M D"], Annotated[Tensor, "M 3"] | None], Annotated[Tensor, "M X"]
]
"""Anything that follows from semantics, and from positions in the world where they are given."""


class SceneView(ABC):
    """One view of a scene, to be drawn in one look after the other; results are on the CPU."""

    @abstractmethod
    def restyled(self, restyle: "Restyle | None" = None) -> View:
        """The view in a look, or as it was captured."""

    @abstractmethod
    def paint(self, values: Values) -> Annotated[Tensor, "N X"]:
        """`Scene.paint` for all N pixels of the view, row after row; without the opacity."""

    @property
    def bytes(self) -> int:
        """Memory that it holds beside the scene's own."""
        return 0


class Scene(ABC):
    """A trained representation of any kind with its views: all that verbs, styles and viewers need of it.

    It is never changed: `restyled` returns another scene, which shares everything that a style does not
    touch. Views are rows of any `Cameras`; results are on the CPU.
    """

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of the scene's own views."""

    @property
    @abstractmethod
    def cameras(self) -> "Cameras":
        """The scene's own views."""

    @property
    def origin(self) -> Origin:
        """Of the local frame that its cameras are in: the capture's own coordinates less this (see
        `rendering.local_frame`).
        """
        return (0.0, 0.0, 0.0)

    @property
    def up(self) -> "tuple[float, float, float] | None":
        """Direction up in its world; None = as its cameras are held level."""
        return None

    @property
    def north(self) -> "North | None":
        """Direction of north in its world; None if nothing tells it."""
        return None

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """Device of its parameters, on which stylizers act."""

    @property
    @abstractmethod
    def semantic_encoder(self) -> str:
        """Identity of the encoder of its semantics; empty where it has none."""

    def gaussian_rows(self) -> "GaussianRows | None":
        """The Gaussians that it is made of, in its look, for files of them; None where it is made of
        something else.
        """
        return None

    @abstractmethod
    def render(self, cameras: "Cameras", view: int, *, resolution: float | None = None) -> View:
        """One view in the scene's look.

        `resolution` is the share of its width and height that is rendered, in (0, 1], before it is enlarged;
        None = as the scene is set.
        """

    @abstractmethod
    def paint(
        self,
        cameras: "Cameras",
        view: int,
        pixel: Annotated[Tensor, "R 2"],
        values: Values,
        *,
        semantic: bool = True,
    ) -> tuple[Annotated[Tensor, "R X"], Annotated[Tensor, "R"]]:
        """Composite anything that follows from semantics, such as shares of regions for a map: means over
        what each pixel sees, and the opacity.

        Pixels that see nothing get 0. `values` is given features without channels where the scene has no
        semantics or `semantic` is false, and positions where styles of this kind of scene may differ from
        place to place.
        """

    @abstractmethod
    def restyled(self, look: "Restyle | None") -> "Scene":
        """The scene in a look; None = as it was captured."""

    def as_taken(self, view: int) -> "Scene":
        """The scene in the light that one of its own views was taken in; itself where none was learnt."""
        return self

    def fit_poses(
        self, captured: "ParsedScene", views: Sequence[int], progress: Callable[[int, int, str], None]
    ) -> Annotated[Tensor, "V 6"]:
        """Turns (radians) and shifts (world units), float64, that bring renders of some views nearest to
        their photographs.

        `captured` has the photographs; those of all other views are 0. Raises UsageError where the scene
        cannot say.
        """
        raise UsageError("--fit-poses: this kind of scene fits no poses; leave it out")

    @property
    def light_notes(self) -> tuple[str, ...]:
        """Lines that say in what light the scene was captured, for a look that changes it; none otherwise."""
        return ()

    @property
    def counts(self) -> Mapping[str, int]:
        """Figures about the scene by name, for metrics.json."""
        return {}

    @abstractmethod
    def cached(self, cameras: "Cameras", view: int) -> SceneView:
        """One view; what no look changes is computed once, as far as that saves time."""

    @property
    @abstractmethod
    def decoder(self) -> Decoder | None:
        """Brings content features to colours; None where the content of the scene is its colours."""

    @abstractmethod
    def measured(self) -> "tuple[SceneStyle, Basis | None]":
        """Statistics and regions of the scene as it was captured, and the basis of its semantics (None
        without any).
        """

    @abstractmethod
    def encoders(self) -> "Encoders":
        """Encoders for references, in the terms of `measured`. Raises WeightsError where those at hand are
        others.
        """


class SceneLearner(Learner):
    """A scene that is being learnt, built by `RunConfig.build`; `training.driver.train` owns its run
    folder.
    """

    @property
    @abstractmethod
    def facts(self) -> "Facts":
        """Facts found before the first step, for scene.json."""

    def begin(self, run: "Run") -> str:
        """Write further files of the run before the first step; return a line about what will be learnt, or
        nothing.
        """
        return ""

    def finish(self, run: "Run", display: "Display") -> None:
        """Write further files of the run after the last step."""
        return


class Partition(ABC):
    """A scene that is trained in parts, each a task of its own: what `RunConfig.build` gives in the place of
    a learner.
    """

    @property
    @abstractmethod
    def facts(self) -> "Facts":
        """Facts about the whole scene, for scene.json."""

    @abstractmethod
    def train(self, run: "Run", display: "Display", *, spent: float) -> None:
        """Train what is not finished, and write what a render needs; `spent` seconds of the time limit are
        over.

        config.json and scene.json are written.
        """
