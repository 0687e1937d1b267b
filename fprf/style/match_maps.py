"""Matches before any colour is rendered: references and style codes that each pixel takes, and a list of a
scene's regions.

The list shows where each region is seen best, how large it is, and what it takes from the references.
Letters: H x W pixels of a view, T style codes, K regions.
"""

import math
from typing import Annotated, Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from ..io.images import Picture, to_uint8
from ..io.maps import Tile, highlight, match_image, match_summary, scale_image, weighted_sum
from ..rendering.cameras import Cameras, pixel_grid
from ..scenes import Scene
from .matching import unit
from .regions import Regions, membership_view, shrunk
from .restyle import Codes, Styled
from .scene_style import Membership

_MIN_LISTED_SHARE = 0.005
"""Codes that less than this share of a view takes are not listed."""
_MAX_LOOKED_VIEWS = 24
"""Views that are looked through for where each region is largest, evenly over all."""
_LOOKED_SIDE_PIXELS = 32
"""Longest side of the views that are looked through: enough to tell the largest region."""
_REGION_THUMBNAIL_PIXELS = 160
"""Longest side of the thumbnails of regions: a dozen fit a sheet. By eye."""


class MatchMap(NamedTuple):
    """One view, means over what each pixel sees; 0 where it sees nothing."""

    taken: Annotated[Tensor, "H W T"]
    """Share of each style code; sums to 1 less what regions keep of the scene."""
    score: Annotated[Tensor, "H W"]
    """Cosine of what lies there with the codes that it takes, seen from the scene's mean, in [-1, 1]."""
    region: Annotated[Tensor, "H W K"]
    """Share of each region of the scene."""
    confidence: Annotated[Tensor, "H W"]
    """How sure what lies there is of its match, in [0, 1]: what is not takes light alone. 1 where all is
    painted.
    """
    opacity: Annotated[Tensor, "H W"]

    @property
    def kept(self) -> Annotated[Tensor, "H W"]:
        """Share that stays as it is, where anything is."""
        return (self.region.sum(-1) - self.taken.sum(-1)).clamp(0, 1)

    @property
    def attention(self) -> Annotated[Tensor, "H W T"]:
        """Shares of the codes in what is taken at all; sums to 1, or to 0."""
        return self.taken / self.taken.sum(-1, keepdim=True).clamp_min(1e-10)

    @property
    def entropy(self) -> Annotated[Tensor, "H W"]:
        """Entropy of the attention, in bits: 0 = one code, log2(T) = all alike."""
        bits: Tensor = torch.special.entr(self.attention.clamp_min(0)).sum(-1) / math.log(2)
        return bits


@torch.inference_mode()
def match_map(scene: Scene, styled: Styled, view: int, cameras: Cameras | None = None) -> MatchMap:
    """Matches of one of the scene's scene_style views, or of `cameras`: geometry and semantics alone are
    computed.
    """
    if cameras is None:
        cameras = scene.cameras
    scene_style = styled.scene_style
    look = styled.restyle
    device = scene.device
    belongs = Membership(scene_style.keys, scene_style.semantic_mean).to(device)
    centre = scene_style.semantic_mean.to(device)
    units = styled.codes.units.to(device)
    codes = len(styled.codes.reference)

    def values(semantic: Tensor, points: Tensor | None) -> Tensor:
        # The score is weighted by what is taken, so that its composite is the mean over that.
        taken = look.match(semantic, points)
        if belongs.divided:
            near = unit(semantic, centre) @ units.T
        else:
            near = taken.new_zeros(taken.shape)
        sure = look.confidence(semantic, points).to(taken)
        return torch.cat([taken, (taken * near).sum(1, keepdim=True), sure, belongs(semantic)], 1)

    # One pass composites all of them: codes, score, confidence, regions.
    pixel = pixel_grid(cameras, view)
    shares, opacity = scene.paint(cameras, view, pixel, values, semantic=belongs.divided)
    # Take them apart again.
    width, height = (int(v) for v in cameras.size[view])
    shares = shares.view(height, width, -1)
    taken = shares[..., :codes]
    score = shares[..., codes] / taken.sum(-1).clamp_min(1e-10)
    confidence = shares[..., codes + 1].clamp(0, 1)
    region = shares[..., codes + 2 :]
    return MatchMap(taken, score.clamp(-1, 1), region, confidence, opacity.view(height, width))


def match_picture(matched: MatchMap, codes: Codes) -> Picture:
    """Matches of a view: hue = reference, shade = code, darkness = doubt, pale = kept."""
    return match_image(matched.attention, codes.reference, codes.names, matched.opacity, matched.kept)


def match_pictures(matched: MatchMap, codes: Codes) -> dict[str, Picture]:
    """`match` (see `match_picture`), `score` and `confidence` (0 to 1), and `entropy` (0 to log2 T)."""
    most = math.log2(max(2, len(codes.reference)))
    return {
        "match": match_picture(matched, codes),
        "score": scale_image(matched.score, 0.0, 1.0, matched.opacity * (1 - matched.kept)),
        "confidence": scale_image(matched.confidence, 0.0, 1.0, matched.opacity * (1 - matched.kept)),
        "entropy": scale_image(matched.entropy, 0.0, most, matched.opacity * (1 - matched.kept)),
    }


def summarize(matched: MatchMap, codes: Codes) -> dict[str, Any]:
    """Use of the references and their codes, and its certainty, over the pixels of a view by their
    opacity.
    """
    # Pixels count by their opacity; certainty is that of what is styled at all.
    each = matched.opacity.double()
    kept = matched.kept
    total = float(each.sum()) or 1.0
    weight = each * (1 - kept)
    styled = float(weight.sum()) or 1.0
    of_code = weighted_sum(matched.taken, each) / total
    of_region = weighted_sum(matched.region, each) / total
    # Codes are numbered within their reference, and listed from the most used on.
    listed = []
    for t in of_code.argsort(descending=True).tolist():
        if float(of_code[t]) >= _MIN_LISTED_SHARE:
            cluster = int((codes.reference[:t] == codes.reference[t]).sum())
            listed.append(
                {
                    "reference": codes.names[int(codes.reference[t])],
                    "cluster": cluster,
                    "share": float(of_code[t]),
                }
            )
    regions = []
    for k, share in enumerate(of_region.tolist()):
        if share >= _MIN_LISTED_SHARE:
            regions.append({"region": k, "share": share})
    return {
        **match_summary(matched.attention, codes.reference, codes.names, weight),
        "score": float((matched.score * weight).sum()) / styled,
        "confidence": float((matched.confidence * weight).sum()) / styled,
        "kept_share": float((kept * each).sum()) / total,
        "codes": listed,
        "regions": regions,
    }


class ReferenceShare(NamedTuple):
    """Share of a region that comes from one reference."""

    name: str
    share: float
    """Of the region's attention; what it would be, where the region is kept."""
    score: float
    """Cosine with the nearest of the reference's codes, in [-1, 1]."""


class ExplainedRegion(NamedTuple):
    """One of the scene's regions, and what it takes."""

    number: int
    share: float
    """Of the scene's weight."""
    view: str
    """View in which it is largest."""
    pixel: tuple[int, int]
    """A place in that view, in the middle of it: what to point at to mean it."""
    picture: Picture
    """That view with the region highlighted."""
    taken: tuple[ReferenceShare, ...] = ()
    """All references, the most used first."""
    entropy: float = 0.0
    """Bits, over the style codes."""
    confidence: float = 1.0
    """How sure it is of its match, in [0, 1]; 1 where all is painted."""
    strength: float = 1.0
    """0 = it stays as it is."""
    restricted: bool = False
    """It may not take from all references."""


@torch.inference_mode()
def explain(regions: Regions, styled: Styled | None = None) -> list[ExplainedRegion]:
    """All regions in their order, with what they take where there is a style."""
    scene = regions.scene
    best = _best_views(regions)
    # Those views are rendered small, as they are, with the places of the regions in them.
    seen = {}
    for view in sorted(set(best)):
        share, opacity = membership_view(regions, view, _REGION_THUMBNAIL_PIXELS)
        picture = to_uint8(scene.render(shrunk(scene.cameras, view, _REGION_THUMBNAIL_PIXELS), 0).rgb)
        seen[view] = picture, share * opacity[..., None]
    rows = []
    for k, view in enumerate(best):
        picture, shares = seen[view]
        share = shares[..., k]
        (width, height) = scene.cameras.size[view].tolist()
        pixel = _middle_of(share, width, height)
        part = float(regions.scene_style.share[k])
        rows.append(ExplainedRegion(k, part, scene.names[view], pixel, highlight(picture, share)))
    if styled is None:
        return rows
    return _with_taken(rows, regions, styled)


def _best_views(regions: Regions) -> list[int]:
    """The view in which each region is largest; views evenly over all are looked through, coarsely."""
    last = len(regions.scene.names) - 1
    looked = sorted({round(i * last / max(1, _MAX_LOOKED_VIEWS - 1)) for i in range(_MAX_LOOKED_VIEWS)})
    mass = []
    for view in looked:
        share, opacity = membership_view(regions, view, _LOOKED_SIDE_PIXELS)
        mass.append((share * opacity[..., None]).mean((0, 1)))
    found: list[int] = []
    for column in torch.stack(mass).T:
        found.append(looked[int(column.argmax())])
    return found


def _middle_of(share: Annotated[Tensor, "H W"], width: int, height: int) -> tuple[int, int]:
    """A pixel in the middle of a region, of a view of that size, by its share in a small copy."""
    # Blurred membership is highest in the middle; a pixel that belongs to the region itself comes before one
    # beside it.
    own = share.cpu().numpy()
    reach = 2 * (max(share.shape) // 12) + 1
    smooth = cv2.blur(own, (reach, reach), borderType=cv2.BORDER_CONSTANT)
    y, x = np.unravel_index(int(np.argmax(smooth * (own > 0.5) + 1e-3 * smooth)), smooth.shape)
    (tall, wide) = share.shape
    return int((x + 0.5) * width / wide), int((y + 0.5) * height / tall)


def _with_taken(rows: list[ExplainedRegion], regions: Regions, styled: Styled) -> list[ExplainedRegion]:
    """The regions with what each takes from the references."""
    keys = regions.scene_style.keys.to(regions.scene.device)
    reference = styled.dictionary.reference
    controls = styled.controls
    attention = styled.restyle.stylizer.match(keys).cpu().double()
    sure = styled.restyle.confidence(keys).cpu()
    explained = []
    for k, row in enumerate(rows):
        taken = []
        for i, name in enumerate(styled.dictionary.names):
            share = float(attention[k][reference == i].sum())
            taken.append(ReferenceShare(name, share, float(controls.score[k][reference == i].max())))
        changed = row._replace(
            taken=tuple(sorted(taken, key=lambda each: (-each.share, -each.score))),
            entropy=float(torch.special.entr(attention[k]).sum()) / math.log(2),
            confidence=float(sure[k]),
            strength=float(controls.strength[k]),
            restricted=not bool(controls.allowed[k].all()),
        )
        explained.append(changed)
    return explained


def region_row(region: ExplainedRegion) -> dict[str, Any]:
    """A region for JSON."""
    row: dict[str, Any] = {
        "region": region.number,
        "share": region.share,
        "view": region.view,
        "pixel": list(region.pixel),
    }
    if region.taken:
        row |= {
            "references": [taken._asdict() for taken in region.taken],
            "entropy_bits": region.entropy,
            "confidence": region.confidence,
            "strength": region.strength,
            "restricted": region.restricted,
        }
    return row


def region_tile(region: ExplainedRegion, names: tuple[str, ...]) -> Tile:
    """A region for a sheet; `names` are the references in the order of their colours."""
    lines = [
        f"{region.number}: {region.share:.1%} of the scene",
        f"{region.view}:{region.pixel[0]},{region.pixel[1]}",
    ]
    if not region.taken:
        return Tile(region.picture, tuple(lines))
    best = region.taken[0]
    matched = f"{best.name} {best.share:.0%}, score {best.score:.2f}, sure {region.confidence:.0%}"
    if region.strength == 0:
        matched = "kept as it is"
    lines.append(matched)
    by_name = {}
    for taken in region.taken:
        by_name[taken.name] = taken.share * region.strength
    return Tile(region.picture, tuple(lines), tuple(by_name[name] for name in names))
