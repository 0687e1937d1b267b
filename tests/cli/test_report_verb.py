import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from fprf.cli import main as cli


def test_a_trained_run(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run / "metrics.json").write_text(json.dumps({"psnr": 17.25, "render_seconds": 42.0}))
    (run / "styles" / "dusk").mkdir(parents=True)
    (run / "styles" / "dusk" / "style.json").write_text(json.dumps({"made": {"dictionary_seconds": 0.25}}))
    assert cli.main(["report", str(run)]) == 0
    out = capsys.readouterr().out
    assert "PSNR" in out and "rgb loss" in out and re.search(r"training +\S+ s +\d+% of the time", out)
    assert re.search(r"preparing +\S+ s", out) and re.search(r"own style +\S+ s", out), "training tells its parts"
    assert re.search(r"rendering for eval +42 s", out) and re.search(r"style dusk +0\.25 s", out)
    assert f"charts in {run / 'report.html'}" in out
    page = (run / "report.html").read_text("utf-8")
    assert page.count("<svg") >= 5 and "17.25" in page and "fprf-lite" in page
    assert not re.search(r"(?i)https?:|url\(|<script", page)


def test_blocks_are_lines_of_one_chart_and_trouble_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for k, block in enumerate(("00", "01")):
        folder = tmp_path / "blocks" / block
        folder.mkdir(parents=True)
        lines: list[dict[str, object]] = [{"damaged": "<b>step-2</b>"}]
        for s in (1, 2, 3):
            lines.append({"step": s, "seconds": s / 2, "psnr": 10 + s + k, "skipped_steps": k, "losses": {"rgb": 1 / s}})
        (folder / "events.jsonl").write_text("\n".join(map(json.dumps, lines)))
    page = tmp_path / "out" / "page.html"
    assert cli.main(["report", str(tmp_path), "--output", str(page)]) == 0
    out = capsys.readouterr().out
    assert "01: PSNR" in out and "12.00 → 14.00" in out and "00: damaged: <b>step-2</b>" in out and "01: skipped steps" in out
    text = page.read_text("utf-8")
    assert text.count("<polyline") == 6 and "&lt;b&gt;step-2" in text and "<b>step" not in text
    HTMLParser().feed(text)
