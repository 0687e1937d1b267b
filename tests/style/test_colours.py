"""Colours behind the decoder: targets met, nothing moved where nothing is asked, colours stay colours."""

import math
from typing import Annotated

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from fprf.interfaces import Decoder, Stylizer
from fprf.plugins.stylizers.config import RegionToneConfig
from fprf.style.dictionary import Reference, StyleDictionary, build_dictionary, choose
from fprf.style.look import ColourMaps, Restyle, colour_maps
from fprf.style.scene_style import RegionWeight, SceneStyle, own_style, scene_style
from fprf.types import Want

COUNT = 600
KINDS = 3


class Unchanged(Stylizer):
    """Features stay; every point takes all codes alike."""

    needs = Want.CONTENT

    def __init__(self, codes: int) -> None:
        super().__init__()
        self.codes = codes

    def forward(self, content: Tensor, semantic: Tensor | None) -> Tensor:
        return content

    def match(self, semantic: Tensor) -> Tensor:
        return torch.full((len(semantic), self.codes), 1 / self.codes)


class Straight(Decoder):
    """Colours are the first three channels: means and covariances carry over as they are."""

    def forward(self, content: Annotated[Tensor, "N C"]) -> Annotated[Tensor, "N 3"]:
        return content[:, :3]


def points(seed: int, spread: float = 0.03) -> tuple[Tensor, Tensor, Tensor]:
    """Content, semantics and kind; colours well inside [0, 1], so that nothing is cut off."""
    draw = torch.Generator().manual_seed(seed)
    kind = torch.arange(COUNT) % KINDS
    middle = 0.35 + 0.3 * torch.rand(KINDS, 6, generator=draw)
    content = middle[kind] + spread * torch.randn(COUNT, 6, generator=draw) @ torch.rand(6, 6, generator=draw)
    semantic = 3 * torch.eye(KINDS, 4)[kind] + 0.01 * torch.randn(COUNT, 4, generator=draw)
    return content, semantic, kind


def reference(seed: int, coloured: bool = True) -> Reference:
    content, semantic, _ = points(seed)
    return Reference(f"r{seed}", content, semantic, colour=points(seed + 100)[0][:, :3] if coloured else None)


def setting(*seeds: int, blend: float = 0.0) -> tuple[Tensor, Tensor, Tensor, SceneStyle, StyleDictionary]:
    content, semantic, kind = points(0)
    scene = scene_style(content, semantic, torch.ones(COUNT), None, KINDS, 0)
    return (
        content,
        semantic,
        kind,
        scene,
        build_dictionary([reference(s) for s in seeds or (1,)], clusters=KINDS, blend=blend),
    )


def carried(maps: ColourMaps | None, colour: Tensor, semantic: Tensor | None) -> Tensor:
    assert maps is not None
    found: Tensor = colour + maps(colour, semantic)
    return found


def test_colours_get_mean_and_covariance_of_their_match() -> None:
    content, semantic, kind, scene, d = setting()
    sharp = RegionToneConfig(temperature=1e-3, features=0.0).build(dictionary=d, scene=scene)
    found = carried(colour_maps(sharp, d, scene, Straight(), features=0.0), content[:, :3], semantic)
    assert d.colour_mean is not None and d.colour_covariance is not None
    code = sharp.match(semantic).argmax(1)
    for k in range(KINDS):
        own = found[kind == k].double()
        taken = int(code[kind == k][0])
        assert torch.allclose(own.mean(0), d.colour_mean[taken].double(), atol=2e-3)
        # 512 draws know a deviation to 3 %, and _QUIET widens both sides.
        assert torch.allclose(
            torch.cov(own.T), d.colour_covariance[taken].double(), atol=0.2 * float(own.var(0).max())
        )


def test_regions_that_overlap_take_the_colours_that_they_match() -> None:
    """Their keys belong to several regions: what the stylizer says of these is mixed already, and would be
    mixed again.
    """
    content, semantic, _ = points(0)
    semantic = semantic + 2 * torch.randn(COUNT, 4, generator=torch.Generator().manual_seed(5))
    scene = scene_style(content, semantic, torch.ones(COUNT), None, 24, 0)
    d = build_dictionary([reference(1)], clusters=KINDS, blend=0.0)
    stylizer = RegionToneConfig(temperature=1e-3, features=0.0, smoothness=0.0).build(
        dictionary=d, scene=scene
    )
    table = stylizer.region_match(scene.keys)
    assert (stylizer.match(scene.keys) - table).abs().max() > 0.05
    maps = colour_maps(stylizer, d, scene, Straight(), features=0.0)
    assert maps is not None and d.colour_mean is not None
    mean = scene.region_mean[:, :3]
    moved = mean + torch.einsum("kc,kcd->kd", mean, maps.matrix) + maps.bias
    assert torch.allclose(moved, table @ d.colour_mean, atol=2e-3)


def test_nothing_asked_nothing_made() -> None:
    *_, scene, d = setting()
    stylizer = RegionToneConfig().build(dictionary=d, scene=scene)
    assert colour_maps(stylizer, d, scene, Straight(), share=0.0) is None
    bare = build_dictionary([reference(1), reference(2, coloured=False)], clusters=2)
    assert bare.colour_mean is None and colour_maps(stylizer, bare, scene, Straight()) is None
    assert colour_maps(stylizer, own_style(scene), scene, Straight()) is None


@pytest.mark.parametrize(
    ("own", "theirs", "gain", "error"),
    [
        (1e-4, 0.2, 3.0, 1e-5),  # would be a thousandfold: a flat region's noise must stay unseen
        (
            1e-3,
            3e-3,
            math.sqrt((9e-6 + 2e-4) / (1e-6 + 2e-4)),
            2e-3,
        ),  # below four 8-bit steps nothing has a shape
        (0.03, 0.06, math.sqrt((3.6e-3 + 2e-4) / (9e-4 + 2e-4)), 0.07),  # 512 draws know a deviation to 3 %
    ],
)
def test_how_much_colours_are_spread_out(own: float, theirs: float, gain: float, error: float) -> None:
    """One region whose colours deviate by `own` alike in all directions, a reference by `theirs`: the map is
    a multiple.
    """
    noise = torch.randn(COUNT, 6, generator=torch.Generator().manual_seed(0))
    noise = torch.linalg.qr(noise - noise.mean(0)).Q * COUNT**0.5
    scene = scene_style(0.5 + own * noise, None, torch.ones(COUNT), None, 1, 0)
    d = build_dictionary([Reference("r", noise, torch.zeros(COUNT, 0), colour=0.5 + theirs * noise[:, 3:])])
    maps = colour_maps(Unchanged(len(d.keys)), d, scene, Straight())
    assert maps is not None
    assert torch.linalg.svdvals(maps.matrix[0] + torch.eye(3)).tolist() == pytest.approx(
        [gain] * 3, rel=error
    )


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.0, 1.0))
def test_colours_stay_colours_and_kept_regions_stay(seed: int, strength: float) -> None:
    draw = torch.Generator().manual_seed(seed)
    content, semantic, _, scene, d = setting()
    stylizer = RegionToneConfig().build(dictionary=d, scene=scene)
    wild = ColourMaps(
        scene, 3 * torch.randn(KINDS, 3, 3, generator=draw), torch.randn(KINDS, 3, generator=draw), 1.0
    )
    weight = RegionWeight(scene, torch.tensor([[0.0], [1.0], [0.5]]))
    look = Restyle(stylizer, strength, weight, colours=wild)
    rgb = look.colour(Straight(), content, semantic)
    assert float(rgb.min()) >= 0 and float(rgb.max()) <= 1
    kept = weight(semantic)[:, 0] == 0
    assert bool(kept.any()) and torch.equal(rgb[kept], content[kept, :3]), "what is kept is kept bit for bit"


def test_a_look_fades_in() -> None:
    content, semantic, _, scene, d = setting()
    stylizer = RegionToneConfig().build(dictionary=d, scene=scene)
    look = Restyle(stylizer, features=0.5, colours=colour_maps(stylizer, d, scene, Straight(), features=0.5))
    full = look.colour(Straight(), content, semantic)
    assert torch.allclose(look.faded.mixed(look, 1.0).colour(Straight(), content, semantic), full, atol=1e-6)
    assert torch.equal(look.faded.mixed(look, 0.0).colour(Straight(), content, semantic), content[:, :3])
    assert look.needs == Want.CONTENT | Want.SEMANTIC
    steps = [look.faded.mixed(look, at).colour(Straight(), content, semantic) for at in (0.25, 0.26)]
    assert float((steps[1] - steps[0]).abs().max()) < 0.05 * float((full - content[:, :3]).abs().max())


def test_dictionaries_know_the_colours_of_their_pixels() -> None:
    r = reference(1)
    kind = points(1)[2]
    d = build_dictionary([r], clusters=KINDS, blend=0.0)
    both = build_dictionary([reference(2), r], clusters=KINDS, blend=0.0)
    part, _ = choose(both, torch.tensor([name == r.name for name in both.names]))
    assert r.colour is not None and d.colour_mean is not None and d.colour_covariance is not None
    wanted = torch.stack([r.colour[kind == k].mean(0) for k in range(KINDS)])
    apart = (d.colour_mean[:, None] - wanted[None]).norm(dim=-1).amin(1)
    assert float(apart.max()) < 1e-5, "each code has the mean of one kind"
    assert part.colour_mean is not None and torch.equal(part.colour_mean, d.colour_mean)
    assert part.colour_covariance is not None and torch.equal(part.colour_covariance, d.colour_covariance)


@pytest.mark.parametrize("pixels", [1, 2, 50])
@pytest.mark.parametrize("clusters", [1, 10])
def test_a_reference_of_one_colour_gives_that_colour(pixels: int, clusters: int) -> None:
    content, semantic, _, scene, _ = setting()
    flat = torch.full((pixels, 1), 0.7)
    one = Reference(
        "one", flat.expand(-1, 6), flat.expand(-1, 4), colour=flat * torch.tensor([1.0, 0.5, 0.0])
    )
    d = build_dictionary([one], clusters=clusters)
    stylizer = RegionToneConfig().build(dictionary=d, scene=scene)
    found = carried(colour_maps(stylizer, d, scene, Straight(), features=0.0), content[:, :3], semantic)
    assert bool(found.isfinite().all())
    assert torch.allclose(found.mean(0), torch.tensor([0.7, 0.35, 0.0]), atol=0.02)
    # What is left of the spread is that of _QUIET.
    assert float(found.std(0).max()) < 0.03
