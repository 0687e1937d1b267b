"""Global AdaIN (paper, single reference): sigma_s (F - mu_c) / sigma_c + mu_s."""

from typing import Annotated

from torch import Tensor

from ...interfaces import Stylizer
from ...ops.precision import full_precision
from ...style.dictionary import StyleDictionary, code_odds, whole_style
from ...style.scene import SceneStyle
from ...style.statistics import deviation, double
from ...types import Want

__all__ = ["AdainStylizer"]


class AdainStylizer(Stylizer):
    """One mean and deviation for all references, merged by weight."""

    content_mean: Annotated[Tensor, "C"]
    style_mean: Annotated[Tensor, "C"]
    gain: Annotated[Tensor, "C"]
    odds: Annotated[Tensor, "T"]

    def __init__(self, dictionary: StyleDictionary, scene: SceneStyle) -> None:
        super().__init__()
        mean, covariance = whole_style(dictionary)
        scene_mean = double(scene.mean)
        scene_sigma = deviation(scene_mean, double(scene.covariance).diagonal())
        self.register_buffer("content_mean", scene.mean.float())
        self.register_buffer("style_mean", mean.to(scene.mean.device).float())
        gain = deviation(mean, covariance.diagonal()).to(scene_sigma.device) / scene_sigma
        self.register_buffer("gain", gain.to(scene.mean.device).float())
        self.register_buffer("odds", code_odds(dictionary).to(scene.mean.device).float())

    @property
    def needs(self) -> Want:
        """Content alone."""
        return Want.CONTENT

    def forward(self, content: Annotated[Tensor, "N C"], semantic: Annotated[Tensor, "N D"] | None) -> Annotated[Tensor, "N C"]:
        """AdaIN; the mean is subtracted first, since a x + b loses digits where the mean is large."""
        with full_precision(content):
            return ((content.to(self.gain) - self.content_mean) * self.gain + self.style_mean).to(content)

    def match(self, semantic: Annotated[Tensor, "N D"]) -> Annotated[Tensor, "N T"]:
        """Every point alike: the codes' shares of the references."""
        return self.odds.expand(len(semantic), -1)
