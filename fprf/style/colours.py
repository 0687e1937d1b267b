"""Colours of a region carried to the colours of what it matches: what features alone miss.

A decoder is not linear, and styled features lie off what it has seen: their statistics may be those of the references while
the colours are not. So colours get a map of their own behind the decoder, region by region,

    c'  =  c + sum_k a_k(point) ((c - m_k) A_k + n_k - c)

where m_k and S_k are mean and covariance of the colours that region k has after the decoder, n_k and T_k those of the
photographs' pixels in the codes that it matches, and A_k S_k A_k = T_k is the optimal transport of three channels. The colours
after the decoder are those of draws from the region's Gaussian of features: a trained scene knows that and needs no images.
A point's colour still depends on the point alone.
"""

from typing import Annotated

import torch
from torch import Tensor, nn

from ..interfaces import Decoder, Stylizer
from ..ops import mixture
from ..ops.precision import double
from ..types import Want
from .controls import blend_strength
from .dictionary import StyleDictionary, blend_codes
from .scene import Membership, SceneStyle
from .statistics import mix, monge, symmetric_root

_DRAWS = 512
"""Points drawn of each region: means of colours are known to a fiftieth of their deviation."""
_GAIN = 3.0
"""No direction of colour is amplified more: a flat region's noise must stay unseen."""
_QUIET = 2e-4
"""Variance added on both sides: a deviation of four 8-bit steps, below which colours have no shape worth carrying over."""


class ColourMaps(nn.Module):
    """An affine map of colours for each region, mixed by membership."""

    matrix: Annotated[Tensor, "K 3 3"]
    bias: Annotated[Tensor, "K 3"]
    origin: Annotated[Tensor, "3"]

    def __init__(
        self, scene: SceneStyle, matrix: Annotated[Tensor, "K 3 3"], bias: Annotated[Tensor, "K 3"], share: float
    ) -> None:
        super().__init__()
        self.membership = Membership(scene)
        # The identity is taken out: what is small stays exact, and a map that changes nothing is nothing.
        self.register_buffer("matrix", (share * (matrix - torch.eye(3).to(matrix))).float())
        self.register_buffer("bias", (share * bias).float())
        self.register_buffer("origin", torch.zeros(3))

    @property
    def needs(self) -> Want:
        """Semantics only where there is more than one region."""
        return Want.CONTENT | Want.SEMANTIC if self.membership.divided else Want.CONTENT

    def forward(
        self,
        colour: Annotated[Tensor, "N 3"],
        semantic: Annotated[Tensor, "N D"] | None,
        belongs: Annotated[Tensor, "N K"] | None = None,
    ) -> Annotated[Tensor, "N 3"]:
        """Change to add to colours in [0, 1] so that they lie in the style and in [0, 1].

        `belongs` is the points' membership, where somebody has it.
        """
        if belongs is None:
            belongs = self.membership(colour[:, :0] if semantic is None else semantic)
        change = mixture.affine(colour.to(self.bias), belongs.to(self.bias), self.matrix, self.bias, centre=self.origin)
        return (colour + change.to(colour)).clamp(0, 1) - colour


@torch.no_grad()
def colour_maps(
    stylizer: Stylizer,
    dictionary: StyleDictionary,
    scene: SceneStyle,
    decoder: Decoder,
    *,
    features: float = 1.0,
    share: float = 1.0,
    smoothing: Annotated[Tensor, "K K"] | None = None,
) -> ColourMaps | None:
    """The maps of a stylizer whose change of features counts `features`; None where nothing is to be carried over.

    `share`, in [0, 1], is how much of the way colours go. Regions and codes are matched by the stylizer itself; `smoothing`
    (`region_smoothing`) is what it smooths its matches by. A dictionary without the colours of its photographs (that of the
    scene itself) carries nothing over.
    """
    if share == 0 or dictionary.colour_mean is None or dictionary.colour_covariance is None:
        return None
    mean, covariances = decoded_colours(stylizer, scene, decoder, features=features)
    whole = mix(mean, covariances, scene.share)
    at = mean.new_full((len(mean),), dictionary.blend)
    mean, covariances = blend_codes(mean, covariances, *whole, at)
    if smoothing is not None:
        mean, covariances = smoothing.to(mean) @ mean, torch.einsum("kl,lij->kij", smoothing.to(mean), covariances)
    table = double(stylizer.region_match(scene.keys.to(_device(stylizer, scene)))).to(mean)
    return ColourMaps(scene, *carried_colours(mean, covariances, table, dictionary), share)


def carried_colours(
    mean: Annotated[Tensor, "K 3"],
    covariances: Annotated[Tensor, "K 3 3"],
    table: Annotated[Tensor, "K T"],
    dictionary: StyleDictionary,
) -> tuple[Annotated[Tensor, "K 3 3"], Annotated[Tensor, "K 3"]]:
    """A and b of each region, float64, c' = c A + b: from the colours that it has to those of the codes that it takes.

    `table` holds the shares of the codes, and the dictionary the colours of its photographs.
    """
    assert dictionary.colour_mean is not None and dictionary.colour_covariance is not None
    there, spread = double(dictionary.colour_mean).to(mean), double(dictionary.colour_covariance).to(mean)
    if len(mean) == 1:  # an undivided scene takes its codes together, with what lies between them
        target, wide = (part[None] for part in mix(there, spread, table[0]))
    else:
        target, wide = table @ there, torch.einsum("kt,tij->kij", table, spread)
    floor = _QUIET * torch.eye(3).to(mean)
    matrix = monge(covariances + floor, wide + floor, gain=_GAIN)
    return matrix, target - torch.einsum("kc,kcd->kd", mean, matrix)


@torch.no_grad()
def decoded_colours(
    stylizer: Stylizer, scene: SceneStyle, decoder: Decoder, *, features: float = 1.0
) -> tuple[Annotated[Tensor, "K 3"], Annotated[Tensor, "K 3 3"]]:
    """Mean and covariance of each region's colours, float64, after the stylizer and the decoder."""
    device = _device(stylizer, scene)
    draw = torch.randn(_DRAWS // 2, scene.mean.numel(), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    draw = torch.cat([draw, -draw])  # in pairs: the features' mean is met exactly
    means, covariances = [], []
    for k in range(len(scene.share)):
        root = symmetric_root(double(scene.region_covariance[k])).cpu()
        points = (double(scene.region_mean[k]).cpu() + draw @ root).float().to(device)
        key = scene.keys[k].to(device).expand(len(points), -1)
        styled = blend_strength(points, stylizer(points, key if Want.SEMANTIC in stylizer.needs else None), features)
        colour = double(decoder(styled)).cpu()
        means.append(colour.mean(0))
        covariances.append(torch.cov(colour.T, correction=0))
    return torch.stack(means), torch.stack(covariances)


def own_colours(
    stylizer: Stylizer, scene: SceneStyle, decoder: Decoder | None
) -> tuple[Annotated[Tensor, "K 3"], Annotated[Tensor, "K 3 3"]]:
    """Mean and covariance of each region's own colours, float64; without a decoder they are the content."""
    if decoder is None:
        return double(scene.region_mean), double(scene.region_covariance)
    return decoded_colours(stylizer, scene, decoder, features=0.0)


def _device(stylizer: Stylizer, scene: SceneStyle) -> torch.device:
    return next(stylizer.buffers(), scene.mean).device
