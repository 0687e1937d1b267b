"""Style files, keyframes and what users say of regions and references: there and back, moved, shared, and
mistakes.
"""

import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from tiny_world import World

from fprf.errors import ConfigError, DataError, UsageError
from fprf.plugins.stylizers.config import AdainConfig, LocalAdainConfig, RegionToneConfig
from fprf.style.config import NO_MASK, StyleConfig, find_reference, labels, parse_strength
from fprf.style.files import (
    Keyframe,
    StyleFile,
    check_photographs,
    fade,
    read_keyframes,
    read_style,
    with_folders,
    write_style,
)
from fprf.style.restyle import keyed_looks


def photo(path: Path, text: str = "pixels") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def full(folder: Path) -> StyleFile:
    """A style with a second value of every field."""
    a = photo(folder / "photos" / "a.jpg")
    b = photo(folder / "b.jpg", "others")
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
        light="golden-hour",
        sun=(30.0, 12.5),
        sun_from="view",
        sun_elevation=14.0,
        sun_over_sky=(4.0, 3.0, 2.0),
        sun_strength=0.5,
        sun_colour="3000K",
        sky_colour="#4080ff",
        sun_size=2.0,
        unlit=True,
    )
    return StyleFile(style, {"sky": (0.5, -1.25), "region3": (1e-9, 7.0)}, "bundled-semantic:123")


def test_every_field_survives(tmp_path: Path) -> None:
    file = full(tmp_path)
    path = tmp_path / "style.json"
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
    write_style(
        tmp_path / "style.json", StyleFile(StyleConfig(references=(photo(tmp_path / "mine" / "a.jpg"),)))
    )
    text = (tmp_path / "style.json").read_text().replace("mine/a.jpg", "/of/somebody/else/a.jpg")
    photo(tmp_path / "theirs" / "a.jpg")
    photo(tmp_path / "theirs" / "style.json", text)
    read = read_style(tmp_path / "theirs" / "style.json")
    assert read.style.references == (tmp_path / "theirs" / "a.jpg",)
    check_photographs(tmp_path / "theirs" / "style.json", read)
    photo(tmp_path / "theirs" / "a.jpg", "another photograph of that name")
    with pytest.raises(
        DataError, match=r"style\.json: .*a\.jpg has changed since the style was saved \(sha256 "
    ):
        check_photographs(tmp_path / "theirs" / "style.json", read)


def test_a_hand_written_file_says_only_what_it_wants(tmp_path: Path) -> None:
    photo(
        tmp_path / "s.json",
        '{"format": 1, "style": {"references": ["a.jpg"], "stylizer": {"type": "adain"}, "strength": 1}}',
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
        (
            '{"format": 1, "style": {"weights": [1], "references": ["a", "b"]}}',
            "weights: 1 weights for 2 references",
        ),
        ('{"format": 1, "style": {}, "regions": {"3": [1.0]}}', "regions: '3' is no name"),
        ('{"format": 1, "style": {}, "regions": {"sky": ["x"]}}', "expected a number"),
        ('{"format": 1, "style": {}, "sha256": {"a": 1}}', "expected a text"),
    ],
)
def test_what_is_wrong_is_named_with_the_file(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read_style(photo(tmp_path / "style.json", text))
    assert str(caught.value).startswith(f"{tmp_path / 'style.json'}: ") and said in str(caught.value)


PHOTOS = [Path("a/autumn.jpg"), Path("b/night.jpg"), Path("b/7.jpg"), Path("c/night.png")]


@pytest.mark.parametrize(
    ("text", "index"),
    [
        ("autumn.jpg", 0),
        ("a/autumn.jpg", 0),
        ("autumn", 0),
        ("night.jpg", 1),
        ("1", 1),
        ("3", 3),
        ("night.png", 3),
    ],
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
        *(
            (ConfigError, partial(parse_strength, "region_strength", text))
            for text in ("3=1.5", "3=nan", "3=much")
        ),
        *((UsageError, partial(find_reference, text, PHOTOS)) for text in ("x", "night")),
    ],
)
def test_what_cannot_be_is_refused(kind: type[Exception], mistake: Callable[[], object]) -> None:
    with pytest.raises(kind):
        mistake()


PLAIN = {"frame": 1, "style": None}


@pytest.mark.parametrize(
    "rows", [[], [PLAIN, PLAIN], [PLAIN | {"frame": -1}], [PLAIN, 3], [{"frame": 1}], {}]
)
def test_what_is_wrong_with_the_file_is_told(tmp_path: Path, rows: object) -> None:
    file = tmp_path / "k.json"
    file.write_text(json.dumps({"format": 1, "keyframes": [PLAIN]}))
    assert read_keyframes(file) == (Keyframe(1, None),)
    for whole in ({"format": 1, "keyframes": rows}, {"format": 2, "keyframes": [PLAIN]}):
        file.write_text(json.dumps(whole))
        with pytest.raises(ConfigError) as caught:
            read_keyframes(file)
        assert str(caught.value).startswith(f"{file}: ")


@given(st.lists(st.integers(0, 60), min_size=1, max_size=5, unique=True).map(sorted), st.integers(0, 70))
def test_a_fade_lies_between_its_neighbours(frames: list[int], at: int) -> None:
    before, after, way = fade(frames, at)
    assert 0 <= way < 1
    if before == after:
        assert way == 0 and (at <= frames[0] or at >= frames[-1] or at == frames[before])
        assert frames[before] == min(max(at, frames[0]), frames[-1])
    else:
        assert after == before + 1 and frames[before] <= at < frames[after]
        assert (way == 0) == (at == frames[before])


def test_each_frame_has_its_look(world: World, tmp_path: Path) -> None:
    styles = (tmp_path / "dusk.json", tmp_path / "snow.json")
    for path, reference, strength in zip(styles, world.references, (1.0, 0.8), strict=True):
        style = StyleConfig(
            references=(reference,), clusters=2, stylizer=AdainConfig(), strength=strength, luminance=0.5
        )
        write_style(path, StyleFile(style))
    looks = keyed_looks(
        world.load(),
        [
            Keyframe(2, None),
            Keyframe(6, styles[0]),
            Keyframe(10, styles[1]),
            Keyframe(14, None),
            Keyframe(20, None),
        ],
    )
    held = keyed_looks(world.load(), [Keyframe(0, styles[0]), Keyframe(9, styles[0])])
    assert held(4) is held(0), "nothing fades"
    assert looks(0) is looks(2) is looks(14) is looks(17) is looks(30) is None
    first = looks(6)
    second = looks(10)
    assert first is not None and second is not None and first.others == second.others == ()
    middle = looks(8)
    assert middle is not None and [part.share for part in middle.parts] == [0.5, 0.5]
    assert [part.strength for part in middle.parts] == [1.0, 0.8]
    for at, strengths in ((4, [0.0, 1.0]), (12, [0.8, 0.0])):
        rising = looks(at)
        assert rising is not None and [part.strength for part in rising.parts] == strengths
        assert {part.luminance for part in rising.parts} == {0.5}, (
            "luminance does not fade: it is kept throughout"
        )


def test_a_style_of_before_names_how_regions_are_matched(tmp_path: Path) -> None:
    path = tmp_path / "style.json"
    stylizer = {"type": "region-tone", "temperature": 0.2, "similarity": "cosine"}
    path.write_text(json.dumps({"format": 1, "style": {"stylizer": stylizer}}))
    assert read_style(path).style.stylizer == RegionToneConfig(temperature=0.2)
    path.write_text(json.dumps({"format": 1, "style": {"stylizer": stylizer | {"similarity": "dot"}}}))
    with pytest.raises(ConfigError, match="similarity"):
        read_style(path)


def test_a_photograph_may_be_named_twice_beside_a_folder_that_holds_it(world: World, tmp_path: Path) -> None:
    for photograph in world.references:
        shutil.copy(photograph, tmp_path)
    dusk = tmp_path / "dusk.png"
    sky = tmp_path / "masks" / "sky.png"
    style = with_folders(
        StyleConfig(references=(tmp_path, dusk, dusk), weights=(1, 2, 3), masks=(NO_MASK, sky, NO_MASK))
    )
    assert style.references == (tmp_path / "snow.png", dusk, dusk)
    assert style.weights == (1, 2, 3) and style.masks == (NO_MASK, sky, NO_MASK)


@pytest.mark.parametrize("template", ["{stem}_mask.png", "mask_{stem}.PNG", "{name}.png", "{stem}.png.png"])
def test_a_folder_of_masks_is_searched_by_the_references_names(tmp_path: Path, template: str) -> None:
    names = ("dusk.jpg", "snow.jpg")
    paths = tuple(tmp_path / "photos" / name for name in names)
    for path in paths:
        path.parent.mkdir(exist_ok=True)
        Image.new("RGB", (6, 4), (99, 9, 9)).save(path)
    covers = []
    for name in names:
        covers.append(photo(tmp_path / "covers" / template.format(stem=name.removesuffix(".jpg"), name=name)))
    for references in (paths, (tmp_path / "photos",)):
        style = with_folders(StyleConfig(references=references, masks=(tmp_path / "covers",)))
        assert style.references == paths and style.masks == tuple(covers)
    one = with_folders(StyleConfig(references=paths, masks=(NO_MASK, tmp_path / "covers")))
    assert one.masks == (NO_MASK, covers[1])


def test_what_of_a_folder_of_masks_does_not_fit_is_said(tmp_path: Path) -> None:
    paths = tuple(photo(tmp_path / name) for name in ("dusk.jpg", "snow.jpg"))
    cover = photo(tmp_path / "covers" / "dusk.png")
    told: list[str] = []
    style = with_folders(StyleConfig(references=paths, masks=(tmp_path / "covers",)), told.append)
    assert style.masks == (cover, NO_MASK) and len(told) == 1 and "snow.jpg" in told[0]
    cover.rename(cover.with_name("noon.png"))
    with pytest.raises(ConfigError, match=r"masks: .*none of its 1 images, like noon\.png"):
        with_folders(StyleConfig(references=paths, masks=(tmp_path / "covers",)))
    with pytest.raises(ConfigError, match="1 masks for 2 references"):
        with_folders(StyleConfig(references=paths, masks=(cover,)))
