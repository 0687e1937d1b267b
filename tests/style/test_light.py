"""Light where a match is not sure: maps of colours, confidence, casts, and the same in fields and on
Gaussians.
"""

from typing import Annotated

import pytest
import torch
from torch import Tensor

from fprf.interfaces import Decoder
from fprf.ops.harmonics import as_drawn
from fprf.plugins.stylizers.config import RegionToneConfig
from fprf.splats.gaussians import HARMONIC
from fprf.splats.restyle import all_around, restyled_harmonics
from fprf.style.dictionary import Reference, build_dictionary, concatenate
from fprf.style.light import APPLIED, Light, light_maps, light_of, unrivalled
from fprf.style.look import Restyle, region_maps, regional
from fprf.style.scene_style import SceneStyle, own_style, scene_style

KINDS = 4
EACH = 150
CONFIG = RegionToneConfig(smoothness=0.0)
OWN = torch.tensor([[0.4, 0.5, 0.7], [0.3, 0.45, 0.2], [0.5, 0.45, 0.4], [0.55, 0.35, 0.3]])
"""Sky, plants, ground, brick."""
MEADOW = torch.tensor([[0.35, 0.6, 0.95], [0.35, 0.6, 0.1], [0.5, 0.55, 0.15], [0.7, 0.12, 0.1]])
"""Blue sky, grass, straw, a red barn."""


class Straight(Decoder):
    """Content is colour, as on Gaussians."""

    def forward(self, content: Annotated[Tensor, "N C"]) -> Annotated[Tensor, "N 3"]:
        return content


def samples(
    colours: Tensor, seed: int, *, turned: bool = False, spread: float = 0.04
) -> tuple[Tensor, Tensor]:
    """Colours and semantics of points of each kind; `turned` = of kinds that the scene does not know."""
    draw = torch.Generator().manual_seed(seed)
    kind = torch.arange(KINDS * EACH) % KINDS
    colour = (colours[kind] + spread * torch.randn(len(kind), 3, generator=draw)).clamp(0, 1)
    axes = torch.eye(2 * KINDS)[KINDS * turned :][:KINDS]
    return colour, axes[kind] + 0.02 * torch.randn(len(kind), 2 * KINDS, generator=draw)


def made_scene() -> tuple[Tensor, Tensor, SceneStyle]:
    colour, semantic = samples(OWN, 0)
    return colour, semantic, scene_style(colour, semantic, torch.ones(len(colour)), None, KINDS, 0)


def reference(
    colours: Tensor, name: str = "r", *, turned: bool = False, kinds: tuple[int, ...] = (0, 1, 2, 3)
) -> Reference:
    colour, semantic = samples(colours, len(name), turned=turned)
    some = torch.isin(torch.arange(KINDS * EACH) % KINDS, torch.tensor(kinds))
    return Reference(name, colour[some], semantic[some], colour=colour[some])


def look_of(scene: SceneStyle, *references: Reference, bold: float = 0.5, strength: float = 1.0) -> Restyle:
    d = build_dictionary(references, clusters=KINDS, blend=0.0)
    stylizer = CONFIG.build(dictionary=d, scene=scene)
    light = light_of(scene, d, CONFIG, (scene.region_mean, scene.region_covariance), bold=bold)
    colours = region_maps(stylizer, d, scene, CONFIG, torch.ones(KINDS, len(references)).bool())
    return Restyle(stylizer, strength, features=0.0, colours=colours, light=light)


def lights(look: Restyle) -> Light:
    assert look.light is not None
    return look.light


def test_light_is_affine_and_fields_and_gaussians_take_the_same() -> None:
    """What the maps say of black, white and any colour is what both show, with several references."""
    colour, semantic, scene = made_scene()
    look = look_of(scene, reference(MEADOW, turned=True), reference(0.5 * OWN, "dark", kinds=(0, 1)))
    light = lights(look)
    paint = light.paint(semantic)
    assert float(paint.min()) < 0.2 < 0.8 < float(paint.max())
    maps = light.change(semantic, paint)
    for shown in (torch.zeros_like(colour), torch.ones_like(colour), colour):
        wanted = torch.einsum("nc,ncd->nd", shown, maps[:, :3]) + maps[:, 3]
        assert torch.allclose(light(shown, semantic, paint), wanted, atol=1e-6)
    field = look.colour(Straight(), colour, semantic)
    harmonics = ((colour - 0.5) / HARMONIC)[:, None]
    gaussians = restyled_harmonics(harmonics, torch.zeros_like(colour), semantic, look)
    seen = as_drawn(gaussians, all_around(1))[:, 0] * HARMONIC + 0.5
    inside = ((seen > 0.01) & (seen < 0.99)).all(1)
    assert int(inside.sum()) > 0.8 * len(seen) and torch.allclose(seen[inside], field[inside], atol=1e-4)


def test_bold_1_paints_bit_for_bit_and_0_paints_nothing() -> None:
    _, semantic, scene = made_scene()
    plain = look_of(scene, reference(MEADOW), bold=1.0)
    assert plain.light is None and bool((plain.confidence(semantic) == 1).all())
    assert float(lights(look_of(scene, reference(MEADOW), bold=0.0)).paint(semantic).abs().max()) == 0
    shares = [
        float(lights(look_of(scene, reference(MEADOW, kinds=(0, 1)), bold=b)).paint(semantic).mean())
        for b in (0.2, 0.5, 0.9)
    ]
    assert shares == sorted(shares) and shares[0] < shares[2] - 0.3


def test_confidence_is_full_for_the_scene_itself_and_none_for_the_unrelated() -> None:
    _, semantic, scene = made_scene()
    assert float(look_of(scene, reference(MEADOW)).confidence(semantic).mean()) > 0.95
    assert float(look_of(scene, reference(MEADOW, turned=True)).confidence(semantic).mean()) < 0.1
    both = look_of(scene, reference(MEADOW, turned=True), reference(OWN, "own"))
    assert float(both.confidence(semantic).mean()) > 0.95, "of several references the nearest counts"


def test_what_lies_beyond_the_basis_makes_unsure() -> None:
    _, semantic, scene = made_scene()
    r = reference(MEADOW)
    sure = look_of(scene, r).confidence(semantic).mean()
    far = look_of(scene, r._replace(beyond=20 * torch.ones(len(r.content)))).confidence(semantic).mean()
    assert float(far) < 0.5 < float(sure)


def test_a_kind_that_a_reference_lacks_is_lit_and_the_others_are_painted() -> None:
    colour, semantic, scene = made_scene()
    sure = look_of(scene, reference(MEADOW, kinds=(0, 1, 2))).confidence(semantic)[:, 0]
    kind = torch.arange(len(colour)) % KINDS
    assert float(sure[kind == 3].mean()) < 0.3 and float(sure[kind != 3].mean()) > 0.8


def shown_light(colours: Tensor) -> Tensor:
    """What a grey becomes in the light of a reference of these colours that shows nothing alike."""
    _, _, scene = made_scene()
    light = lights(look_of(scene, reference(colours, turned=True)))
    grey = torch.full((KINDS, 3), 0.4)
    return grey + torch.einsum("kc,kcd->kd", grey, light.maps[:, :3])


@pytest.mark.parametrize("tint", [(1.15, 1.0, 0.8), (0.8, 1.0, 1.2)])
def test_the_cast_of_an_evenly_tinted_reference_is_found(tint: tuple[float, float, float]) -> None:
    """A light is what all share: grey things seen through a tint give grey things that tint, as far as it is
    applied.
    """
    greys = torch.tensor([0.3, 0.4, 0.5, 0.6])[:, None] * torch.tensor(tint)
    found = shown_light(greys)
    assert torch.allclose(
        found[:, 0] / found[:, 2], torch.full((KINDS,), (tint[0] / tint[2]) ** APPLIED), rtol=0.1
    )
    meadow = shown_light(MEADOW)
    assert torch.allclose(meadow[:, 0], meadow[:, 2], rtol=0.02), "a meadow with a sky and a barn has no cast"


def test_the_sky_follows_its_match_and_things_what_all_agree_on() -> None:
    """At night a sky grows darker than what it lights."""
    mean = torch.tensor([[0.5, 0.5, 0.5]]).expand(KINDS, 3).double()
    spread = torch.tensor([0.02, 0.2, 0.2, 0.2]).double()
    covariance = spread[:, None, None].square() * torch.ones(3, 3).double()
    target = torch.tensor([0.05, 0.3, 0.3, 0.9])[:, None].expand(KINDS, 3)
    d = build_dictionary([reference(OWN)], clusters=KINDS)._replace(colour_mean=target)
    even = torch.full((KINDS,), 0.25).double()
    maps, _ = light_maps(mean, covariance, even, torch.eye(KINDS).double(), d, even)
    grey = torch.einsum("kc,kcd->kd", mean, maps[:, :3]) + maps[:, 3]
    assert float(grey[0, 0]) == pytest.approx(0.05, abs=0.02)
    assert float(grey[1, 0]) < 0.45 and float(grey[3, 0]) < 0.6


def test_half_way_from_blue_to_yellow_is_not_green() -> None:
    blue = torch.tensor([0.35, 0.55, 0.9])
    yellow = torch.tensor([0.95, 0.85, 0.4])
    there = MEADOW.clone()
    mean = OWN.double()
    there[0] = yellow
    mean[0] = blue
    d = build_dictionary([reference(OWN)], clusters=KINDS)._replace(colour_mean=there)
    covariance = 0.01 * torch.eye(3).double().expand(KINDS, 3, 3)
    even = torch.full((KINDS,), 0.25).double()
    maps, between = light_maps(mean, covariance, even, torch.eye(KINDS).double(), d, torch.zeros_like(even))
    lit = mean[0] @ maps[0, :3] + maps[0, 3]
    assert float(lit[2]) > float(lit[0]) + 0.2, "it is still blue"
    assert float(between[0, 1]) < -0.02
    for p in torch.linspace(0, 1, 21).tolist():
        plain = p * yellow + (1 - p) * lit
        mixed = plain + 4 * p * (1 - p) * between[0]
        assert float(mixed[1] - mixed[[0, 2]].max()) < 0.02
        assert float(mixed[1] - mixed[[0, 2]].max()) <= float(plain[1] - plain[[0, 2]].max()) + 1e-9


def test_a_kind_that_a_reference_lacks_keeps_its_own_chroma() -> None:
    """Brick beside a reference without a cast stays as red as the references are colourful."""
    colour, semantic, scene = made_scene()
    light = lights(look_of(scene, reference(0.6 * OWN, kinds=(0, 1, 2)), bold=0.0))
    brick = torch.arange(len(colour)) % KINDS == 3
    moved = colour[brick] + light(colour[brick], semantic[brick], light.paint(semantic[brick]))
    before, after = (part.mean(0) - part.mean() for part in (colour[brick], moved))
    assert float(torch.nn.functional.cosine_similarity(before, after, dim=0)) > 0.99


def test_roads_take_no_colour_and_black_and_white_does() -> None:
    """Grey things beside one as colourful as the scene's are material; nothing but grey ones are light."""
    even = torch.full((KINDS,), 0.25).double()
    mean = OWN.double()
    covariance = 0.04 * torch.ones(3, 3).double().expand(KINDS, 3, 3)  # rough: things

    def chroma(codes: Tensor) -> float:
        d = build_dictionary([reference(OWN)], clusters=KINDS)._replace(colour_mean=codes)
        maps, _ = light_maps(mean, covariance, even, torch.eye(KINDS).double(), d, even)
        plants = mean[1] @ maps[1, :3] + maps[1, 3]
        return float((plants.amax() - plants.amin()) / plants.mean())

    own = float((OWN[1].amax() - OWN[1].amin()) / OWN[1].mean())
    grey = OWN.mean(1, keepdim=True).expand(KINDS, 3)
    road = torch.cat([grey[:1], OWN[1:2], grey[2:]])
    assert chroma(road) > 0.9 * own
    assert chroma(grey) < 0.6 * own


def test_a_code_that_another_kind_claims_is_no_match_and_one_that_its_like_claims_is() -> None:
    """Without brick in the reference, brick takes the ground's code; two regions of one kind do not rob each
    other.
    """
    _, _, scene = made_scene()
    twin = scene._replace(
        keys=torch.cat([scene.keys, scene.keys[:1] + 0.05]), share=torch.ones(KINDS + 1) / (KINDS + 1)
    )
    d = build_dictionary([reference(MEADOW)], clusters=KINDS, blend=0.0)
    alike = torch.nn.functional.normalize(twin.keys, dim=1) @ torch.nn.functional.normalize(d.keys, dim=1).T
    right = torch.nn.functional.one_hot(alike.argmax(1), KINDS).double()
    assert float(unrivalled(twin, d, right).min()) > 0.9
    wrong = right.roll(1, 1)
    assert float(unrivalled(twin, d, wrong).max()) < 0.5


def test_a_pin_to_the_scene_itself_changes_no_colour() -> None:
    """Regions that lend each other their styles across soft borders stop so on both sides where one of them
    is pinned.
    """
    scene = made_scene()[2]._replace(contacts=torch.full((KINDS, KINDS), 0.05).fill_diagonal_(0))
    own = own_style(scene)
    config = RegionToneConfig()
    own = own._replace(colour_mean=own.mean, colour_covariance=own.covariance)
    both = concatenate([own, own], ["a", "b"], [1.0, 1.0])
    allowed = torch.ones(KINDS, 2).bool()
    allowed[0, 1] = False
    maps = region_maps(regional(both, scene, allowed, config), both, scene, config, allowed)
    assert (
        maps is not None
        and float((scene.region_mean[:, None] @ maps.matrix + maps.bias[:, None]).abs().max()) < 1e-6
    )
