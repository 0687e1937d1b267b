import json
from pathlib import Path

import pytest
from tiny_world import World

from benchmarks.__main__ import main

SMALL = ["--repeats", "2", "--rays", "64", "--device", "cpu", "--points", "500", "--clusters", "4"]


def test_speed(world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "speed.json"
    references = ["--references", *map(str, world.references)]
    assert main(["speed", str(world.run), *references, *SMALL, "--output", str(output)]) == 0
    document = json.loads(output.read_text())
    assert document["benchmark"] == "speed" and document["settings"]["without"] == ""
    assert document["machine"]["device"] == "cpu" and document["machine"]["cores"] >= 1
    rows = {row["name"]: row for row in document["rows"]}
    styles = ("region-tone", "region-ot", "local-adain")
    compared = {"train", "render", *(f"stylised, {name}" for name in styles)}
    assert rows.keys() > compared
    for name in compared:
        row = rows[name]
        assert row["figure"] > 0 and row["peer"] > 0 and row["low"] <= row["figure"] <= row["high"]
        assert row["ratio_low"] <= row["ratio"] <= row["ratio_high"] and row["error_kind"]
    budget = world.config.render.budget
    assert all(rows[name]["error"] <= budget + 1e-5 for name in compared - {"train"})
    assert rows["render"]["peer_error"] < 1e-4, "the naive path is exact up to float32"
    assert 0 <= rows["train"]["error"] < 1
    for name in styles:
        cached = rows[f"cached view restyled, {name}"]
        assert cached["error"] == 0 and cached["figure"] > 0 and "goal" not in cached, "goals are for views of full size"
    lookup = next(row for name, row in rows.items() if "grid_sample" in name)
    assert lookup["error"] < 1e-5 and lookup["peer_error"] < 1e-5
    assert 0 < document["counters"]["kept_samples_share"] <= 1
    assert all(name in rows for name in document["falls_short"])
    text = capsys.readouterr().out
    assert "faster" in text and all(name in text for name in compared), "nothing is cut off"


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("speed nowhere", "nowhere: no config.json"),
        ("restyle RUN --device cpu --seeds 0 1 2", "is the town of the run itself"),
        ("restyle RUN --device cpu --palettes noon", "noon"),
        ("restyle --frames 7", "--frames"),
    ],
)
def test_a_mistake_is_one_line(line: str, told: str, world: World, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(line.replace("RUN", str(world.run)).split()) == 2
    lines = [each for each in capsys.readouterr().err.splitlines() if not each.startswith("{")]
    assert len(lines) == 2 and " needs " in lines[0], "needs are said first"
    assert lines[1].startswith("error: ") and told in lines[1]
