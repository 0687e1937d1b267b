"""A photograph of the very place: it is found by local features, others are not, and light is measured there."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from fprf.errors import CheckpointError
from fprf.io.images import to_uint8, write_image
from fprf.ops.harmonics import HARMONIC, as_drawn
from fprf.plugins.encoders.config import BundledSemanticConfig
from fprf.plugins.stylizers.config import AdainConfig, RegionToneConfig
from fprf.scenes import Scene
from fprf.splats.captures import look_at_capture
from fprf.splats.config import GaussianSemanticsConfig, LookConfig
from fprf.splats.gaussians import Gaussians
from fprf.splats.restyle import all_around, restyled_harmonics
from fprf.splats.semantics import load_semantics, semantics_tensors
from fprf.style.config import StyleConfig
from fprf.style.dictionary import Reference, StyleDictionary, build_dictionary, choose, concatenate
from fprf.style.files import StyleFile
from fprf.style.light import BLACK_OFFSET
from fprf.style.look import Restyle
from fprf.style.matching import unit
from fprf.style.placed_light import InducingPairs, PlacedLight, fit, placed_light
from fprf.style.placing import (
    Keypoints,
    Landmarks,
    Pairs,
    ViewSamples,
    close_keypoints,
    close_size,
    find_keypoints,
    find_place,
    keypoint_tensors,
    keypoints_from,
    register,
    view_keypoints,
    weighed,
)
from fprf.style.restyle import apply_style
from fprf.style.scene_style import SceneStyle, scene_style

SIZE = (120, 160)
EVERYWHERE = torch.ones(2, 1, dtype=torch.bool)


def picture(seed: int) -> Tensor:
    """Coloured patches of many sizes: what local features live on."""
    draw = np.random.default_rng(seed)
    image = np.full((*SIZE, 3), 0.5, np.float32)
    for _ in range(250):
        height, width = draw.integers(4, 25, 2)
        y = draw.integers(0, SIZE[0] - 4)
        x = draw.integers(0, SIZE[1] - 4)
        image[y : y + height, x : x + width] = draw.uniform(0.1, 0.9, 3)
    return torch.from_numpy(image)


def seen_through(pixel: Tensor) -> Tensor:
    """Directions of pixels, as a pinhole of 160 pixels of focal length sees them."""
    away = (pixel - pixel.new_tensor([SIZE[1] / 2, SIZE[0] / 2])) / 160
    return torch.nn.functional.normalize(torch.cat([away, torch.ones_like(away[:, :1])], 1), dim=1)


def landmarks(image: Tensor) -> Landmarks:
    """A picture as the only view; semantics are the places of its pixels."""
    y, x = torch.meshgrid(torch.arange(SIZE[0]) + 0.5, torch.arange(SIZE[1]) + 0.5, indexing="ij")
    pixel = torch.stack([x.flatten(), y.flatten()], 1)
    samples = ViewSamples(pixel, image.flatten(0, 1), pixel, torch.zeros(3), seen_through)
    return Landmarks((view_keypoints(image),), lambda view: samples)


def relit(image: Tensor) -> Tensor:
    return image**1.5 * torch.tensor([0.9, 0.6, 0.4])


def test_a_part_of_the_place_in_another_light_is_found_to_the_pixel() -> None:
    image = picture(0)
    left, top = 40, 20
    pairs = find_place(landmarks(image), relit(image[top:110, left:150]))
    assert pairs is not None and pairs.agreeing >= 20
    inside = (pairs.semantic[:, 0] - left).abs().max() <= 111 and len(pairs.own) > 0.9 * 110 * 90
    assert bool(inside)
    # The view's own pixels are seen through where they lie: SIFT and the map are right to a fraction of a pixel.
    assert float((pairs.toward - seen_through(pairs.semantic.double())).abs().max()) < 1e-6
    # What it shows there is the same spot in its light; both sides are compared, one of them as a mean of a box.
    apart = (pairs.shown - relit(pairs.own)).abs().mean()
    anywhere = (pairs.shown.flip(0) - relit(pairs.own)).abs().mean()
    assert float(apart) < 0.3 * float(anywhere)
    # Semantics of the samples are their positions in the view: the photograph's pixels are those less its corner.
    off = pairs.pixel + 0.5 + torch.tensor([left, top]) - pairs.semantic[:, :2]
    assert float(off.abs().max()) < 3


@pytest.mark.parametrize("seed", range(1, 6))
def test_another_place_is_not_found(seed: int) -> None:
    assert find_place(landmarks(picture(0)), picture(seed)) is None
    assert find_place(landmarks(picture(0)), torch.full((*SIZE, 3), 0.5)) is None, "nor is nothing"


def test_few_matches_are_looked_at_more_closely() -> None:
    """Where a view has some matches, but too few to be sure, both sides are compared at a larger size: it decides."""
    image = picture(0)
    shown = relit(image)
    few = find_keypoints(image, 20)
    height, width = SIZE
    larger = close_size((width, height))
    assert larger == (640, 480) and close_size((1000, 20)) == (1000, 20)

    def enlarged(picture: Tensor) -> Keypoints:
        pixels = picture.permute(2, 0, 1)[None]
        return close_keypoints(
            interpolate(pixels, larger[::-1], mode="bicubic")[0].permute(1, 2, 0), (width, height)
        )

    samples = landmarks(image).samples
    assert find_place(Landmarks((few,), samples), picture(1), closer=lambda: enlarged(picture(1))) is None
    asked = []

    def closer(view: int) -> Keypoints:
        asked.append(view)
        return enlarged(image)

    known = find_place(Landmarks((few,), samples, closer), shown, closer=lambda: enlarged(shown))
    assert known is not None and asked == [0] and known.agreeing > 40
    # Positions are those of the small pictures: what is shown is the same spot in its light.
    apart = (known.shown - relit(known.own)).abs().mean()
    anywhere = (known.shown.flip(0) - relit(known.own)).abs().mean()
    assert float(apart) < 0.3 * float(anywhere)
    # What differs at a closer look is another place, though some matches agree.
    assert find_place(Landmarks((few,), samples, closer), shown, closer=lambda: enlarged(picture(1))) is None
    # Many matches need no closer look.
    asked.clear()
    everything = Landmarks((view_keypoints(image),), samples, closer)
    assert find_place(everything, shown, closer=lambda: enlarged(shown)) is not None
    assert not asked


def test_what_a_mask_leaves_out_is_not_compared() -> None:
    image = picture(0)
    where = torch.zeros(SIZE, dtype=torch.bool)
    where[:, 80:] = True
    pairs = find_place(landmarks(image), image, where)
    assert pairs is not None and float(pairs.semantic[:, 0].min()) > 78
    assert find_place(landmarks(image), image, torch.zeros_like(where)) is None


def test_keypoints_go_through_a_file_and_damage_is_told() -> None:
    views = (view_keypoints(picture(0)), view_keypoints(torch.zeros(*SIZE, 3)), find_keypoints(picture(1), 7))
    assert len(views[1].position) == 0 < len(views[2].position) <= 7
    tensors = keypoint_tensors(views)
    for before, after in zip(views, keypoints_from(tensors), strict=True):
        assert torch.equal(before.position, after.position) and torch.equal(
            before.descriptor, after.descriptor
        )
    assert keypoints_from({}) == ()
    with pytest.raises(CheckpointError, match="keypoints"):
        keypoints_from({**tensors, "descriptor": tensors["descriptor"][:-1]})
    with pytest.raises(CheckpointError, match="keypoints"):
        keypoints_from({"count": tensors["count"]})


def pairs_of(own: Tensor, shown: Tensor, semantic: Tensor | None = None) -> Pairs:
    """Pairs that count all alike, seen in one direction."""
    count = len(own)
    kind = own.new_zeros(count, 0) if semantic is None else semantic
    ahead = torch.tensor([0.0, 0.0, 1.0]).expand(count, 3)
    return Pairs(own, shown, kind, 20, torch.zeros(3), ahead, torch.zeros(count, 2).long(), torch.ones(count))


def test_known_gains_are_recovered() -> None:
    """Of colours that were lit by gains that follow from what is known of points: own colours say it all."""
    draw = torch.Generator().manual_seed(0)
    what = torch.rand(4000, 5, generator=draw, dtype=torch.float64) - 0.5
    true = torch.rand(5, 3, generator=draw, dtype=torch.float64) - 0.5
    own = torch.rand(4000, 3, generator=draw, dtype=torch.float64)
    shown = (own + BLACK_OFFSET) * (what @ true).exp() - BLACK_OFFSET
    nothing = what.new_zeros(4000, 0)
    found = fit(pairs_of(own, shown), what, nothing, torch.ones(4000, 1), torch.ones(1))
    # The ridge of 0.003 beside a variance of 1/12 takes 3.6 % of the coefficients.
    assert float((found.gains - true).abs().max()) < 0.06 * float(true.abs().max())
    assert float(found.slopes) > 0.98


def test_a_region_whose_own_colours_say_nothing_takes_the_colours_that_are_shown() -> None:
    """A sky with other clouds, beside a façade in another light."""
    draw = torch.Generator().manual_seed(0)
    belongs = torch.eye(2, dtype=torch.float64)[torch.arange(4000) % 2]
    what = torch.cat([belongs, torch.ones(4000, 1)], 1)
    own = 0.2 + 0.6 * torch.rand(4000, 1, generator=draw, dtype=torch.float64).expand(4000, 3)
    clouds = 0.2 + 0.6 * torch.rand(4000, 1, generator=draw, dtype=torch.float64).expand(4000, 3)
    shown = torch.where(belongs[:, :1] > 0, clouds, 0.5 * own)
    nothing = what.new_zeros(4000, 0)
    found = fit(pairs_of(own, shown), what, nothing, belongs, torch.ones(2))
    # The slope of unrelated colours deviates by 1 / sqrt(2000) = 0.022; two pairs of 2000 are for 1.
    assert abs(float(found.slopes[0])) < 0.06
    assert float(found.slopes[1]) > 0.95
    # As a thing it keeps half of its contrast whatever the photograph shows.
    thing = fit(pairs_of(own, shown), what, nothing, belongs, torch.zeros(2)).slopes
    assert torch.allclose(thing, (1 + found.slopes) / 2)
    # Of 2000 colours of deviation 0.17 a mean is known to 0.004; the ridge of 0.002 beside a half takes 0.3 %.
    assert float((what[0] @ found.colours - 0.5).abs().max()) < 0.02


def test_a_smooth_sky_in_the_photograph_takes_nothing_of_a_rough_one() -> None:
    """A sky of many captured skies is rough, and counts as a thing by its own colours."""
    draw = torch.Generator().manual_seed(0)
    own = 0.2 + 0.6 * torch.rand(4000, 3, generator=draw, dtype=torch.float64)
    shown = torch.tensor([0.5, 0.6, 0.8]) + 0.01 * torch.randn(4000, 3, generator=draw, dtype=torch.float64)
    what = torch.ones(4000, 1, dtype=torch.float64)
    found = fit(pairs_of(own, shown), what, what[:, :0], torch.ones(4000, 1), torch.zeros(1))
    # Two pairs of 4002 are for 1.
    assert float(found.slopes) < 0.01


def test_what_stands_before_a_thing_does_not_light_it() -> None:
    """Half of the pairs show branches, dark, before a sky."""
    draw = torch.Generator().manual_seed(0)
    own = 0.6 + 0.2 * torch.rand(400, 3, generator=draw)
    shown = 0.9 * own
    branch = torch.arange(400) % 2 == 0
    shown[branch] = 0.1
    sky = torch.eye(4)[0].expand(400, 4)
    there = torch.where(branch[:, None], torch.eye(4)[1], sky)
    told = weighed(pairs_of(own, shown, sky), there, torch.zeros(4))
    assert told is not None
    assert told.weight.tolist() == (~branch).float().tolist()
    what = torch.ones(400, 1)
    found = fit(told, what, what[:, :0], torch.ones(400, 1), torch.ones(1))
    alone = fit(
        pairs_of(own[~branch], shown[~branch]), what[:200], what[:200, :0], torch.ones(200, 1), torch.ones(1)
    )
    for one, other in zip(found, alone, strict=True):
        assert torch.allclose(one, other)
    # Where nothing at all is the same, nothing is measured.
    nothing = fit(
        told._replace(weight=torch.zeros(400)), what, what[:, :0], torch.ones(400, 1), torch.ones(1)
    )
    assert float(nothing.gains.abs().max()) == 0 and float(nothing.slopes) == 1
    assert weighed(pairs_of(own, shown, sky), -sky, torch.zeros(4)) is None, "nor recognised"


def test_matches_along_a_line_keep_the_map_that_has_an_inverse() -> None:
    """A horizon: least squares alone would shrink what lies across it to a hundredth."""
    x = torch.linspace(5, 155, 40)
    a = torch.stack([x, torch.full_like(x, 60.0)], 1)
    b = torch.stack([0.9 * x + 3, torch.full_like(x, 0.5)], 1)
    known = register(a, b, (160, 120), 10)
    assert known is not None and known.agreeing == 40
    # The turn is none and the scale is 0.9 both ways, as along the line.
    assert torch.allclose(known.matrix[:, :2], 0.9 * torch.eye(2).double(), atol=1e-3)


def scene_of(count: int = 400) -> tuple[Tensor, Tensor, SceneStyle]:
    """Colours and semantics of points of two kinds."""
    draw = torch.Generator().manual_seed(1)
    kind = torch.arange(count) % 2
    colour = 0.2 + 0.4 * torch.rand(count, 3, generator=draw)
    semantic = torch.eye(4)[kind] + 0.02 * torch.randn(count, 4, generator=draw)
    return colour, semantic, scene_style(colour, semantic, torch.ones(count), None, 2, 0)


GAIN = torch.tensor([[0.5, 0.6, 0.9], [1.3, 1.1, 0.7]])
"""Of both kinds."""


def lit_reference(*kinds: int, name: str = "r") -> Reference:
    """A reference that shows points of these kinds in a new light, and looks like something else otherwise."""
    colour, semantic, _ = scene_of()
    kind = torch.arange(len(colour)) % 2
    some = torch.isin(kind, torch.tensor(kinds))
    shown = (colour + BLACK_OFFSET) * GAIN[kind] - BLACK_OFFSET
    pairs = pairs_of(colour[some], shown[some], semantic[some])
    other = 1 - colour
    return Reference(name, other, semantic, colour=other, placed=pairs)


def dictionary_of(*references: Reference) -> StyleDictionary:
    return build_dictionary(references, clusters=2, blend=0.0)


def colours_of(scene: SceneStyle) -> tuple[Tensor, Tensor]:
    return scene.region_mean, scene.region_covariance


def placed_of(scene: SceneStyle, *references: Reference) -> PlacedLight:
    every = torch.ones(2, len(references), dtype=torch.bool)
    placed = placed_light(scene, dictionary_of(*references), every, colours_of(scene))
    assert placed is not None
    return placed


def test_points_take_the_gain_of_their_kind_and_what_was_not_seen_is_left() -> None:
    _, semantic, scene = scene_of()
    kind = torch.arange(len(semantic)) % 2
    ahead = torch.tensor([0.0, 0.0, 1.0]).expand(len(semantic), 3)
    measured = placed_of(scene, lit_reference(0, 1))(semantic, None, ahead)
    assert 0.8 < float(measured.share.min()) <= float(measured.share.max()) < 1
    colour = scene_of()[0]
    lit = colour + measured.change(colour) / measured.share
    truth = (colour + BLACK_OFFSET) * GAIN[kind] - BLACK_OFFSET
    assert float((lit - truth).abs().max()) < 0.05
    half = placed_of(scene, lit_reference(1))(semantic).share[:, 0]
    assert float(half[kind == 0].max()) < 0.1 and float(half[kind == 1].min()) > 0.8


def test_several_references_share_by_weight_and_what_is_forbidden_is_not_taken() -> None:
    _, semantic, scene = scene_of()
    here = lit_reference(0, 1)
    elsewhere = here._replace(name="elsewhere", placed=None, content=here.content**2)
    alone = placed_of(scene, here)(semantic).share
    weighed = placed_of(scene, here._replace(weight=3.0), elsewhere)(semantic).share
    assert torch.allclose(weighed, 0.75 * alone, atol=1e-4)
    d = dictionary_of(here, elsewhere)
    shown = list(d.names).index("r")
    allowed = torch.ones(2, 2, dtype=torch.bool)
    allowed[0, shown] = False
    placed = placed_light(scene, d, allowed, colours_of(scene))
    assert placed is not None and float(placed.trust[0]) == 0 < float(placed.trust[1])
    only = torch.zeros(2, dtype=torch.bool)
    only[1 - shown] = True
    assert placed_light(scene, choose(d, only)[0], EVERYWHERE, colours_of(scene)) is None
    # Without pairs nobody looked, and joining keeps what is known.
    assert placed_light(scene, d._replace(placed=()), allowed, colours_of(scene)) is None
    parts = [choose(d, torch.arange(2) == i)[0] for i in range(2)]
    joined = concatenate(parts, d.names, [1.0, 1.0])
    assert [each is None for each in joined.placed] == [each is None for each in d.placed]


def sunny_and_shaded() -> tuple[Tensor, SceneStyle, Pairs]:
    """One kind of wall: the left of it was in the light of the right, and is shown in half of it."""
    draw = torch.Generator().manual_seed(2)
    colour, semantic, scene = scene_of(1000)
    away = 2 * torch.rand(len(colour), 2, generator=draw) - 1
    points = torch.cat([away, torch.ones_like(away[:, :1])], 1)
    gain = torch.where(points[:, :1] < 0, 0.5, 1.0)
    shown = (colour + BLACK_OFFSET) * gain - BLACK_OFFSET
    eye = torch.tensor([3.0, -1.0, 2.0])
    toward = torch.nn.functional.normalize(points, dim=1)
    pairs = pairs_of(colour, shown, semantic)._replace(eye=eye, toward=toward)
    return points + eye, scene, pairs


def test_shade_and_sun_on_things_of_one_kind_are_told_by_where_they_lie() -> None:
    points, scene, pairs = sunny_and_shaded()
    reference = Reference("r", 1 - pairs.own, pairs.semantic, colour=1 - pairs.own, placed=pairs)
    placed = placed_of(scene, reference)

    def lit(points: Tensor | None) -> Tensor:
        measured = placed(pairs.semantic, None, points)
        colours: Tensor = pairs.own + measured.change(pairs.own) / measured.share
        return colours

    # Without places all take a mean of both; away from the edge, which likeness smooths over, each is its own.
    sure = (points - pairs.eye)[:, 0].abs() > 0.25
    unplaced = float((lit(None) - pairs.shown)[sure].abs().mean())
    assert float((lit(points) - pairs.shown)[sure].abs().mean()) < 0.5 * unplaced
    # Twice as far in the same direction is seen there, too, and behind the eye nothing is near.
    assert torch.allclose(lit(pairs.eye + 2 * (points - pairs.eye)), lit(points), atol=1e-3)
    assert torch.allclose(lit(2 * pairs.eye - points), lit(None), atol=0.02)


def test_what_points_are_near_to_has_their_likeness_for_a_product() -> None:
    """n of two points, multiplied, against the formula in float64."""
    _, scene, pairs = sunny_and_shaded()
    centre = scene.semantic_mean
    inducing = InducingPairs(pairs, centre)
    some = slice(0, None, 8)
    assert len(inducing.keys) == 125
    direction = unit(pairs.semantic[some], centre).double()
    toward = pairs.toward[some].double()
    n = inducing(direction, toward) @ inducing.root.double()
    wanted = (direction @ direction.T + 5 * (toward @ toward.T) - 6).exp()
    # The ridge of 1e-4 takes as much of each pair's own; roots in float32 are of matrices of a condition of 1e6.
    assert float((n @ n.T - wanted).abs().max()) < 2e-3


def test_gaussians_of_captures_are_lit_where_the_views_show_them() -> None:
    points, scene, pairs = sunny_and_shaded()
    d = dictionary_of(Reference("r", 1 - pairs.own, pairs.semantic, colour=1 - pairs.own, placed=pairs))
    stylizer = AdainConfig().build(dictionary=d, scene=scene)
    look = Restyle(stylizer, placed=placed_light(scene, d, EVERYWHERE, colours_of(scene)))
    harmonics = ((pairs.own - 0.5) / HARMONIC)[:, None]
    here = restyled_harmonics(harmonics, points, pairs.semantic, look)
    moved = restyled_harmonics(harmonics, points + 7, pairs.semantic, look, points)
    assert torch.equal(here, moved)
    assert not torch.allclose(here, restyled_harmonics(harmonics, points + 7, pairs.semantic, look))
    drawn = as_drawn(here, all_around(1))[:, 0] * HARMONIC + 0.5
    flat = look.colour(lambda content: content, pairs.own, pairs.semantic, points=points)  # type: ignore[arg-type]
    inside = ((drawn > 0.01) & (drawn < 0.99)).all(1)
    assert torch.allclose(drawn[inside], flat[inside], atol=1e-4)


def test_fields_and_gaussians_take_the_same_and_strength_scales_it() -> None:
    colour, semantic, scene = scene_of()
    d = dictionary_of(lit_reference(0, 1))
    # An affine stylizer without colours behind it acts on both alike.
    stylizer = AdainConfig().build(dictionary=d, scene=scene)
    look = Restyle(stylizer, placed=placed_light(scene, d, EVERYWHERE, colours_of(scene)))

    def drawn(look: Restyle) -> Tensor:
        harmonics = ((colour - 0.5) / HARMONIC)[:, None]
        restyled = restyled_harmonics(harmonics, torch.zeros_like(colour), semantic, look)
        return as_drawn(restyled, all_around(1))[:, 0] * HARMONIC + 0.5

    def shown(look: Restyle) -> Tensor:
        at = torch.zeros_like(colour)
        return look.colour(lambda content: content, colour, semantic, points=at)  # type: ignore[arg-type]

    both = drawn(look)
    inside = ((both > 0.01) & (both < 0.99)).all(1)
    assert int(inside.sum()) > 0.8 * len(both)
    assert torch.allclose(both[inside], shown(look)[inside], atol=1e-4)
    middle = shown(replace(look, strength=0.5))
    assert torch.allclose(middle[inside], 0.5 * (colour + shown(look))[inside], atol=1e-4)
    assert torch.equal(shown(replace(look, strength=0.0)), colour)


def wall() -> Gaussians:
    """A wall of coloured patches, turned to the cameras."""
    image = picture(3)[::2, ::2]
    y, x = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")
    means = torch.stack([(x - 40) / 40, (30 - y) / 40, torch.zeros_like(x)], 2).flatten(0, 1)
    count = len(means)
    return Gaussians(
        means=means,
        quaternions=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(count, 4).contiguous(),
        log_scales=torch.full((count, 3), 0.013).log(),
        logits=torch.full((count,), 6.0),
        harmonics=((image.flatten(0, 1) - 0.5) / HARMONIC)[:, None],
    )


@pytest.fixture(scope="module")
def scene() -> Scene:
    config = LookConfig(
        semantic=GaussianSemanticsConfig(encoder=BundledSemanticConfig()),
        regions=4,
        views=6,
        size=(160, 120),
        up=(0.0, 1.0, 0.0),
    )
    return look_at_capture(wall(), False, config.semantic.encoder.build(), config)


def best_view(scene: Scene) -> int:
    """The view that shows most of it."""
    shown = [float(scene.render(scene.cameras, v).opacity.sum()) for v in range(len(scene.cameras))]
    return int(np.argmax(shown))


def test_a_capture_takes_the_light_of_a_photograph_of_itself(scene: Scene, tmp_path: Path) -> None:
    view = best_view(scene)
    plain = scene.render(scene.cameras, view).rgb
    solid = scene.render(scene.cameras, view).opacity > 0.9
    truth = (plain * torch.tensor([0.3, 0.5, 0.9])).clamp(0, 1)
    write_image(tmp_path / "dusk.png", to_uint8(truth[:, : truth.shape[1] * 2 // 3]))
    write_image(tmp_path / "other.png", to_uint8(picture(8)))

    def off(name: str, landmarks: bool) -> float:
        encoders = scene.encoders()
        if not landmarks:
            encoders = encoders._replace(landmarks=None)
        style = StyleConfig(references=(tmp_path / name,), stylizer=RegionToneConfig())
        styled = apply_style(scene, StyleFile(style), encoders)
        recognised = landmarks and name == "dusk.png"
        assert (styled.restyle.placed is not None) == recognised
        assert (
            any(note.startswith("dusk.png: shows this very place") for note in styled.controls.notes)
            == recognised
        )
        shown = scene.restyled(styled.restyle).render(scene.cameras, view).rgb
        return float((shown - truth)[solid].square().mean())

    assert off("dusk.png", True) < 0.5 * off("dusk.png", False)
    assert off("other.png", True) == off("other.png", False), "another place changes nothing"


def test_what_earlier_versions_found_is_read_and_places_nothing(scene: Scene) -> None:
    found = scene.found()  # type: ignore[attr-defined]
    tensors = semantics_tensors(found)
    again = load_semantics(tensors, len(found.features))
    assert again.seen is not None and len(again.seen.keypoints) == 6
    assert torch.equal(again.seen.cameras.pose, found.seen.cameras.pose)
    old = {name: t for name, t in tensors.items() if not name.startswith(("seen.", "keypoints."))}
    assert load_semantics(old, len(found.features)).seen is None


def test_no_keypoints_match_nothing() -> None:
    none = Keypoints(torch.zeros(0, 2), torch.zeros(0, 128, dtype=torch.uint8))
    blank = Landmarks(
        (none,), lambda view: ViewSamples(*(torch.zeros(0, 2),) * 3, torch.zeros(3), seen_through)
    )
    assert find_place(blank, picture(0)) is None
