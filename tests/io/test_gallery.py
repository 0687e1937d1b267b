import base64
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fprf.errors import DataError
from fprf.io.gallery import Reference, Style, write_gallery
from fprf.io.video import write_video

VOID = {"meta", "link", "img", "input", "br"}
EVIL = """<script>alert(1)</script>"'&<b>${x}$title"""


class Page(HTMLParser):
    """Reads a page strictly: every tag that opens also closes, in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.text: list[str] = []
        self.whole = text
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("script", "style"):
            self.text.append(data)

    def all(self, tag: str, **wanted: str) -> list[dict[str, str]]:
        return [attrs for name, attrs in self.tags if name == tag and wanted.items() <= attrs.items()]


def picture(seed: int, height: int = 30, width: int = 40) -> np.ndarray:
    small = np.random.default_rng(seed).integers(0, 255, (3, 4, 3), dtype=np.uint8)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)


def content(**changes: Any) -> dict[str, Any]:
    views = [picture(index) for index in range(3)]
    styles = [
        Style("dusk", [picture(index + 10) for index in range(3)], ["city", "field"], [0.25, 0.75], [picture(20), picture(21)]),
        Style("plain", views),
    ]
    filled = {
        "title": "Town",
        "scene": {"Photographs": 34, "Resolution": "40 × 30"},
        "view_names": ["0001", "0002", "0003"],
        "originals": views,
        "references": [Reference("city", picture(30, 50, 30)), Reference("field", picture(31, 1400, 900))],
        "styles": styles,
        "depth": views,
        "metrics": {"psnr": 27.3, "consistency": {"short": {"rmse": 0.02, "relative": None}}},
    }
    return {**filled, **changes}


def page_of(path: Path, **changes: Any) -> Page:
    write_gallery(path, **content(**changes))
    return Page(path.read_text("utf-8"))


@pytest.fixture(scope="module")
def gallery(tmp_path_factory: pytest.TempPathFactory) -> Page:
    return page_of(tmp_path_factory.mktemp("gallery") / "gallery.html")


def test_nothing_is_loaded_from_anywhere(gallery: Page) -> None:
    assert not re.search(r"(?i)https?:|//[a-z0-9-]+\.|@import|url\(", gallery.whole)
    for tag, attrs in gallery.tags:
        assert attrs.get("src", "data:").startswith("data:"), tag
        assert attrs.get("href", "#").startswith(("#", "data:,")), tag
        assert not [name for name in attrs if name.startswith("on")], tag
    (policy,) = gallery.all("meta", **{"http-equiv": "Content-Security-Policy"})
    assert policy["content"].startswith("default-src 'none'; img-src data:;")


def decoded(image: dict[str, str]) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(base64.b64decode(image["src"].split(",")[1]), np.uint8), cv2.IMREAD_COLOR)


def test_embedded_pictures_decode_and_are_of_the_size_they_claim(gallery: Page) -> None:
    for image in gallery.all("img"):
        assert decoded(image).shape == (int(image["height"]), int(image["width"]), 3)
        assert max(decoded(image).shape) <= 1024
    (first,) = gallery.all("img", **{"class": "before"})
    shown = decoded(first)
    assert np.abs(cv2.cvtColor(shown, cv2.COLOR_BGR2RGB).astype(int) - picture(0)).mean() < 6


def test_the_wipe_and_its_choices_can_be_used_without_a_mouse(gallery: Page) -> None:
    (slider,) = gallery.all("input")
    assert slider["type"] == "range" and slider["aria-label"]
    assert [button["data-style"] for button in gallery.all("button") if "data-style" in button] == ["0", "1"]
    assert [button["data-view"] for button in gallery.all("button") if "data-view" in button] == ["0", "1", "2"]
    shots = [button["data-shot"] for button in gallery.all("button") if "data-shot" in button]
    assert shots == [f"{style}-{view}" for style in range(2) for view in range(3)]
    pressed = [button for button in gallery.all("button") if button.get("aria-pressed") == "true"]
    assert len(pressed) == 2
    assert all("alt" in image for image in gallery.all("img"))
    assert gallery.all("html")[0]["lang"] == "en"


def test_names_are_text_whatever_they_hold(tmp_path: Path) -> None:
    views = [picture(0)]
    page = page_of(
        tmp_path / "g.html",
        title=EVIL,
        scene={EVIL: EVIL},
        view_names=[EVIL],
        originals=views,
        references=[Reference(EVIL, views[0])],
        styles=[Style(EVIL, views, [EVIL], [1.0], views)],
        depth=views,
        metrics={EVIL: EVIL},
    )
    assert len(page.all("script")) == 1 and not page.all("b")
    assert "".join(page.text).count(EVIL) >= 8
    assert page.all("button")[0]["aria-pressed"] == "true"
    assert page.all("img")[0]["alt"] == f"View {EVIL}, {EVIL}"


def film(path: Path) -> Path:
    write_video(path, (np.full((32, 24, 3), index * 20, np.uint8) for index in range(6)), 12)
    return path


def test_a_film_is_part_of_the_page_or_linked_where_it_is_large(tmp_path: Path) -> None:
    pytest.importorskip("av")
    path = film(tmp_path / "films" / "my flight #1.mp4")
    (video,) = page_of(tmp_path / "g.html", video=path).all("video")
    assert base64.b64decode(video["src"].removeprefix("data:video/mp4;base64,")) == path.read_bytes()
    assert "controls" in video and "autoplay" not in video
    path.write_bytes(path.read_bytes() + bytes(9 * 2**20))
    (video,) = page_of(tmp_path / "page" / "g.html", video=path).all("video")
    assert video["src"] == "../films/my%20flight%20%231.mp4"


@pytest.mark.parametrize(
    "changes",
    [
        {"view_names": ["a"]},
        {"view_names": [], "originals": [], "styles": []},
        {"styles": [Style("s", [picture(0)])]},
        {"styles": [Style("s", [picture(0)] * 3, ["sea"])]},
        {"styles": [Style("s", [picture(0)] * 3, ["city"], [0.5, 0.5])]},
    ],
)
def test_what_does_not_fit_is_refused(tmp_path: Path, changes: dict[str, Any]) -> None:
    with pytest.raises(DataError):
        write_gallery(tmp_path / "g.html", **content(**changes))
    assert not list(tmp_path.iterdir())


def test_an_animated_picture_plays_without_h264_and_stands_beside_upright_views(tmp_path: Path) -> None:
    flight = film(tmp_path / "flight.webp")
    page = page_of(tmp_path / "wide.html", video=flight, credits=["By A <a@b>", EVIL])
    (shown,) = page.all("img", **{"class": "flight"})
    assert base64.b64decode(shown["src"].removeprefix("data:image/webp;base64,")) == flight.read_bytes()
    assert page.all("section", id="flight") and {"By A <a@b>", EVIL} <= {*page.text}
    upright = [picture(index, 40, 30) for index in range(3)]
    page = page_of(tmp_path / "upright.html", video=flight, originals=upright, styles=[Style("dusk", upright)])
    assert page.all("figure", **{"class": "beside"}) and not page.all("section", id="flight")
