import json
from pathlib import Path
from typing import Any

import pytest

from fprf.errors import CheckpointError
from fprf.training.run import read_history


def write(folder: Path, *events: dict[str, Any] | str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    text = "\n".join(event if isinstance(event, str) else json.dumps(event) for event in events)
    (folder / "events.jsonl").write_text(text)
    return folder


def step(number: int, seconds: float, psnr: float = 20.0, **losses: float) -> dict[str, Any]:
    return {"step": number, "seconds": seconds, "psnr": psnr, "losses": losses}


def test_values_by_step(tmp_path: Path) -> None:
    (history,) = read_history(write(tmp_path, step(1, 0.5, 12.0, rgb=0.3), step(9, 4.0, 15.0, rgb=0.1, content=2.0)))
    assert (history.name, history.step, history.seconds) == ("", [1, 9], [0.5, 4.0])
    assert history.values == {"psnr": [12.0, 15.0], "rgb": [0.3, 0.1], "content": [None, 2.0]}
    assert history.parts == {} and history.notes == []


def test_a_resume_from_before_drops_what_came_later(tmp_path: Path) -> None:
    (history,) = read_history(write(tmp_path, step(1, 1), step(5, 5, 30.0), step(9, 9), step(5, 5.5, 31.0), step(8, 9)))
    assert history.step == [1, 5, 8] and history.values["psnr"] == [20.0, 31.0, 20.0]


def test_parts_add_up_over_resumes_and_other_lines_are_notes(tmp_path: Path) -> None:
    run = write(
        tmp_path,
        {"part": "preparing", "seconds": 2.5},
        step(1, 1),
        {"step": 3, "skipped": "rgb"},
        {"damaged": "step-5: model"},
        {"part": "preparing", "seconds": 0.5},
        {"part": "training", "seconds": 7},
    )
    (history,) = read_history(run)
    assert history.parts == {"preparing": 3.0, "training": 7.0} and history.step == [1]
    assert history.notes == ["step: 3, skipped: rgb", "damaged: step-5: model"]


def test_damaged_lines_and_values_are_left_out(tmp_path: Path) -> None:
    run = write(tmp_path, step(1, 1), '{"step": 2, "seco', "[1]", '{"step": 3, "seconds": 2, "psnr": NaN, "kept": true}')
    (history,) = read_history(run)
    assert history.step == [1, 3] and history.values == {"psnr": [20.0, None], "kept": [None, None]}


def test_blocks_have_histories_of_their_own(tmp_path: Path) -> None:
    write(tmp_path / "blocks" / "01", step(3, 1))
    write(tmp_path / "blocks" / "00", step(2, 1))
    write(tmp_path / "blocks" / "surroundings", "")
    assert [(history.name, history.step) for history in read_history(tmp_path)] == [("00", [2]), ("01", [3])]


def test_without_a_line_it_says_so(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no events\.jsonl with a line of training"):
        read_history(tmp_path)
    with pytest.raises(CheckpointError):
        read_history(write(tmp_path, "{", "nothing"))
