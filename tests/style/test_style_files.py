"""Style files: there and back, moved, shared, edited by hand, and whatever may be wrong with them."""

import json
import shutil
from pathlib import Path

import pytest

from fprf.errors import ConfigError, DataError
from fprf.plugins.stylizers.config import AdainConfig, LocalAdainConfig
from fprf.style.config import NO_MASK, StyleConfig
from fprf.style.files import StyleFile, check_photographs, read_style, write_style


def photo(path: Path, text: str = "pixels") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def full(folder: Path) -> StyleFile:
    """A style with a second value of every field."""
    a, b = photo(folder / "photos" / "a.jpg"), photo(folder / "b.jpg", "others")
    style = StyleConfig(
        references=(a, b),
        weights=(1.0, 2.5),
        masks=(NO_MASK, photo(folder / "mask.png")),
        stylizer=LocalAdainConfig(temperature=0.2, similarity="dot"),
        clusters=7,
        blend=0.4,
        strength=0.9,
        luminance=0.25,
        bold=0.75,
        pin=("sky=a.jpg",),
        forbid=("region3=1",),
        keep=("2",),
        region_strength=("region4=0.5",),
        keep_below=-0.25,
        between=photo(folder / "other" / "style.json"),
        at=0.75,
    )
    return StyleFile(style, {"sky": (0.5, -1.25), "region3": (1e-9, 7.0)}, "bundled-semantic:123")


def test_every_field_survives(tmp_path: Path) -> None:
    file, path = full(tmp_path), tmp_path / "style.json"
    assert all(getattr(file.style, name) != value for name, value in vars(StyleConfig()).items())
    write_style(path, file, {"seconds": 1.5})
    read = read_style(path)
    assert read[:3] == file[:3] and set(read.sha256) == {*file.style.references, tmp_path / "mask.png"}
    check_photographs(path, read)
    assert json.loads(path.read_text())["made"] == {"seconds": 1.5}
    write_style(path, read)
    assert read_style(path) == read, "what is written is itself such a file"


def test_a_style_from_before_there_was_light_paints_everything(tmp_path: Path) -> None:
    write_style(tmp_path / "style.json", full(tmp_path))
    whole = json.loads((tmp_path / "style.json").read_text())
    del whole["style"]["bold"]
    del whole["style"]["stylizer"]["light"]
    photo(tmp_path / "old.json", json.dumps(whole))
    assert read_style(tmp_path / "old.json").style.bold == 1
    del whole["fprf"]
    photo(tmp_path / "by_hand.json", json.dumps(whole))
    assert read_style(tmp_path / "by_hand.json").style.bold == StyleConfig.bold


def test_photographs_in_its_folder_move_with_it_and_others_are_absolute(tmp_path: Path) -> None:
    far = photo(tmp_path / "elsewhere" / "far.jpg")
    near = photo(tmp_path / "one" / "photos" / "near.jpg")
    write_style(tmp_path / "one" / "style.json", StyleFile(StyleConfig(references=(near, far))))
    shutil.move(tmp_path / "one", tmp_path / "two")
    read = read_style(tmp_path / "two" / "style.json")
    assert read.style.references == (tmp_path / "two" / "photos" / "near.jpg", far)
    check_photographs(tmp_path, read)


def test_a_shared_style_finds_its_photographs_beside_it(tmp_path: Path) -> None:
    write_style(tmp_path / "style.json", StyleFile(StyleConfig(references=(photo(tmp_path / "mine" / "a.jpg"),))))
    text = (tmp_path / "style.json").read_text().replace("mine/a.jpg", "/of/somebody/else/a.jpg")
    photo(tmp_path / "theirs" / "a.jpg")
    photo(tmp_path / "theirs" / "style.json", text)
    read = read_style(tmp_path / "theirs" / "style.json")
    assert read.style.references == (tmp_path / "theirs" / "a.jpg",)
    check_photographs(tmp_path / "theirs" / "style.json", read)
    photo(tmp_path / "theirs" / "a.jpg", "another photograph of that name")
    with pytest.raises(DataError, match=r"style\.json: .*a\.jpg has changed since the style was saved \(sha256 "):
        check_photographs(tmp_path / "theirs" / "style.json", read)


def test_a_hand_written_file_says_only_what_it_wants(tmp_path: Path) -> None:
    photo(
        tmp_path / "s.json", '{"format": 1, "style": {"references": ["a.jpg"], "stylizer": {"type": "adain"}, "strength": 1}}'
    )
    read = read_style(tmp_path / "s.json")
    assert read.style == StyleConfig(references=(tmp_path / "a.jpg",), stylizer=AdainConfig())
    assert not read.sha256 and not read.regions


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("nonsense", "is not JSON"),
        ('{"format": 1}', 'and "style"'),
        ('{"format": 1, "style": {}, "sytle": {}}', "unknown key 'sytle'; did you mean 'style'"),
        ('{"format": 1, "style": {"strenght": 1}}', "has no field 'strenght'; did you mean 'strength'"),
        ('{"format": 1, "style": {"strength": 7}}', "strength: 7.0 must lie in"),
        ('{"format": 1, "style": {"pin": ["3"]}}', "pin: '3' is not REGION=VALUE"),
        ('{"format": 1, "style": {"weights": [1], "references": ["a", "b"]}}', "weights: 1 weights for 2 references"),
        ('{"format": 1, "style": {}, "regions": {"3": [1.0]}}', "regions: '3' is no name"),
        ('{"format": 1, "style": {}, "regions": {"sky": ["x"]}}', "expected a number"),
        ('{"format": 1, "style": {}, "sha256": {"a": 1}}', "expected a text"),
    ],
)
def test_what_is_wrong_is_named_with_the_file(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read_style(photo(tmp_path / "style.json", text))
    assert str(caught.value).startswith(f"{tmp_path / 'style.json'}: ") and said in str(caught.value)
