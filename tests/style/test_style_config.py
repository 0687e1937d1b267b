"""What users say of regions and references, and which references a region is left with."""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch

from fprf.errors import ConfigError, UsageError
from fprf.style.config import RegionValue, find_reference, labels, parse_region_value, parse_strength
from fprf.style.look import blend_strength
from fprf.style.regions import allowed_references


def test_pins_exclude_the_others_and_forbidding_leaves_the_rest() -> None:
    allowed = allowed_references(4, 3, pin={0: {1}, 3: {0, 2}}, forbid=[(1, 2), (3, 0)])
    assert allowed.tolist() == [[False, True, False], [True, True, False], [True, True, True], [False, False, True]]


PHOTOS = [Path("a/autumn.jpg"), Path("b/night.jpg"), Path("b/7.jpg"), Path("c/night.png")]


@pytest.mark.parametrize(
    ("text", "wish"),
    [
        ("3=autumn.jpg", RegionValue("3", "autumn.jpg")),
        ("IMG_0012:120,80=0", RegionValue("IMG_0012:120,80", "0")),
        ("a=b:mask.png=x.jpg", RegionValue("a=b:mask.png", "x.jpg")),
    ],
)
def test_a_wish_is_split_at_its_last_equals_sign(text: str, wish: RegionValue) -> None:
    assert parse_region_value("pin", text) == wish and parse_strength("region_strength", "sky=0.5") == ("sky", 0.5)


@pytest.mark.parametrize(
    ("text", "index"),
    [("autumn.jpg", 0), ("a/autumn.jpg", 0), ("autumn", 0), ("night.jpg", 1), ("1", 1), ("3", 3), ("night.png", 3)],
)
def test_references_are_found_by_path_name_number_and_stem(text: str, index: int) -> None:
    assert find_reference(text, PHOTOS) == index


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["a/x.jpg", "b/y.jpg"], ("x.jpg", "y.jpg")),
        (["a/x.jpg", "b/x.jpg"], ("a/x.jpg", "b/x.jpg")),
        (["1/a/x.jpg", "2/a/x.jpg"], ("1/a/x.jpg", "2/a/x.jpg")),
        (["a/x.jpg", "a/x.jpg", "a/x.jpg"], ("x.jpg", "x.jpg (2)", "x.jpg (3)")),
    ],
)
def test_labels_are_short_and_different(paths: list[str], names: tuple[str, ...]) -> None:
    assert labels([Path(p) for p in paths]) == names and len(set(names)) == len(names)


@pytest.mark.parametrize(
    ("kind", "mistake"),
    [
        *((UsageError, partial(blend_strength, torch.zeros(1, 1), torch.zeros(1, 1), s)) for s in (-0.1, 1.1, math.nan)),
        *((UsageError, partial(allowed_references, 2, 2, pin=pin)) for pin in ({2: {0}}, {0: {2}})),
        *((UsageError, partial(allowed_references, 2, 2, forbid=ban)) for ban in ([(0, -1)], [(1, 0), (1, 1)])),
        (UsageError, partial(allowed_references, 2, 2, pin={1: {0}}, forbid=[(1, 0)])),
        *((ConfigError, partial(parse_strength, "region_strength", text)) for text in ("3=1.5", "3=nan", "3=much")),
        *((UsageError, partial(find_reference, text, PHOTOS)) for text in ("x", "night")),
    ],
)
def test_what_cannot_be_is_refused(kind: type[Exception], mistake: Callable[[], object]) -> None:
    with pytest.raises(kind):
        mistake()
