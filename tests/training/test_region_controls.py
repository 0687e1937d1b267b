"""Wishes on a scene: what they mean, what contradicts, and that what is saved means the same again."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_world import World

from fprf.errors import UsageError
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.training.regions import Regions
from fprf.training.restyle import RegionControls, Styled, apply_style, region_controls


@pytest.fixture(scope="module")
def _styled() -> dict[str, Styled]:
    return {}


@pytest.fixture
def styled(world: World, _styled: dict[str, Styled]) -> Styled:
    if not _styled:
        _styled["plain"] = apply_style(world.load(), StyleFile(style_of(world.references)))
    return _styled["plain"]


def style_of(references: Sequence[Path]) -> StyleConfig:
    return StyleConfig(references=tuple(references), clusters=3)


def controls_of(world: World, styled: Styled, file: StyleFile | None = None, **wishes: object) -> RegionControls:
    style = replace(style_of(world.references), **wishes)  # type: ignore[arg-type]
    old = styled.controls.regions
    regions = Regions(old.views, old.scene, old.basis, {} if file is None else file.regions)
    return region_controls(regions, styled.dictionary, style)


def test_references_are_meant_in_the_order_given_whatever_the_dictionarys(world: World, styled: Styled) -> None:
    for number, name in enumerate(("dusk.png", "snow.png")):
        place = styled.dictionary.names.index(name)
        for text in (str(number), name, name.removesuffix(".png"), str(world.references[number])):
            allowed = controls_of(world, styled, pin=(f"1={text}",)).allowed
            assert allowed[1].nonzero().flatten().tolist() == [place] and bool(allowed[0].all())


def test_forbidding_keeping_and_strengths(world: World, styled: Styled) -> None:
    controls = controls_of(world, styled, forbid=("0=snow.png",), keep=("1",), region_strength=("2=0.25", "0=0.5"))
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
    forbidden = controls_of(world, styled, keep_below=left + 1e-3 if left < 0.999 else 1.0, forbid=(f"{k}=dusk.png",))
    assert forbidden.strength[k] == 0


@pytest.mark.parametrize(
    ("wishes", "said"),
    [
        ({"keep": ("1",), "pin": ("1=0",)}, "region 1: is to be kept, and to be pinned"),
        ({"keep": ("1",), "region_strength": ("1=0.5",)}, "region 1: is to be kept"),
        ({"forbid": ("1=0", "1=1")}, "region 1: every reference is forbidden"),
        ({"pin": ("1=0",), "forbid": ("1=0",)}, "region 1: every reference is forbidden"),
        ({"pin": ("1=autumn.jpg",)}, r"reference 'autumn\.jpg': no such reference; there are 0 dusk\.png, 1 snow\.png"),
        ({"keep": ("44",)}, "region 44: regions go from 0"),
    ],
)
def test_contradictions_and_unknown_names(world: World, styled: Styled, wishes: dict[str, object], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        controls_of(world, styled, **wishes)


def test_what_is_saved_means_the_same_on_the_same_scene(world: World, styled: Styled) -> None:
    controls = controls_of(
        world, styled, pin=("0=snow.png", "0002:15,20=1"), forbid=("1=0",), keep=("2",) if len(styled.scene.share) > 2 else ()
    )
    saved = controls.saved
    assert all(text.partition("=")[0] in saved.regions for text in (*saved.style.pin, *saved.style.forbid, *saved.style.keep))
    old = styled.controls.regions
    again = region_controls(Regions(old.views, old.scene, old.basis, saved.regions), styled.dictionary, saved.style)
    assert torch.equal(again.allowed, controls.allowed) and torch.equal(again.strength, controls.strength)
    assert again.saved == saved, "names and keys stay as they are, however often it is saved"
    named = {text.partition("=")[0] for text in (*saved.style.pin, *saved.style.forbid, *saved.style.keep)}
    assert len(again.notes) == len(named) and "region 'region0' of the style is region 0 here (cosine 1.00)" in again.notes


def test_a_new_wish_does_not_take_the_name_of_an_old_one(world: World, styled: Styled) -> None:
    first = controls_of(world, styled, keep=("1",)).saved
    swapped = {"region0": first.regions["region1"], "region1": first.regions["region0"]}
    renamed = StyleFile(first.style, {**first.regions, **swapped}, first.semantic_encoder)
    both = controls_of(world, styled, renamed, keep=("region0",), pin=("0=0",))
    assert both.strength[1] == 0 and both.saved.style.keep == ("region0",)
    (pin,) = both.saved.style.pin
    assert both.saved.regions[pin.partition("=")[0]] == first.regions["region0"] != both.saved.regions["region0"]
    again = controls_of(world, styled, both.saved, keep=both.saved.style.keep, pin=both.saved.style.pin)
    assert torch.equal(again.allowed, both.allowed) and torch.equal(again.strength, both.strength)


def test_photographs_of_one_name_are_told_apart(world: World, tmp_path: Path) -> None:
    copies = []
    for folder, path in zip(("a", "b"), world.references, strict=True):
        (tmp_path / folder).mkdir()
        copies.append(tmp_path / folder / "same.png")
        copies[-1].write_bytes(path.read_bytes())
    trained = world.load()
    encoders = trained.encoders()
    style = replace(style_of(copies), pin=("0=1",))
    styled = apply_style(trained, StyleFile(style), encoders)
    assert set(styled.dictionary.names) == {"a/same.png", "b/same.png"}
    assert styled.controls.allowed[0].tolist() == [name == "b/same.png" for name in styled.dictionary.names]
    assert styled.controls.saved.style.pin == ("region0=1",), "a number, which moving the folders does not change"
    with pytest.raises(UsageError, match=r"reference 'same\.png': 2 references are called so"):
        apply_style(trained, StyleFile(replace(style, pin=("0=same.png",))), encoders)
    twice = apply_style(trained, StyleFile(style_of([copies[0], copies[0]])), encoders)
    assert len(twice.dictionary.names) == 2
