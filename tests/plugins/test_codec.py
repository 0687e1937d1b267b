import dataclasses
import enum
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import pytest
from fake_packages import ENCODER, METHOD, Packages
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.cli.parsing import load_method, parse
from fprf.config_files import load_config, save_config
from fprf.errors import ConfigError, PluginError
from fprf.methods import fprf
from fprf.plugins import registry
from fprf.plugins.codec import Missing, from_json, to_json
from fprf.plugins.encoders.config import EncoderConfig, RandomConfig
from fprf.plugins.slots import replace


class Colour(enum.Enum):
    RED = "red"
    ONE = 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class Leaf:
    whole: int = 3
    real: float = 0.5
    yes: bool = True
    text: str = ""
    path: Path = Path("a/b")
    colour: Colour = Colour.RED
    pick: Literal["a", 1] = "a"
    pair: tuple[int, float] = (1, 2.0)
    many: tuple[float, ...] = ()
    names: list[str] = dataclasses.field(default_factory=list)
    table: dict[str, int] = dataclasses.field(default_factory=dict)
    maybe: float | None = None
    either: int | tuple[int, int] = 1
    encoder: EncoderConfig | None = None


reals = st.floats(allow_nan=False, allow_infinity=False)
leaves = st.builds(
    Leaf,
    whole=st.integers(),
    real=reals,
    yes=st.booleans(),
    text=st.text(),
    path=st.text(st.characters(exclude_characters="\0\\", exclude_categories=["Cs"]), min_size=1).map(Path),
    colour=st.sampled_from(Colour),
    pick=st.sampled_from(["a", 1]),
    pair=st.tuples(st.integers(), reals),
    many=st.lists(reals, max_size=4).map(tuple),
    names=st.lists(st.text(), max_size=3),
    table=st.dictionaries(st.text(), st.integers(), max_size=3),
    maybe=st.none() | reals,
    either=st.integers() | st.tuples(st.integers(), st.integers()),
    encoder=st.none() | st.builds(RandomConfig, channels=st.integers(1, 99)),
)


@settings(max_examples=60, deadline=None)
@given(leaves)
def test_any_config_survives_json_text(leaf: Leaf) -> None:
    text = json.dumps(to_json(leaf), allow_nan=False)
    assert from_json(json.loads(text), Leaf) == leaf


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"whole": True}, "config.whole: expected a whole number, found true"),
        ({"whole": "5"}, 'config.whole: expected a whole number, found "5"'),
        ({"real": 10**400}, "config.real: expected a finite number"),
        ({"real": math.inf}, "config.real: expected a finite number"),
        ({"yes": 1}, "config.yes: expected true or false, found 1"),
        ({"colour": "blue"}, "config.colour: 'blue' is not one of 'red', 1"),
        ({"pick": True}, "config.pick: True is not one of 'a', 1"),
        ({"pair": [1, "x"]}, 'config.pair.1: expected a number, found "x"'),
        ({"many": 3}, "config.many: expected a list, found 3"),
        ({"either": "x"}, "config.either: expected a whole number, found"),
        ({"wholes": 3}, "config: Leaf has no field 'wholes'; did you mean 'whole'?"),
        ({"encoder": {}}, 'config.encoder: expected the plug-in\'s name as "type", found None'),
        ({"encoder": {"type": [[0] * 999]}}, 'name as "type", found [[' + 18 * "0, " + "0..."),
        (
            {"encoder": {"type": "random", "chanels": 3}},
            "config.encoder: RandomConfig has no field 'chanels'; did you mean",
        ),
        ({"encoder": {"type": "random", "channels": 0}}, "config.encoder: channels: 0 must be at least 1"),
        ([], "config: expected an object, found []"),
    ],
)
def test_what_does_not_fit_is_refused_with_its_place(data: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)) as caught:
        from_json(data, Leaf)
    assert "\n" not in str(caught.value)


def test_what_json_cannot_hold_is_not_saved() -> None:
    for bad in (Leaf(real=math.nan), Leaf(many=(1.0, math.inf)), Leaf(text=b"x")):  # type: ignore[arg-type]
        with pytest.raises(ConfigError, match="cannot be saved"):
            to_json(bad)


def test_nothing_is_imported_because_a_file_says_so(tmp_path: Path) -> None:
    path = _saved(tmp_path, lambda whole: whole["config"]["sampler"].update(type="os:system"))
    config, _ = load_config(path)
    assert isinstance(config.sampler, Missing)


def _saved(folder: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    path = folder / "config.json"
    save_config(path, fprf(), "fprf")
    whole = json.loads(path.read_text())
    change(whole)
    path.write_text(json.dumps(whole))
    return path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda w: w.pop("format"), 'expected an object with "format": 1'),
        (lambda w: w.update(format=2, fprf="9.0"), "is of format 2, written by fprf 9.0"),
        (lambda w: w.pop("plugins"), "Object missing required field `plugins`"),
        (lambda w: w.update(metod="x"), "Object contains unknown field `metod`"),
        (
            lambda w: w["config"].update(stepz=1),
            "config: TrainConfig has no field 'stepz'; did you mean 'steps'?",
        ),
        (lambda w: w["config"]["loss"].update(rgb="1"), 'config.loss.rgb: expected a number, found "1"'),
        (lambda w: w["config"].update(downscale=0), "config: downscale: 0 must be at least 1"),
    ],
)
def test_a_file_that_was_edited_wrongly_is_refused(
    tmp_path: Path, change: Callable[[dict[str, Any]], object], message: str
) -> None:
    path = _saved(tmp_path, change)
    with pytest.raises(ConfigError, match=re.escape(f"{path}: {message}")) as caught:
        load_config(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "is not JSON: line 1, column 1"),
        (b'{"format": 1', "is not JSON"),
        (b'{"format": NaN}', "NaN is not a number that JSON knows"),
        (b'{"format": 1, "config": {"x": -1e999}}', "-1e999 is beyond the largest number of float64"),
        (b'{"format": 1, "format": 1}', "the key 'format' stands twice"),
        (b"\xff\xfe", "is not UTF-8 text"),
        (b"[" * 100_000, "is nested too deeply"),
        (b'{"format": ' + b"9" * 5000 + b"}", "is beyond the largest number of float64"),
    ],
)
def test_a_file_that_is_no_config_is_refused(tmp_path: Path, text: bytes, message: str) -> None:
    path = tmp_path / "config.json"
    path.write_bytes(text)
    with pytest.raises(ConfigError, match=re.escape(str(path))) as caught:
        load_config(path)
    assert message in str(caught.value)


def test_a_missing_plugin_is_kept_as_data_and_fails_when_built(packages: Packages, tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    again = tmp_path / "again.json"
    code = {"acme_gone": ENCODER.format(name="Gone")}
    packages.install(
        "acme-gone", {"fprf.encoders": {"gone": "acme_gone:GoneConfig"}}, code=code, version="0.3"
    )
    chosen = registry.load("fprf.encoders", "gone", EncoderConfig)
    save_config(path, replace(fprf(), "semantic.encoder", chosen()), "fprf")
    (packages.root / "acme_gone-0.3.dist-info" / "entry_points.txt").write_text("")
    registry.forget()

    config, method = load_config(path)
    assert isinstance(config.semantic.encoder, Missing)
    save_config(again, config, method)
    assert json.loads(again.read_text()) == json.loads(path.read_text())
    assert load_config(again) == (config, method) and hash(config)
    with pytest.raises(
        PluginError, match=r"^semantic.encoder: fprf.encoders: no plug-in 'gone' is installed"
    ) as caught:
        config.semantic.encoder.build()
    assert "install acme-gone 0.3, or choose another with --semantic.encoder NAME" in str(caught.value)


def acme(packages: Packages, folder: Path) -> Path:
    """A saved config of a stranger's method with fields of its own."""
    packages.install(
        "acme-method",
        {"fprf.methods": {"acme": "acme_method:acme"}},
        code={"acme_method": METHOD},
        version="0.3",
    )
    config, name = load_method("acme")
    args = [
        "--knob",
        "7",
        "--teacher",
        "random",
        "--teacher.channels",
        "5",
        "--steps",
        "3",
        "--shares",
        "0.25",
        "0.75",
    ]
    save_config(folder / "config.json", parse(config, args, prog="x", description=""), name)
    return folder / "config.json"


def test_a_strangers_method_keeps_its_own_fields(packages: Packages, tmp_path: Path) -> None:
    path = acme(packages, tmp_path)
    config, method = load_method(str(path))
    assert method == "acme" and type(config) is type(load_method("acme")[0])
    assert (config.knob, config.shares, config.teacher, config.steps) == (
        7,
        (0.25, 0.75),
        RandomConfig(channels=5),
        3,
    )  # type: ignore[attr-defined]
    assert parse(config, ["--knob", "8"], prog="x", description="") == dataclasses.replace(config, knob=8)  # type: ignore[call-arg]
    whole = json.loads(path.read_text())
    assert whole["plugins"]["method"] == "acme-method 0.3" and "knob" in whole["config"]
    refused = {
        "config.knob: expected a whole number": {"knob": "7"},
        "knob: -1 must be": {"knob": -1},
        "AcmeConfig has no field 'knbo'; did you mean 'knob'?": {"knbo": 1},
    }
    for message, change in refused.items():
        path.write_text(json.dumps(whole | {"config": whole["config"] | change}))
        with pytest.raises(ConfigError, match=re.escape(message)):
            load_config(path)


@pytest.mark.parametrize("broken", [False, True])
def test_a_method_with_fields_of_its_own_must_load(packages: Packages, tmp_path: Path, broken: bool) -> None:
    path = acme(packages, tmp_path)
    info = packages.root / "acme_method-0.3.dist-info" / "entry_points.txt"
    info.write_text("[fprf.methods]\nacme = acme_method:no_such_thing\n" if broken else "")
    registry.forget()
    with pytest.raises(PluginError, match=r"; install acme-method 0\.3$") as caught:
        load_config(path)
    assert "\n" not in str(caught.value)


def test_a_plugin_field_called_type_is_refused(packages: Packages) -> None:
    source = ENCODER.format(name="Typed").replace("tile: int", "type: int")
    packages.install(
        "acme-typed", {"fprf.encoders": {"typed": "acme_typed:TypedConfig"}}, code={"acme_typed": source}
    )
    chosen = registry.load("fprf.encoders", "typed", EncoderConfig)
    with pytest.raises(ConfigError, match="has a field `type`"):
        to_json(Leaf(encoder=chosen()))


def test_fields_that_could_not_be_read_again_are_not_saved(packages: Packages, tmp_path: Path) -> None:
    config, _ = load_config(acme(packages, tmp_path))
    with pytest.raises(ConfigError, match="method 'fprf-lite' gives no AcmeConfig"):
        save_config(tmp_path / "other.json", config, "fprf-lite")
