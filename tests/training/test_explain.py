"""The list of regions: shares, places that really show them, and what they take."""

from dataclasses import replace

import pytest
import torch
from tiny_world import World

from fprf.plugins.stylizers.config import AdainConfig, RegionAdainConfig
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.training.loading import load_style
from fprf.training.matches import explain, region_row, region_tile
from fprf.training.regions import Regions, find_regions, membership_view
from fprf.training.restyle import apply_style


def test_the_place_of_a_region_is_in_the_view_that_shows_most_of_it(world: World) -> None:
    trained = world.load()
    regions = Regions(trained, *load_style(trained.run))
    shares = [membership_view(regions, v, 32) for v in range(len(trained.known.names))]
    mass = torch.stack([(share * opacity[..., None]).mean((0, 1)) for share, opacity in shares])
    for each in explain(regions):
        view, k = trained.known.names.index(each.view), each.number
        assert float(mass[view, k]) >= 0.95 * float(mass[:, k].max())
        own = shares[view][0][each.pixel[1], each.pixel[0], k]
        assert float(own) >= 0.5 * float(shares[view][0][..., k].max())
        if float(own) > 0.5:
            assert find_regions(regions, f"{each.view}:{each.pixel[0]},{each.pixel[1]}")[0].number == k


@pytest.mark.parametrize("stylizer", [AdainConfig(), RegionAdainConfig()], ids=lambda s: type(s).__name__)
def test_what_regions_take_is_the_stylizers_match_at_their_keys(world: World, stylizer: object) -> None:
    trained = world.load()
    style = StyleConfig(references=world.references, clusters=3, keep=("1",), forbid=("0=0",))
    styled = apply_style(trained, StyleFile(replace(style, stylizer=stylizer)))  # type: ignore[arg-type]
    found = explain(styled.controls.regions, styled)
    match = styled.restyle.stylizer.match(styled.scene.keys)
    for each in found:
        for taken in each.taken:
            own = styled.dictionary.reference == styled.dictionary.names.index(taken.name)
            assert taken.share == pytest.approx(float(match[each.number, own].sum()), abs=1e-5)
            assert taken.score == pytest.approx(float(styled.controls.score[each.number, own].max()))
        assert [t.share for t in each.taken] == sorted((t.share for t in each.taken), reverse=True)
        bits = -(match[each.number] * match[each.number].clamp_min(1e-30).log2()).sum()
        assert each.entropy == pytest.approx(float(bits), abs=1e-4)
    assert [each.strength for each in found][:2] == [1.0, 0.0] and [each.restricted for each in found][:2] == [True, False]
    tile = region_tile(found[1], styled.dictionary.names)
    assert tile.lines[-1] == "kept as it is" and sum(tile.shares) == 0
    assert sum(region_tile(found[0], styled.dictionary.names).shares) == pytest.approx(1, abs=1e-4)
    row = region_row(found[0])
    assert {"references", "entropy_bits", "strength", "restricted"} < row.keys() and len(row["references"]) == 2
