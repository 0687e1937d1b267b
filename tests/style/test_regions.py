"""Regions: their statistics; by number, pixel, mask and key; what users ask of them; the list that explains
them.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from style_cases import points, region_adain
from tiny_world import World

from fprf.errors import CheckpointError, DataError, UsageError
from fprf.plugins.stylizers.config import AdainConfig
from fprf.style.config import StyleConfig
from fprf.style.files import RegionKey, StyleFile
from fprf.style.match_maps import explain, region_row, region_tile
from fprf.style.regions import (
    RegionControls,
    RegionMatch,
    Regions,
    find_regions,
    key_of,
    membership_view,
    region_controls,
)
from fprf.style.restyle import Styled, apply_style
from fprf.style.scene_style import Membership, from_tensors, region_smoothing, scene_style, to_tensors
from fprf.training.field_scene import load_style


def regions_of(world: World, keys: dict[str, RegionKey] | None = None) -> Regions:
    trained = world.load()
    return Regions(trained, *load_style(trained.run), keys or {})


def test_a_pixel_means_the_region_that_most_of_it_belongs_to(world: World) -> None:
    regions = regions_of(world)
    assert find_regions(regions, "1") == [RegionMatch(1, "1")]
    share, _ = membership_view(regions, 2, 32)
    for x, y in ((0, 0), (31, 23), (15, 20), (7, 3)):
        (found,) = find_regions(regions, f"0002:{x},{y}")
        assert found.number == int(share[y, x].argmax()) and found.name == str(found.number)
    assert find_regions(regions, "0002:7.9,3.2") == find_regions(regions, "0002:7,3")


def draw(folder: Path, white: np.ndarray) -> Path:
    path = folder / "drawn = 1.png"
    cv2.imwrite(str(path), white.astype(np.uint8) * 255)
    return path


def test_a_mask_means_what_it_covers(world: World, tmp_path: Path) -> None:
    regions = regions_of(world)
    share, opacity = membership_view(regions, 2, 32)
    best = share.argmax(-1)
    chosen = int(best.flatten().mode().values)
    inside = ((best == chosen) & (opacity > 0.5)).numpy()
    large = np.kron(inside, np.ones((4, 4)))  # drawn on a larger copy of the view
    found = [each.number for each in find_regions(regions, f"0002:{draw(tmp_path, large)}")]
    assert chosen in found
    everything = find_regions(regions, f"0002:{draw(tmp_path, np.ones((24, 32)))}")
    mass = (share * opacity[..., None]).sum((0, 1))
    assert {each.number for each in everything} == set((mass >= 1).nonzero().flatten().tolist()) | {
        int(mass.argmax())
    }


def test_keys_find_their_own_regions_and_those_like_them(world: World) -> None:
    regions = regions_of(world)
    assert regions.basis is not None
    count = len(regions.scene_style.share)
    middle = regions.scene_style.semantic_mean
    keys = {f"r{k}": key_of(regions, k) for k in range(count)}
    assert {len(key) for key in keys.values()} == {len(regions.basis.mean)}, "in the encoder's own channels"
    weaker = middle + 0.4 * (regions.scene_style.keys - middle)
    for known in (keys, {f"r{k}": tuple(regions.basis.lift(weaker[k]).tolist()) for k in range(count)}):
        for k, name in enumerate(known):
            (found,) = find_regions(regions._replace(keys=known), name)
            assert (found.number, found.name) == (k, name) and found.alike == pytest.approx(1.0, abs=1e-4)


@pytest.fixture(scope="module")
def styled(_world: World) -> Styled:
    return apply_style(_world.load(), StyleFile(style_of(_world.references)))


def style_of(references: Sequence[Path]) -> StyleConfig:
    return StyleConfig(references=tuple(references), clusters=3)


def controls_of(
    world: World, styled: Styled, file: StyleFile | None = None, **wishes: object
) -> RegionControls:
    style = replace(style_of(world.references), **wishes)  # type: ignore[arg-type]
    old = styled.controls.regions
    regions = Regions(old.scene, old.scene_style, old.basis, {} if file is None else file.regions)
    return region_controls(regions, styled.dictionary, style)


def test_forbidding_keeping_and_strengths(world: World, styled: Styled) -> None:
    controls = controls_of(
        world, styled, forbid=("0=snow.png",), keep=("1",), region_strength=("2=0.25", "0=0.5")
    )
    assert controls.allowed[0].tolist() == [name != "snow.png" for name in styled.dictionary.names]
    assert controls.strength[:3].tolist() == [0.5, 0.0, 0.25]


def test_poor_matches_are_kept_unless_pinned(world: World, styled: Styled) -> None:
    score = styled.controls.score
    best = score.amax(1)
    order = best.argsort()
    limit = float((best[order[0]] + best[order[1]]) / 2)
    controls = controls_of(world, styled, keep_below=limit)
    assert (controls.strength == 0).nonzero().flatten().tolist() == [int(order[0])]
    assert bool((controls_of(world, styled, keep_below=-1.0).strength == 1).all())
    pinned = controls_of(world, styled, keep_below=limit, pin=(f"{int(order[0])}=0",))
    assert bool((pinned.strength == 1).all())
    # What is forbidden does not count as a match.
    own = styled.dictionary.names.index("dusk.png")
    k = int(score[:, styled.dictionary.reference == own].amax(1).argmax())
    left = float(score[k, styled.dictionary.reference != own].max())
    assert (
        controls_of(world, styled, keep_below=1.0)
        .notes[-1]
        .startswith("keep_below 1: every region stays as it is")
    )
    forbidden = controls_of(
        world, styled, keep_below=left + 1e-3 if left < 0.999 else 1.0, forbid=(f"{k}=dusk.png",)
    )
    assert forbidden.strength[k] == 0


@pytest.mark.parametrize(
    ("wishes", "said"),
    [
        ({"keep": ("1",), "pin": ("1=0",)}, "region 1"),
        ({"keep": ("1",), "region_strength": ("1=0.5",)}, "region 1"),
        ({"forbid": ("1=0", "1=1")}, "region 1"),
        ({"pin": ("1=0",), "forbid": ("1=0",)}, "region 1"),
        ({"pin": ("1=autumn.jpg",)}, r"autumn\.jpg.*0 dusk\.png, 1 snow\.png"),
        ({"keep": ("44",)}, "region 44"),
    ],
)
def test_contradictions_and_unknown_names(
    world: World, styled: Styled, wishes: dict[str, object], said: str
) -> None:
    with pytest.raises(UsageError, match=said):
        controls_of(world, styled, **wishes)


def test_what_is_saved_means_the_same_on_the_same_scene(world: World, styled: Styled) -> None:
    controls = controls_of(
        world,
        styled,
        pin=("0=snow.png", "0002:15,20=1"),
        forbid=("1=0",),
        keep=("2",) if len(styled.scene_style.share) > 2 else (),
    )
    saved = controls.saved
    assert all(
        text.partition("=")[0] in saved.regions
        for text in (*saved.style.pin, *saved.style.forbid, *saved.style.keep)
    )
    old = styled.controls.regions
    again = region_controls(
        Regions(old.scene, old.scene_style, old.basis, saved.regions), styled.dictionary, saved.style
    )
    assert torch.equal(again.allowed, controls.allowed) and torch.equal(again.strength, controls.strength)
    assert again.saved == saved, "names and keys stay as they are, however often it is saved"
    other = Regions(
        old.scene,
        old.scene_style,
        old.basis,
        {"sky": old.scene_style.keys[0].tolist() * 99},
        "another encoder",
    )
    here = region_controls(other, styled.dictionary, replace(style_of(world.references), keep=("0",))).saved
    assert here.regions == saved.regions and here.style.keep == ("region0",), (
        "keys of another encoder are not kept"
    )
    named = {text.partition("=")[0] for text in (*saved.style.pin, *saved.style.forbid, *saved.style.keep)}
    assert (
        len(again.notes) == len(named)
        and "region 'region0' of the style is region 0 here (cosine 1.00)" in again.notes
    )


def test_a_photograph_with_an_equals_sign_in_its_name_is_saved_by_number(
    world: World, styled: Styled
) -> None:
    style = style_of((Path("a=b.png"), *world.references[1:]))
    dictionary = styled.dictionary._replace(
        names=tuple({"dusk.png": "a=b.png"}.get(n, n) for n in styled.dictionary.names)
    )
    first = region_controls(styled.controls.regions, dictionary, replace(style, pin=("0=0",)))
    again = region_controls(
        styled.controls.regions._replace(keys=first.saved.regions), dictionary, first.saved.style
    )
    assert first.saved.style.pin == ("region0=0",) and torch.equal(again.allowed, first.allowed)


def test_the_place_of_a_region_is_in_the_view_that_shows_most_of_it(world: World) -> None:
    regions = regions_of(world)
    names = regions.scene.names
    shares = [membership_view(regions, v, 32) for v in range(len(names))]
    mass = torch.stack([(share * opacity[..., None]).mean((0, 1)) for share, opacity in shares])
    for each in explain(regions):
        view = names.index(each.view)
        k = each.number
        assert float(mass[view, k]) >= 0.95 * float(mass[:, k].max())
        own = shares[view][0][each.pixel[1], each.pixel[0], k]
        assert float(own) >= 0.5 * float(shares[view][0][..., k].max())
        if float(own) > 0.5:
            assert find_regions(regions, f"{each.view}:{each.pixel[0]},{each.pixel[1]}")[0].number == k


@pytest.mark.parametrize("stylizer", [AdainConfig(), region_adain()], ids=lambda s: type(s).__name__)
def test_what_regions_take_is_the_stylizers_match_at_their_keys(world: World, stylizer: object) -> None:
    trained = world.load()
    style = StyleConfig(references=world.references, clusters=3, keep=("1",), forbid=("0=0",))
    styled = apply_style(trained, StyleFile(replace(style, stylizer=stylizer)))  # type: ignore[arg-type]
    found = explain(styled.controls.regions, styled)
    match = styled.restyle.stylizer.match(styled.scene_style.keys)
    for each in found:
        for taken in each.taken:
            own = styled.dictionary.reference == styled.dictionary.names.index(taken.name)
            assert taken.share == pytest.approx(float(match[each.number, own].sum()), abs=1e-5)
            assert taken.score == pytest.approx(float(styled.controls.score[each.number, own].max()))
        assert [t.share for t in each.taken] == sorted((t.share for t in each.taken), reverse=True)
        bits = -(match[each.number] * match[each.number].clamp_min(1e-30).log2()).sum()
        assert each.entropy == pytest.approx(float(bits), abs=1e-4)
    assert [each.strength for each in found][:2] == [1.0, 0.0] and [each.restricted for each in found][
        :2
    ] == [True, False]
    tile = region_tile(found[1], styled.dictionary.names)
    assert tile.lines[-1] == "kept as it is" and sum(tile.shares) == 0
    assert sum(region_tile(found[0], styled.dictionary.names).shares) == pytest.approx(1, abs=1e-4)
    row = region_row(found[0])
    assert {"references", "entropy_bits", "strength", "restricted"} < row.keys() and len(
        row["references"]
    ) == 2


@pytest.mark.parametrize(
    "text",
    ["17", "sky", "0099:1,1", "²", "0002:32,0", "0002:-1,0", "0002:5,5", "0002:black.png", "0002:absent.png"],
)
def test_what_means_nothing_is_refused(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    """Places outside of the view or where nothing is, masks of nothing, keys of another encoder."""
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("black.png", np.zeros((24, 32), np.uint8))
    for keys in ({}, {"sky": (1.0, 2.0)}):
        regions = regions_of(world, keys)
        if text == "0002:5,5":
            with torch.no_grad():
                regions.scene.model.get_parameter("field.to_density.weight").fill_(-1e6)
        with pytest.raises(DataError if text == "0002:absent.png" else UsageError):
            find_regions(regions, text)


def weighted() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return *points(1200), torch.rand(1200)


def test_regions_are_the_clusters_and_their_statistics_those_of_the_soft_membership() -> None:
    content, semantic, weights = weighted()
    scene = scene_style(content, semantic, weights, None, 3, 0)
    assert scene.keys.shape == (3, 4)
    share = Membership(scene.keys, scene.semantic_mean)(semantic).double()
    for k in range(3):
        w = share[:, k] * weights
        mean = (w[:, None] * content).sum(0) / w.sum()
        apart = content - mean
        torch.testing.assert_close(scene.region_mean[k].double(), mean, rtol=1e-4, atol=1e-5)
        own = (w[:, None, None] * apart[:, :, None] * apart[:, None, :]).sum(0) / w.sum()
        torch.testing.assert_close(scene.region_covariance[k].double(), own, rtol=1e-4, atol=1e-4)
        assert float(scene.share[k]) == pytest.approx(float(w.sum() / weights.double().sum()), rel=1e-5)
    assert len(share.argmax(1).unique()) == 3


def test_without_semantics_there_is_one_region() -> None:
    content, _, weights = weighted()
    scene = scene_style(content, None, weights, None, 8, 0)
    assert scene.keys.shape == (1, 0) and scene.semantic_mean.shape == (0,)
    torch.testing.assert_close(scene.region_mean[0], scene.mean)
    torch.testing.assert_close(scene.region_covariance[0], scene.covariance)
    assert scene.share.tolist() == [1.0]


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 30), st.integers(1, 40), st.integers(1, 3), st.sampled_from([0.0, 1e-3, 1.0, 1e4]))
def test_any_scene_has_a_finite_style(n: int, regions: int, d: int, spread: float) -> None:
    content = torch.randn(n, 3) * spread
    semantic = torch.randn(n, d) * spread + 5
    scene = scene_style(content, semantic, torch.rand(n) + 0.01, None, regions, 0)
    assert all(bool(t.isfinite().all()) for t in scene)
    assert 1 <= len(scene.keys) <= min(n, regions)
    assert bool((scene.share > 0).all())
    share = Membership(scene.keys, scene.semantic_mean)(semantic)
    torch.testing.assert_close(share.sum(1), torch.ones(n), rtol=0.0, atol=1e-6)


def test_tensors_round_trip_and_runs_without_contacts_are_read() -> None:
    tensors = to_tensors(scene_style(*weighted(), None, 3, 0))
    assert all(torch.equal(value, tensors[name]) for name, value in from_tensors(tensors)._asdict().items())
    del tensors["contacts"]
    assert torch.equal(from_tensors(tensors).contacts, torch.zeros(3, 3))


@pytest.mark.parametrize(
    ("name", "value"),
    [("share", None), ("region_mean", torch.zeros(3, 9)), ("keys", torch.full((3, 4), float("inf")))],
)
def test_damaged_tensors_are_named(name: str, value: torch.Tensor | None) -> None:
    tensors = to_tensors(scene_style(*weighted(), None, 3, 0))
    del tensors[name]
    with pytest.raises(CheckpointError, match=name):
        from_tensors(tensors if value is None else tensors | {name: value})


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 6), st.floats(0, 1e4), st.integers(0, 99))
def test_smoothing_mixes_and_keeps_the_mean_over_the_scene(
    regions: int, smoothness: float, seed: int
) -> None:
    draw = torch.Generator().manual_seed(seed)
    scene = scene_style(*weighted(), None, 8, 0)
    contacts = torch.rand(regions, regions, generator=draw)
    share = torch.rand(regions, generator=draw) + 0.01
    scene = scene._replace(contacts=contacts + contacts.T, share=share / share.sum())
    smooth = region_smoothing(scene, smoothness)
    assert bool((smooth >= -1e-12).all())
    torch.testing.assert_close(smooth.sum(1), torch.ones(regions, dtype=torch.float64))
    torch.testing.assert_close(scene.share.double() @ smooth, scene.share.double())
    far = region_smoothing(scene, 1e9)
    torch.testing.assert_close(far, scene.share.double().expand(regions, -1), rtol=0.0, atol=1e-5)
