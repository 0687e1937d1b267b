"""Regions by number, pixel, mask and key, on the tiny town."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tiny_world import World

from fprf.errors import DataError, UsageError
from fprf.style.files import Key
from fprf.training.loading import Trained, load_style
from fprf.training.regions import ALIKE, RegionMatch, Regions, find_regions, key_of, membership_view


def regions_of(world: World, keys: dict[str, Key] | None = None) -> Regions:
    trained = world.load()
    return Regions(trained, *load_style(trained.run), keys or {})


def trained_of(regions: Regions) -> Trained:
    assert isinstance(regions.views, Trained)
    return regions.views


def test_numbers_are_the_scenes(world: World) -> None:
    regions = regions_of(world)
    count = len(regions.scene.share)
    assert find_regions(regions, "1") == [RegionMatch(1, "1")] and count >= 2
    with pytest.raises(UsageError, match=f"region 17: regions go from 0 to {count - 1}; --explain lists them"):
        find_regions(regions, "17")


def test_a_pixel_means_the_region_that_most_of_it_belongs_to(world: World) -> None:
    regions = regions_of(world)
    share, _ = membership_view(regions, 2, 32)
    for x, y in ((0, 0), (31, 23), (15, 20), (7, 3)):
        (found,) = find_regions(regions, f"0002:{x},{y}")
        assert found.number == int(share[y, x].argmax()) and found.name == str(found.number)
    assert find_regions(regions, "0002:7.9,3.2") == find_regions(regions, "0002:7,3")


@pytest.mark.parametrize("place", ["32,0", "0,24", "-1,0", "5,99"])
def test_pixels_outside_are_refused(world: World, place: str) -> None:
    with pytest.raises(UsageError, match=r"0002:.*: outside of the view; x goes from 0 to 31, y from 0 to 23"):
        find_regions(regions_of(world), f"0002:{place}")


def test_a_pixel_that_sees_nothing_is_refused(world: World) -> None:
    regions = regions_of(world)
    with torch.no_grad():
        trained_of(regions).model.get_parameter("field.to_density.weight").fill_(-1e6)
    with pytest.raises(UsageError, match="there is nothing at that pixel"):
        find_regions(regions, "0002:5,5")


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
    assert {each.number for each in everything} == set((mass >= 1).nonzero().flatten().tolist()) | {int(mass.argmax())}


def test_masks_that_say_nothing_are_named(world: World, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"drawn = 1\.png: the mask selects nothing of view 0002"):
        find_regions(regions_of(world), f"0002:{draw(tmp_path, np.zeros((24, 32)))}")
    with pytest.raises(DataError, match=r"absent\.png"):
        find_regions(regions_of(world), f"0002:{tmp_path / 'absent.png'}")


@pytest.mark.parametrize("text", ["sky", "0099:1,1", "a-view", "-1", "1.5", "²"])
def test_what_names_nothing_is_told_with_what_could(world: World, text: str) -> None:
    with pytest.raises(UsageError, match=r"neither a number, nor VIEW:X,Y or VIEW:MASK\.png .*\(0000 … 0009\)"):
        find_regions(regions_of(world), text)


def test_keys_find_their_own_regions_and_those_like_them(world: World) -> None:
    regions = regions_of(world)
    assert regions.basis is not None
    count, middle = len(regions.scene.share), regions.scene.semantic_mean
    keys = {f"r{k}": key_of(regions, k) for k in range(count)}
    assert {len(key) for key in keys.values()} == {len(regions.basis.mean)}, "in the encoder's own channels"
    weaker = middle + 0.4 * (regions.scene.keys - middle)
    for given in (keys, {f"r{k}": tuple(regions.basis.lift(weaker[k]).tolist()) for k in range(count)}):
        for k, name in enumerate(given):
            (found,) = find_regions(regions._replace(keys=given), name)
            assert (found.number, found.name) == (k, name) and found.alike == pytest.approx(1.0, abs=1e-4)


def test_several_regions_may_be_like_one_and_one_may_be_like_none(world: World) -> None:
    regions = regions_of(world)
    assert regions.basis is not None
    units = torch.nn.functional.normalize(regions.scene.keys - regions.scene.semantic_mean, dim=1)
    first = regions._replace(keys={"r0": key_of(regions, 0)})
    alike = (units @ units[0]).tolist()
    expected = [k for k, cosine in enumerate(alike) if cosine >= ALIKE]
    found = find_regions(first, "r0")
    assert [each.number for each in found] == expected and [f.alike for f in found] == pytest.approx(
        [alike[k] for k in expected], abs=1e-4
    )
    # A second key that is the opposite of the first takes none of its regions.
    away = regions.basis.lift(regions.scene.semantic_mean - units[0])
    both = regions._replace(keys={**first.keys, "r1": tuple(away.tolist())})
    again = find_regions(both, "r0")
    assert [each._replace(alike=0.0) for each in again] == [each._replace(alike=0.0) for each in found]
    assert [each.alike for each in again] == pytest.approx([each.alike for each in found], abs=1e-5)
    nearer = [k for k, cosine in enumerate(alike) if -cosine >= ALIKE]
    assert [each.number for each in find_regions(both, "r1")] == nearer


def test_keys_of_another_encoder_are_refused(world: World) -> None:
    regions = regions_of(world, {"sky": (1.0, 2.0)})
    said = "region 'sky': the style file knows it by the semantic encoder .*, the scene has bundled-semantic:"
    with pytest.raises(UsageError, match=said):
        find_regions(regions, "sky")
    fitting = regions._replace(keys={"sky": key_of(regions, 0)})
    with pytest.raises(UsageError, match=said):
        find_regions(fitting._replace(encoder="dino:small"), "sky")
    assert find_regions(fitting._replace(encoder=regions.views.semantic_encoder), "sky")


def test_names_of_views_may_be_parts_of_each_other(world: World) -> None:
    from dataclasses import replace

    regions = regions_of(world)
    trained = trained_of(regions)
    known = trained.known
    names = ("a", "a:1", *known.names[2:])
    renamed = regions._replace(views=replace(trained, known=replace(known, names=names)))
    share, _ = membership_view(regions, 1, 32)
    assert find_regions(renamed, "a:1:5,6")[0].number == int(share[6, 5].argmax())
