"""Pages in one file: what they hold, what they load, their size; packed Gaussians."""

import base64
import hashlib
import json
import re
import zlib
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from pages import page_of, recoloured, seen, street, written
from splat_ball import ball

from fprf.errors import DataError, UsageError
from fprf.page.pack import CHUNK, fit_maps, pack
from fprf.page.writer import PageView, Style, packed_scene, page_html, write_page
from fprf.splats.files.base import three_to_four
from fprf.splats.gaussians import HARMONIC, Gaussians
from fprf.splats.pinholes import camera_of

VOID = {"meta", "link", "img", "input", "br"}
EVIL = """<script>alert(1)</script>"'&<b>${x}$title"""


class Read(HTMLParser):
    """Reads a page strictly: every tag that opens also closes, in order."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.text: list[str] = []
        self.scripts: dict[str, str] = {}
        self.whole = path.read_text("utf-8")
        self.feed(self.whole)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            self.scripts[self.tags[-1][1].get("id", "")] = data
        elif self.open and self.open[-1] != "style":
            self.text.append(data)

    @property
    def data(self) -> Any:
        return json.loads(self.scripts["data"])

    def all(self, tag: str, **wanted: str) -> list[dict[str, str]]:
        return [attrs for name, attrs in self.tags if name == tag and wanted.items() <= attrs.items()]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Read:
    return Read(written(tmp_path_factory.mktemp("page") / "page.html", seen(ball(500, 2))))


def test_nothing_is_loaded_from_anywhere(page: Read) -> None:
    assert not re.search(r"(?i)https?:|//[a-z0-9-]+\.[a-z]|@import|[^t]url\((?!.data:font)", page.whole)
    for tag, attrs in page.tags:
        assert attrs.get("src", "data:").startswith("data:"), tag
        assert attrs.get("href", "#").startswith(("#", "data:,")), tag
        assert not [name for name in attrs if name.startswith("on")], tag
    (policy,) = page.all("meta", **{"http-equiv": "Content-Security-Policy"})
    digest = base64.b64encode(hashlib.sha256(page.scripts[""].encode()).digest()).decode()
    assert "default-src 'none'" in policy["content"] and f"script-src 'sha256-{digest}'" in policy["content"]


def test_it_holds_shapes_once_and_four_bytes_a_style(page: Read) -> None:
    parts = {
        name: zlib.decompress(base64.b64decode(text))
        for name, text in page.scripts.items()
        if name.startswith("data-")
    }
    assert len(parts["data-shape"]) == 16 * 500
    rows = [len(parts[f"data-style-{k}"]) - 36 * page.data["styles"][k]["maps"] for k in range(3)]
    assert rows == [4 * 500] * 3
    assert [style["name"] for style in page.data["styles"]] == ["Captured", "dusk", "plain"]
    assert parts["data-style-0"] == parts["data-style-2"] != parts["data-style-1"]


def test_embedded_pictures_decode_and_are_of_the_size_they_claim(page: Read) -> None:
    for image in page.all("img", loading="lazy"):
        pixels = cv2.imdecode(
            np.frombuffer(base64.b64decode(image["src"].split(",")[1]), np.uint8), cv2.IMREAD_COLOR
        )
        assert pixels.shape[:2] == (int(image["height"]), int(image["width"])) and image["alt"]


def test_names_are_text_whatever_they_hold(tmp_path: Path) -> None:
    scene = seen(ball(200))
    plain = page_of(scene)
    evil = replace(
        plain,
        title=EVIL,
        lead=EVIL,
        facts={EVIL: EVIL},
        views=[PageView(EVIL, view.original, view.photograph) for view in plain.views],
        styles=[
            style._replace(name=EVIL + str(k), references=[EVIL]) for k, style in enumerate(plain.styles)
        ],
        references=[plain.references[0]._replace(name=EVIL)],
        credits=[EVIL],
    )
    write_page(tmp_path / "evil.html", evil)
    read = Read(tmp_path / "evil.html")
    assert "<b>" not in read.whole.replace("Object", "") and EVIL in "".join(read.text)
    assert read.data["styles"][1]["name"] == f"{EVIL}0"
    assert len(read.all("script")) == len(Read(written(tmp_path / "plain.html", scene)).all("script"))


def test_a_budget_drops_what_shows_least(tmp_path: Path) -> None:
    scene = seen(ball(20_000))
    small = page_of(scene)
    count = write_page(tmp_path / "all.html", small)
    whole = (tmp_path / "all.html").stat().st_size
    kept = write_page(tmp_path / "some.html", small, megabytes=0.6 * whole / 2**20)
    size = (tmp_path / "some.html").stat().st_size
    assert count == 20_000 > kept > 1000 and 0.45 * whole < size <= 0.6 * whole
    one = replace(small, views=small.views[:1])
    fixed = len(page_html(replace(one, scene=None))[0].encode())
    assert 20 < page_html(one, megabytes=(fixed + 0.01 * (whole - fixed)) / 2**20)[1] < 200, "few of many"
    with pytest.raises(UsageError, match="two looks are called 'Captured'"):
        write_page(tmp_path / "none.html", replace(small, styles=[small.styles[0]._replace(name="Captured")]))
    with pytest.raises(DataError, match="without any Gaussian"):
        write_page(tmp_path / "none.html", small, megabytes=0.01)
    assert not (tmp_path / "none.html").exists()


def test_without_gaussians_there_are_pictures(tmp_path: Path) -> None:
    views = [PageView(str(k), np.full((20, 30, 3), 40 * k, np.uint8)) for k in range(3)]
    page = replace(
        page_of(seen(ball(50))),
        scene=None,
        views=views,
        styles=[Style("dusk", [view.original for view in views])],
    )
    assert write_page(tmp_path / "field.html", page) == 0
    data = Read(tmp_path / "field.html").data
    assert data["scene"] is None and {name: len(rows) for name, rows in data["stills"].items()} == {
        "Captured": 3,
        "dusk": 3,
    }


def unpacked(gaussians: Gaussians, entries: int = 4096) -> tuple[torch.Tensor, Gaussians]:
    """Order and what a browser reads: the inverse of the packing, written from its description."""
    packed = pack(gaussians, entries)
    words = packed.shape.view("<u4").astype(np.int64)
    chunk = packed.chunks[np.arange(len(words)) // CHUNK].astype(np.float64)
    place = np.stack([words[:, 0] & 65535, words[:, 0] >> 16, words[:, 1] & 65535], 1) / 65535
    size = np.stack([words[:, 3] >> shift & 255 for shift in (0, 8, 16)], 1) / 255
    turn = np.stack([words[:, 2] >> shift & 1023 for shift in (0, 10, 20)], 1) / 1023 * 2 - 1
    means = chunk[:, :3] + place * (chunk[:, 3:6] - chunk[:, :3])
    scales = chunk[:, 6:9] + size * (chunk[:, 9:] - chunk[:, 6:9])
    level = packed.palette[..., :3].astype(np.float64) / 127
    rest = (
        (packed.largest * level * abs(level))[words[:, 1] >> 16]
        if level.size
        else np.zeros((len(words), 0, 3))
    )
    colours = packed.colours(gaussians.harmonics)
    mean = colours.low + colours.rows[:, :3] / 255 * (colours.high - colours.low)
    harmonics = np.concatenate([((mean - 0.5) / HARMONIC)[:, None], rest], 1)
    opacity = torch.logit(torch.from_numpy(words[:, 3] >> 24) / 255, 1e-6)
    parts = [
        torch.from_numpy(each).float()
        for each in (means, three_to_four(words[:, 2] >> 30, turn), scales, harmonics)
    ]
    return packed.order, Gaussians(parts[0], parts[1], parts[2], opacity.float(), parts[3])


@pytest.mark.parametrize("gaussians", [ball(700, 0), ball(3000, 2), street(), ball(300, 3), ball(1)], ids=len)
def test_what_is_packed_is_near_to_what_was_given(gaussians: Gaussians) -> None:
    order, read = unpacked(gaussians)
    given = gaussians.select(order)
    assert sorted(order.tolist()) == list(range(len(gaussians)))
    spread = given.means.norm(dim=1, keepdim=True) + 1
    assert float(((read.means - given.means) / spread).abs().max()) < 1e-3
    assert float((read.log_scales - given.log_scales).abs().max()) < 0.03
    assert float((read.opacities - given.opacities).abs().max()) < 0.003
    turned = (torch.nn.functional.normalize(given.quaternions, dim=1) * read.quaternions).sum(1).abs()
    assert float(turned.min()) > 0.9999
    assert float((read.colours - given.colours.clamp(-1, 2)).abs().max()) < 0.007
    kept = read.harmonics.shape[1]
    assert kept == min(9, given.harmonics.shape[1])
    if kept > 1:
        assert float((read.harmonics[:, 1:] - given.harmonics[:, 1:kept]).abs().max()) < 0.01


def test_a_palette_of_few_entries_keeps_most_of_the_harmonics() -> None:
    gaussians = ball(3000, 2)
    order, read = unpacked(gaussians, 256)
    given = gaussians.select(order).harmonics[:, 1:]
    assert float((read.harmonics[:, 1:] - given).square().mean()) < 0.8 * float(given.square().mean())


def test_the_maps_of_a_style_carry_its_view_dependence() -> None:
    gaussians = ball(2000, 2)
    styled = recoloured(gaussians)
    label, maps = fit_maps(gaussians.harmonics[:, 1:], styled[:, 1:])
    made = torch.einsum(
        "nkc,ncd->nkd", gaussians.harmonics[:, 1:], torch.from_numpy(maps).view(-1, 3, 3)[label.astype(int)]
    )
    assert float((made - styled[:, 1:]).abs().max()) < 1e-4
    assert len(maps) <= 256


def test_chats_find_a_title_and_a_picture_where_the_page_has_an_address(tmp_path: Path) -> None:
    path = written(tmp_path / "ball.html", seen(ball(50)), address="https://example.org/a/ball.html")
    text = path.read_text()
    assert '<meta property="og:title" content="Ball">' in text
    assert '<meta property="og:image" content="https://example.org/a/ball.jpg">' in text
    assert cv2.imread(str(tmp_path / "ball.jpg")).shape[2] == 3
    assert "og:image" not in written(tmp_path / "plain.html", seen(ball(50))).read_text()
    assert not (tmp_path / "plain.jpg").exists()


def test_views_found_about_an_object_have_seen_beyond_their_frames(tmp_path: Path) -> None:
    scene = seen(ball(200))
    camera = camera_of(scene.views, 0)
    corner = torch.tensor([[0.0], [0.0], [1.0]], dtype=torch.float64)
    point = camera.world_to_camera[:3, :3].T.double() @ (
        3 * torch.linalg.inv(camera.intrinsics.double()) @ corner
    )
    point = torch.cat([point[:, 0] + scene.views.pose[0, :, 3].double(), torch.ones(1)])
    for photographed, share in ((False, 0.3 / 1.6), (True, 0.0)):
        known = replace(scene, poses=lambda captured, views: torch.zeros(0)) if photographed else scene
        frame = torch.tensor(packed_scene(known, [scene.gaussians.harmonics], 0)[1]["seen"][0]).double()
        u, v, depth = frame[:12].view(3, 4) @ point
        assert u / depth == pytest.approx(share, abs=1e-3) and v / depth == pytest.approx(share, abs=1e-3)


def test_a_page_says_how_many_of_the_gaussians_it_holds(tmp_path: Path) -> None:
    scene = seen(ball(3000, 1))
    whole = page_html(page_of(scene))[0]
    assert "<dt>3D Gaussians</dt><dd>3,000</dd>" in whole
    text, count = page_html(page_of(scene), megabytes=0.9 * len(whole.encode()) / 2**20)
    assert f"<dt>3D Gaussians</dt><dd>{count:,} of 3,000</dd>" in text and count < 3000
