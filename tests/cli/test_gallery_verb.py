import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from tiny_world import World

from fprf.cli import main as cli


def gallery(run: Path, *words: str) -> str:
    assert cli.main(["gallery", str(run), *words, "--device", "cpu"]) == 0
    return (run / "gallery.html").read_text("utf-8")


def data_of(page: str) -> Any:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page)
    assert found is not None
    return json.loads(found[1])


def views(page: str) -> list[str]:
    """Names of the views, by the match maps of the style of all photographs."""
    maps = page.partition("Which reference each place")[2].partition("</article>")[0]
    return re.findall(r"<figcaption>([^<]*)</figcaption>", maps)


def test_a_folder_of_photographs_becomes_a_page(run: Path, world: World, capsys: pytest.CaptureFixture[str]) -> None:
    photos = run.parent / "photos"
    photos.mkdir()
    for path in world.references:
        shutil.copy(path, photos)
    (photos / "notes.txt").write_text("not a photograph")
    (photos / "broken.jpg").write_bytes(b"not a photograph")
    page = gallery(run, "--references", str(photos), "--split", "test")
    data = data_of(page)
    assert [style["name"] for style in data["styles"]] == ["Captured", "dusk", "snow", "dusk + snow"]
    assert [len(rows) for rows in data["stills"].values()] == [2] * 4, "a run of fields is shown in pictures"
    assert page.count("Which reference each place") == 1, "match maps where there is a choice"
    assert page.count('alt="Photograph 000') == 2 and "http" not in page.replace("http-equiv", "")
    told = capsys.readouterr()
    assert f"2 views in 3 styles: {run / 'gallery.html'}" in told.out
    assert "broken.jpg: no PNG, JPEG" in told.err, "it is named, and the others are shown"


def test_views_are_chosen_evenly_or_by_name(run: Path, world: World) -> None:
    photo = ["--references", *map(str, world.references)]
    page = gallery(run, *photo, "--split", "all", "--most", "4")
    assert views(page) == ["0000", "0002", "0005", "0007"]
    page = gallery(run, *photo, "--views", "0007", "0001", "--title", "My <town>")
    assert views(page) == ["0007", "0001"]
    assert "My &lt;town&gt;" in page


def test_style_files_are_styles_of_the_page(run: Path, world: World) -> None:
    style = run.parent / "mine" / "style.json"
    style.parent.mkdir()
    references = [str(path) for path in world.references]
    style.write_text(json.dumps({"format": 1, "style": {"references": references, "strength": 0.5}}))
    page = gallery(run, "--styles", str(style), "--views", "0000")
    assert [style["name"] for style in data_of(page)["styles"]] == ["Captured", "mine"]
    page = gallery(run, "--references", references[0], "--between", str(style), "--views", "0000")
    assert [style["name"] for style in data_of(page)["styles"]] == ["Captured", "dusk"], "on the way to another style"
