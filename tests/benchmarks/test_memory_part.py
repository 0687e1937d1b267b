import io
import json
import sys
from pathlib import Path

import pytest
from tiny_world import World

from benchmarks.peak_memory import PARTS, measure_part, peak_mib


def test_peak_is_read_from_the_systems_books(tmp_path: Path) -> None:
    status = tmp_path / "status"
    status.write_text("Name:\tpython\nVmPeak:\t  999999 kB\nVmHWM:\t  204800 kB\n")
    assert peak_mib(status) == 200


@pytest.mark.parametrize("part", PARTS)
def test_a_part_does_its_work_and_prints_json(
    part: str, world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = {
        "part": part, "run": str(world.run), "data": None, "device": "cpu", "rays": 64, "folder": str(tmp_path),
        "references": [str(path) for path in world.references],
    }  # fmt: skip
    monkeypatch.setattr(sys, "stdin", io.StringIO(json.dumps(asked)))
    assert measure_part() == 0
    taken = json.loads(capsys.readouterr().out)
    assert taken["peak_device_mib"] is None and 20 < taken["peak_rss_mib"] < 2**20
