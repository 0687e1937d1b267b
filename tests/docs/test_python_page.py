"""The code of docs/python.md, word for word, on the tiny run."""

import os
import re
from pathlib import Path

import cv2
import pytest
from tiny_world import World

PAGE = Path(__file__).resolve().parents[2] / "docs" / "python.md"


def blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", page.read_text("utf-8"), re.DOTALL | re.MULTILINE)


def test_the_page_runs(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    os.symlink(world.run, tmp_path / "runs" / "town-fprf-lite")
    for name, reference in zip(("autumn.jpg", "night.jpg"), world.references, strict=True):
        cv2.imwrite(name, cv2.imread(str(reference)))
    names: dict[str, object] = {}
    for block in blocks(PAGE):
        exec(compile(block, str(PAGE), "exec"), names)
    told = capsys.readouterr().out
    assert "torch.Size([120, 160, 3])" in told and "'autumn.jpg'" in told and "'night.jpg'" in told
    made = {path.name for path in tmp_path.iterdir()}
    assert {"autumn.png", "film.mp4", "mine.json", "between-0.png", "between-2.png"} <= made
