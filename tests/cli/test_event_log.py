"""Lines of events.jsonl: not too many, and the last one always."""

import json
from pathlib import Path

import pytest

from fprf.cli import progress
from fprf.cli.progress import EventLog
from fprf.training.run import Run
from fprf.training.trainer import Report


def report(step: int, share: float) -> Report:
    return Report(
        step=step,
        share=share,
        seconds=1.0,
        psnr=20.12345,
        rays_per_second=1000.4,
        kept=0.123456,
        skipped=2,
        losses={"rgb": 1 / 3},
    )


def lines(folder: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]


def test_lines_come_every_few_seconds_and_at_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(progress.time, "perf_counter", lambda: now)
    log = EventLog(Run(tmp_path))
    for step, seconds, share in ((1, 0.0, 0.1), (2, 1.0, 0.2), (3, 6.0, 0.5), (4, 6.5, 0.9), (5, 7.0, 1.0)):
        now = 100.0 + seconds
        log(report(step, share))
    assert [each["step"] for each in lines(tmp_path)] == [1, 3, 5]


def test_a_line_is_short_and_complete(tmp_path: Path) -> None:
    EventLog(Run(tmp_path))(report(7, 1.0))
    (line,) = lines(tmp_path)
    assert line["psnr"] == 20.123 and line["rays_per_second"] == 1000 and line["kept"] == 0.1235
    assert line["skipped_steps"] == 2 and line["losses"] == {"rgb": 0.3333}
