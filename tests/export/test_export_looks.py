from pathlib import Path

import pytest
from tiny_world import World

from fprf.errors import UsageError
from fprf.export.config import Named, make_looks, named_styles, style_name
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile, write_style


def test_names_of_styles() -> None:
    assert style_name([Path("a/autumn day.jpg"), Path("night.png")], None) == "autumn_day+night"
    assert style_name([], Path("x/dusk/style.json")) == "dusk"
    assert style_name([], Path("x/dusk/mine.json")) == "mine"
    assert len(style_name([Path("long_name.jpg")] * 50, None)) <= 60
    assert style_name([Path("äö.png")], None) == "style"


def test_photographs_take_the_other_settings_and_leave_what_names_photographs() -> None:
    base = StyleFile(StyleConfig(references=(Path("a.jpg"),), weights=(2.0,), strength=0.5, pin=("0=a.jpg",), keep=("1",)))
    [one, two] = named_styles(["dusk=b.jpg", "snow=c.jpg,d.jpg"], base)
    assert (one.name, two.name) == ("dusk", "snow")
    assert one.file.style.references == (Path("b.jpg"),) and two.file.style.references == (Path("c.jpg"), Path("d.jpg"))
    assert two.file.style.strength == 0.5 and two.file.style.keep == ("1",)
    assert two.file.style.weights == () and two.file.style.pin == ()


def test_style_files(world: World, tmp_path: Path) -> None:
    saved = StyleConfig(references=(world.references[0],), strength=0.25)
    write_style(tmp_path / "mine.json", StyleFile(saved), {})
    [found] = named_styles([f"mine={tmp_path / 'mine.json'}"], StyleFile(StyleConfig()))
    assert found.file.style.strength == 0.25 and found.file.style.references[0].name == "dusk.png"


@pytest.mark.parametrize("text", ["dusk", "=a.jpg", "dusk=", "du sk=a.jpg", "../x=a.jpg"])
def test_other_forms_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"write NAME=PHOTO,PHOTO or NAME=STYLE\.json"):
        named_styles([text], StyleFile(StyleConfig()))


def test_looks_of_a_run(world: World) -> None:
    trained = world.load()
    file = StyleFile(StyleConfig(references=world.references))
    looks = make_looks(trained, [Named("a", file), Named("b", file)])
    assert [look.name for look in looks] == ["", "a", "b"]
    assert looks[0].restyle is None and looks[1].restyle is not None
    assert [look.name for look in make_looks(trained, [])] == [""]
    with pytest.raises(UsageError, match="two styles of this name"):
        make_looks(trained, [Named("a", file), Named("a", file)])
