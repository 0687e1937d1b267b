"""Style of a trained scene: one set of content statistics, its semantic regions, and which points belong to
them.

Letters: N points, C content channels, D semantic channels, K regions, P pairs of neighbouring pixels.
Statistics are sums in float64 and kept in float32; memberships are in [0, 1], and those of a point sum to 1.
"""

from collections.abc import Mapping
from typing import Annotated, NamedTuple

import torch
from torch import Tensor, nn

from ..errors import CheckpointError, DataError
from ..ops import mixture
from ..ops.backend import double
from .dictionary import BLEND, StyleDictionary, blend_codes
from .matching import point_shares, score_spread, unit
from .statistics import Moments, covariance, group_moments, kmeans
from .statistics import moments as moments_of

_MEMBERSHIP_TEMPERATURE = 0.3
"""Temperature of points belonging to regions, relative to the spread of the scores: fixed with the scene,
since the regions' statistics are taken with it.
"""

_MIN_MEMBERSHIP_SHARE = 0.01
"""Memberships below this share of the largest are dropped: a point then belongs to two or three regions and
the others cost nothing. What jumps there is below an 8-bit step.
"""

_COLOUR = 3
"""Channels of colours, whose maps are mixed before they are applied: cheaper than map after map."""

_EVEN_COLOUR_DIFFERENCE = 0.05
"""Difference of colours in [0, 1] at which two neighbouring pixels count 0.6 as one surface; at three times
that, 0.01.
"""


class SceneStyle(NamedTuple):
    """Statistics of the per-point content features, weighted by rendering weight, over the training views.

    Regions are clusters of the scene's own semantics. A scene without semantics has one
    region and D = 0.
    """

    mean: Annotated[Tensor, "C"]
    covariance: Annotated[Tensor, "C C"]
    keys: Annotated[Tensor, "K D"]
    """Centroid of each region's semantic features."""
    region_mean: Annotated[Tensor, "K C"]
    region_covariance: Annotated[Tensor, "K C C"]
    share: Annotated[Tensor, "K"]
    """Share of the scene's weight in each region; sums to 1."""
    semantic_mean: Annotated[Tensor, "D"]
    """Mean semantic feature of the scene: the centre for cosine matching."""
    contacts: Annotated[Tensor, "K K"]
    """Contact of each two regions without an edge of colour between them (`region_contacts`); 0 where not
    measured.
    """


def scene_style(
    content: Annotated[Tensor, "N C"],
    semantic: Annotated[Tensor, "N D"] | None,
    weights: Annotated[Tensor, "N"],
    moments: Moments | None,
    regions: int,
    seed: int,
) -> SceneStyle:
    """The scene's style from weighted points, float32.

    Regions are k-means clusters of the semantics; their statistics are taken over the same soft `Membership`
    by which the region stylizers assign points. Contacts are left at 0. Its tables, a few kB, are on the CPU,
    where stylizers are built, whatever the device of the points. `moments` are those of the whole scene,
    where a longer pass has them already. Raises DataError for no weight, NumericsError for values that are
    not finite.
    """
    if not bool(weights.any()):
        raise DataError("scene statistics: no point has weight; the scene renders empty, train it for longer")
    if moments is None:
        whole = moments_of(content, weights)
    else:
        whole = moments
    # Points that render nothing say nothing, whatever they hold.
    keep = weights > 0
    content = content[keep]
    weights = weights[keep]
    if semantic is None:
        semantic = content.new_zeros(len(content), 0)
    else:
        semantic = semantic[keep]
    keys = semantic.new_zeros(1, 0)
    if semantic.shape[1] > 0:
        keys = kmeans(semantic, regions, seed=seed, weights=weights).centres
    middle = (double(weights) @ double(semantic) / double(weights).sum()).to(semantic)
    # K-means compares distances and membership compares directions, so a cluster may win no point.
    # Memberships are taken again without it, as the stylizers will: no region has statistics of nothing.
    while True:
        belongs = Membership(keys, middle)(semantic)
        used = belongs.sum(0) > 0
        if bool(used.all()):
            break
        keys = keys[used]
    # Statistics of each region over its members, each by its weight and its membership.
    mean, covariances, share = group_moments(content, double(belongs) * double(weights)[:, None])
    contacts = share.new_zeros(len(share), len(share))
    measured = (whole.mean, covariance(whole), keys, mean, covariances, share, middle, contacts)
    return SceneStyle(*(table.float().cpu() for table in measured))


class Membership(nn.Module):
    """Membership of points in regions by keys: attention without the faintest shares, on the device of the
    module.

    Directions are taken from a centre: the mean of the scene's semantics.
    """

    centre: Annotated[Tensor, "D"]
    units: Annotated[Tensor, "K D"]

    def __init__(self, keys: Annotated[Tensor, "K D"], centre: Annotated[Tensor, "D"]) -> None:
        super().__init__()
        units = unit(keys, centre)
        self._temperature = _MEMBERSHIP_TEMPERATURE * score_spread(units, units)
        self.register_buffer("centre", centre.float())
        self.register_buffer("units", units.float())

    @property
    def divided(self) -> bool:
        """More than one region: points need semantics to tell which."""
        return len(self.units) > 1

    def forward(self, semantic: Annotated[Tensor, "N D"]) -> Annotated[Tensor, "N K"]:
        """Rows sum to 1."""
        semantic = semantic.to(self.units)
        if not self.divided:
            return semantic.new_ones(len(semantic), 1)
        return point_shares(
            semantic, self.units, self._temperature, centre=self.centre, faint=_MIN_MEMBERSHIP_SHARE
        )


def mixed_gains(
    x: Annotated[Tensor, "N C"],
    centre: Annotated[Tensor, "C"],
    share: Annotated[Tensor, "N K"],
    gain: Annotated[Tensor, "K C"],
    bias: Annotated[Tensor, "K C"],
) -> Annotated[Tensor, "N C"]:
    """(x - centre) (share gain) + share bias, channel by channel: gains and biases mixed by shares.

    Within (K + 3) u (|x - centre| (share |gain|) + share |bias|), u = 2^-24.
    """
    if mixture.usable(x, centre, share, gain, bias):
        return mixture.scaled(x, centre, share, gain, bias)
    return (x - centre) * (share @ gain) + share @ bias


def mixed_maps(
    x: Annotated[Tensor, "N C"],
    share: Annotated[Tensor, "N K"],
    matrix: Annotated[Tensor, "K C C"],
    bias: Annotated[Tensor, "K C"],
    *,
    centre: Annotated[Tensor, "C"] | None = None,
) -> Annotated[Tensor, "N C"]:
    """sum_k share_k ((x - centre) matrix_k + bias_k): the affine maps of regions, mixed by membership.

    Within (C + K + 3) u sum_k share_k (|x - centre| |matrix_k| + |bias_k|), u = 2^-24.
    """
    channels = x.shape[1]
    zero = x.new_zeros(channels) if centre is None else centre
    if channels != _COLOUR and len(matrix) > 1 and mixture.usable(x, share, matrix, bias, zero):
        return mixture.affine(x, zero, share, matrix, bias)
    away = x if centre is None else x - centre
    if len(matrix) == 1:
        return away @ matrix[0] + bias[0]
    if channels == _COLOUR and mixture.usable(away, share, matrix, bias):
        return mixture.coloured(away, share, matrix, bias)
    mixed = share @ bias
    if channels == _COLOUR:
        maps = (share @ matrix.flatten(1)).view(-1, channels, channels)
        return mixed + (away[:, :, None] * maps).sum(1)
    # A point belongs to two or three regions: the maps of the others are not computed.
    for k in range(len(matrix)):
        inside = share[:, k].nonzero().squeeze(1)
        mixed.index_add_(0, inside, (away[inside] * share[inside, k, None]) @ matrix[k])
    return mixed


class RegionWeight(nn.Module):
    """One number a region, at points: by how much they belong to each."""

    values: Annotated[Tensor, "K X"]

    def __init__(self, scene: SceneStyle, values: Annotated[Tensor, "K X"]) -> None:
        super().__init__()
        self.membership = Membership(scene.keys, scene.semantic_mean)
        self.register_buffer("values", values.float())

    def forward(
        self, semantic: Annotated[Tensor, "N D"], belongs: Annotated[Tensor, "N K"] | None = None
    ) -> Annotated[Tensor, "N X"]:
        """The values, mixed by membership (`belongs`, where it is known): exactly 0 where all of a point's
        regions have 0.
        """
        if belongs is None:
            belongs = self.membership(semantic)
        return belongs.to(self.values) @ self.values


def region_contacts(
    scene: SceneStyle, semantic: Annotated[Tensor, "P 2 D"], colour: Annotated[Tensor, "P 2 3"]
) -> Annotated[Tensor, "K K"]:
    """Membership that passes from one region to another between P pairs of neighbouring pixels without an
    edge of colour.

    Mean over the pairs of -d_k d_l, with d the difference of both ends' memberships, where that is above 0;
    pairs whose colours differ count less. Symmetric, at least 0, with 0 on the diagonal.
    """
    belongs = Membership(scene.keys, scene.semantic_mean)
    ends = []
    for part in semantic.unbind(1):
        ends.append(double(belongs(part.contiguous())))
    # What one region loses between the ends of a pair, another gains; across an edge of colour it counts
    # little.
    change = ends[0] - ends[1]
    even = torch.exp(
        -double(colour[:, 0] - colour[:, 1]).abs().amax(1).square() / (2 * _EVEN_COLOUR_DIFFERENCE**2)
    )
    passed = -(change * even[:, None]).T @ change / max(1, len(change))
    return passed.clamp_min(0).fill_diagonal_(0).float()


def region_smoothing(
    scene: SceneStyle, smoothness: float, allowed: Annotated[Tensor, "K references"] | None = None
) -> Annotated[Tensor, "K K"]:
    """Matrix that makes regions alike that meet without an edge of colour: H, float64, rows sum to 1; the
    identity for 0.

    For values v of the regions, x = H v minimises sum_k s_k |x_k - v_k|^2 + smoothness sum_(k<l) c_kl |x_k -
    x_l|^2, with shares s and contacts c: the second sum is what x changes by between neighbouring pixels of
    one colour. The mean over the scene stays, s H = s. Regions that may not take from the same references
    (`allowed`) do not take from each other.
    """
    unity = torch.eye(len(scene.share), dtype=torch.float64)
    if smoothness == 0:
        return unity
    # Regions under different restrictions must not lend each other what one of them may not have.
    contacts = double(scene.contacts).to(unity)
    if allowed is not None:
        contacts = contacts * (allowed[:, None] == allowed[None]).all(-1).to(unity)
    # The minimum solves (diag(s) + smoothness (diag(c 1) - c)) x = diag(s) v.
    share = torch.diag(double(scene.share).to(unity))
    smooth: Tensor = torch.linalg.solve(share + smoothness * (torch.diag(contacts.sum(1)) - contacts), share)
    return smooth


def own_style(scene: SceneStyle, blend: float = BLEND) -> StyleDictionary:
    """The scene as its own only reference, blended as references are: the dictionary that changes nothing."""
    at = scene.share.new_full((len(scene.share),), blend)
    mean, covariances = blend_codes(
        scene.region_mean, scene.region_covariance, scene.mean, scene.covariance, at
    )
    return StyleDictionary(
        keys=scene.keys,
        mean=mean,
        covariance=covariances,
        share=scene.share,
        reference=torch.zeros(len(scene.share), dtype=torch.int64, device=scene.share.device),
        weight=torch.ones_like(scene.share),
        names=("scene",),
        blend=blend,
    )


def check_fit(dictionary: StyleDictionary, scene: SceneStyle) -> None:
    """Raise DataError unless references and scene were encoded alike."""
    style = (dictionary.mean.shape[1], dictionary.keys.shape[1])
    here = (scene.mean.shape[0], scene.keys.shape[1])
    if style != here:
        raise DataError(
            f"style dictionary: {style[0]} content and {style[1]} semantic channels, but the scene has {here[0]} and "
            f"{here[1]}; build it with the scene's own encoders"
        )


def to_tensors(scene: SceneStyle) -> dict[str, Tensor]:
    """The fields by name, for a checkpoint."""
    found: dict[str, Tensor] = {}
    for name, t in scene._asdict().items():
        found[name] = t.detach().contiguous()
    return found


def from_tensors(tensors: Mapping[str, Tensor]) -> SceneStyle:
    """A scene's style out of a checkpoint. Raises CheckpointError for missing or misshapen fields."""
    if "contacts" not in tensors and "share" in tensors:  # a run from before they were measured
        tensors = {**tensors, "contacts": tensors["share"].new_zeros(2 * tuple(tensors["share"].shape))}
    missing = []
    for name in SceneStyle._fields:
        if name not in tensors:
            missing.append(name)
    if missing:
        raise CheckpointError(f"scene statistics: {', '.join(missing)} missing; compute the statistics again")
    scene = SceneStyle(**{name: tensors[name] for name in SceneStyle._fields})
    # A checkpoint may be somebody else's: every table must fit the others.
    c = scene.mean.numel()
    k = scene.share.numel()
    d = scene.semantic_mean.numel()
    shapes = ((c,), (c, c), (k, d), (k, c), (k, c, c), (k,), (d,), (k, k))
    for name, t, shape in zip(SceneStyle._fields, scene, shapes, strict=True):
        if tuple(t.shape) != shape:
            raise CheckpointError(
                f"scene statistics: {name} is {tuple(t.shape)}, expected {shape}; compute them again"
            )
        if not bool(t.isfinite().all()):
            raise CheckpointError(f"scene statistics: {name} is not finite; compute the statistics again")
    return scene
