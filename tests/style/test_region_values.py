from pathlib import Path

import pytest

from fprf.errors import ConfigError, UsageError
from fprf.style.config import RegionValue, find_reference, labels, parse_region_value, parse_strength

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
    assert parse_region_value("pin", text) == wish


def test_strengths_are_numbers_in_a_range() -> None:
    assert parse_strength("region_strength", "sky=0.5") == ("sky", 0.5)
    for text, said in (("3=1.5", "must lie in"), ("3=nan", "not a finite number"), ("3=much", "'much' is no number")):
        with pytest.raises(ConfigError, match=f"^region_strength: .*{said}"):
            parse_strength("region_strength", text)


@pytest.mark.parametrize(
    ("text", "index"),
    [("autumn.jpg", 0), ("a/autumn.jpg", 0), ("autumn", 0), ("night.jpg", 1), ("1", 1), ("3", 3), ("night.png", 3)],
)
def test_references_are_found_by_path_name_number_and_stem(text: str, index: int) -> None:
    assert find_reference(text, PHOTOS) == index


def test_what_is_not_found_or_not_clear_is_told() -> None:
    with pytest.raises(UsageError, match=r"reference 'x': no such reference; there are 0 autumn\.jpg, 1 night\.jpg"):
        find_reference("x", PHOTOS)
    with pytest.raises(UsageError, match="reference 'night': 2 references are called so; use the number"):
        find_reference("night", PHOTOS)


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
