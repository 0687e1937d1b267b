"""Scenes of Gaussians, drawn in the clients' browsers: a look or a map is new colours of the same Gaussians, for all clients.

Browsers draw one colour each Gaussian, without compensation of its opacity: they get the means over the scene's views.
"""

from collections.abc import Callable, Generator, Hashable
from typing import Annotated, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..io.images import Picture, to_uint8
from ..rendering.cameras import Cameras
from ..rendering.splines import rotations
from ..splats.gaussians import Gaussians
from ..splats.scene import SplatScene
from ..style.look import Restyle
from ..style.regional import RegionWeight
from .cameras import PageTransform
from .render_worker import Steps
from .renderer import NO_MATCH, Layers, RenderRequest, SceneRenderer, composite_layers, match_colours, region_colours
from .restyler import Restyler
from .state import State, ViewSettings

Colours: TypeAlias = Annotated[NDArray[np.uint8], "N 3"]


class GaussianRenderer(SceneRenderer):
    """Computes the colours of what clients request; `show` receives them when they change from those of the capture."""

    def __init__(self, scene: SplatScene, restyler: Restyler, show: Callable[[Colours], None]) -> None:
        self._scene, self._restyler, self._show = scene, restyler, show
        self._view: ViewSettings = State().view
        self._framed: tuple[Restyle | None, SplatScene] = (None, scene)

    def render(self, client: Hashable, request: RenderRequest) -> Steps:
        """Show the colours that a request needs, unless they are shown already. Cameras move in the browsers alone."""
        view = request.view._replace(wipe=None)
        if view == self._view:
            return
        colours = self._colours(view)
        yield
        if client is not None:
            self._view = view
            self._show(colours)

    def frame(self, cameras: Cameras, view: int, look: Restyle | None) -> Generator[None, None, Picture]:
        if self._framed[0] is not look:
            self._framed = (look, self._scene.restyled(look))
        yield
        return to_uint8(self._framed[1].render(cameras, view).rgb)

    def forget(self, client: Hashable) -> None:
        """Do nothing: nothing is kept for single clients."""

    @torch.inference_mode()
    def _colours(self, view: ViewSettings) -> Colours:
        scene, styled = self._scene, self._restyler.styled(view.look)
        look = None if styled is None else styled.restyle
        pictures = {"look": to_uint8(scene.seen.colours(scene.restyled(look).shown.harmonics).clamp(0, 1))}
        share: NDArray[np.float32] | None = None
        solid = torch.ones(len(scene.gaussians))
        if view.shows_regions:
            style = self._restyler.encoders.scene
            memberships = RegionWeight(style, torch.eye(len(style.share)))(scene.found().features)
            if view.map == "regions":
                pictures["regions"] = to_uint8(region_colours(memberships, solid))
            if view.region is not None:
                share = memberships[:, view.region].float().numpy()
        if view.map == "matches" and styled is not None:
            taken = styled.restyle.match(scene.found().features.float(), scene.gaussians.means)
            pictures["matches"] = match_colours(styled, taken, solid)
        elif view.map == "matches":
            pictures["matches"] = np.full_like(pictures["look"], NO_MATCH)
        return composite_layers(Layers(pictures, share, solid), view)


def page_gaussians(gaussians: Gaussians, transform: PageTransform) -> tuple[Tensor, Tensor]:
    """Centres [N 3] and covariances [N 3 3] on the page."""
    axes = rotations(torch.nn.functional.normalize(gaussians.quaternions, dim=1).double())
    scaled = axes * (gaussians.log_scales.double().exp() * transform.scale)[:, None, :]
    return transform.to_page(gaussians.means).float(), (scaled @ scaled.transpose(1, 2)).float()
