import json
import re
import shutil
from pathlib import Path

import pytest
from tiny_world import World

from fprf.cli import main as cli


def gallery(run: Path, *words: str) -> str:
    assert cli.main(["gallery", str(run), *words, "--device", "cpu"]) == 0
    return (run / "gallery.html").read_text("utf-8")


def test_a_folder_of_photographs_becomes_a_page(run: Path, world: World, capsys: pytest.CaptureFixture[str]) -> None:
    photos = run.parent / "photos"
    photos.mkdir()
    for path in world.references:
        shutil.copy(path, photos)
    (photos / "notes.txt").write_text("not a photograph")
    (photos / "broken.jpg").write_bytes(b"not a photograph")
    (run / "metrics.json").write_text(json.dumps({"psnr": 17.25, "per_view": {"0000": {"psnr": 3.125}}}))
    page = gallery(run, "--references", str(photos), "--split", "test")
    assert re.findall(r'data-style="\d".*?<span>([^<]*)</span></button>', page) == ["dusk", "snow", "dusk + snow"]
    assert re.findall(r'data-shot="(\d-\d)"', page) == [f"{style}-{view}" for style in range(3) for view in range(2)]
    assert set(re.findall(r'data-match="(\d-\d)"', page)) == {"2-0", "2-1"}, "match maps where there is a choice"
    assert page.count('data-go="') == 8 and "17.25" in page and "3.125" not in page
    assert page.count("Match score") == 3 and "<video" not in page and "http" not in page.replace("http-equiv", "")
    told = capsys.readouterr()
    assert f"2 views in 3 styles: {run / 'gallery.html'}" in told.out
    assert "broken.jpg: no PNG, JPEG" in told.err, "it is named, and the others are shown"


def test_views_are_chosen_evenly_or_by_name(run: Path, world: World) -> None:
    photo = ["--references", str(world.references[0])]
    page = gallery(run, *photo, "--split", "all", "--most", "4")
    assert re.findall(r'data-view="\d" aria-pressed="\w+" title="([^"]*)"', page) == ["0000", "0002", "0005", "0007"]
    assert 'id="overview"' not in page, "one style is seen anyway"
    page = gallery(run, *photo, "--views", "0007", "0001", "--title", "My <town>")
    assert re.findall(r'data-view="\d" aria-pressed="\w+" title="([^"]*)"', page) == ["0007", "0001"]
    assert "My &lt;town&gt;" in page


def test_style_files_and_a_flight(run: Path, world: World) -> None:
    style = run.parent / "mine" / "style.json"
    style.parent.mkdir()
    references = [str(path) for path in world.references]
    style.write_text(json.dumps({"format": 1, "style": {"references": references, "strength": 0.5}}))
    page = gallery(run, "--styles", str(style), "--views", "0000", "--frames", "2", "--path", "orbit")
    assert re.findall(r'data-style="\d".*?<span>([^<]*)</span></button>', page) == ["mine"]
    assert (run / "gallery.mp4").stat().st_size > 100 and 'id="flight"' in page
