"""Styles along a path: the file, the fade, and the frames."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tiny_world import World

from fprf.errors import ConfigError
from fprf.plugins.stylizers.config import AdainConfig
from fprf.style.config import StyleConfig
from fprf.style.files import Keyframe, StyleFile, fade, read_keyframes, write_style
from fprf.style.restyle import keyed_looks

PLAIN = {"frame": 1, "style": None}


@pytest.mark.parametrize("rows", [[], [PLAIN, PLAIN], [PLAIN | {"frame": -1}], [PLAIN, 3], {}])
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


def test_a_fade_is_even_about_its_middle_and_starts_and_ends_without_a_jerk() -> None:
    ways = [fade([0, 100], at)[2] for at in range(100)] + [1.0]
    steps = np.diff(ways)
    assert ways[50] == pytest.approx(0.5) and np.allclose(steps, steps[::-1]) and (steps > 0).all()
    assert steps[0] < 0.05 * steps.max() and np.abs(np.diff(steps)).max() < 0.05 * steps.max()


def test_each_frame_has_its_look(world: World, tmp_path: Path) -> None:
    styles = (tmp_path / "dusk.json", tmp_path / "snow.json")
    for path, reference, strength in zip(styles, world.references, (1.0, 0.8), strict=True):
        style = StyleConfig(references=(reference,), clusters=2, stylizer=AdainConfig(), strength=strength, luminance=0.5)
        write_style(path, StyleFile(style))
    looks = keyed_looks(
        world.load(),
        [Keyframe(2, None), Keyframe(6, styles[0]), Keyframe(10, styles[1]), Keyframe(14, None), Keyframe(20, None)],
    )
    assert looks(0) is looks(2) is looks(14) is looks(17) is looks(30) is None
    first, second = looks(6), looks(10)
    assert first is not None and second is not None and first.others == second.others == ()
    middle = looks(8)
    assert middle is not None and [part.share for part in middle.parts] == [0.5, 0.5]
    assert [part.strength for part in middle.parts] == [1.0, 0.8]
    for at, strengths in ((4, [0.0, 1.0]), (12, [0.8, 0.0])):
        rising = looks(at)
        assert rising is not None and [part.strength for part in rising.parts] == strengths
        assert {part.luminance for part in rising.parts} == {0.5}, "luminance does not fade: it is kept throughout"
