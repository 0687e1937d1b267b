"""The page as one file: the scene in 3D with its styles, and below it film, held-out views, references, figures.

It loads nothing. Where there are no Gaussians, or no WebGL 2, the stage shows pictures in their place.
"""

import base64
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from string import Template
from types import MappingProxyType
from typing import Annotated, Any, NamedTuple
from urllib.parse import quote

import torch
from torch import Tensor

from ..errors import DataError
from ..io.atomic import write_text
from ..io.figures import Metrics, figures, number
from ..io.images import Picture, data_uri, shrink, to_uint8
from ..io.maps import palette
from ..rendering.cameras import Cameras
from ..rendering.paths import upwards
from ..splats.photographs import camera_of
from ..splats.scene import SplatScene
from .pack import colour_header, colour_section, header, importance, pack, sections

CAPTURED = "Captured"
_STILL, _VIEW, _MAP, _REFERENCE, _THUMB = 800, 512, 320, 320, 160
"""Longest sides in pixels: of pictures on the stage and below it, of match maps, references and cards."""
_CAMERAS = 48
"""Captured cameras that one can go to, at most."""
_ROOM = 1.6
"""How far one may go from the middle of the cameras, relative to the farthest of them."""
_SMALL_FILM = 1.5 * 2**20
"""Bytes up to which a film is put into the page, and a third of the budget at most."""


class Reference(NamedTuple):
    """A photograph that a style was taken from."""

    name: str
    image: Picture


class Style(NamedTuple):
    """A restyled scene."""

    name: str
    stills: Sequence[Picture]
    """Pictures of views, in the order of the originals; one or more."""
    harmonics: Annotated[Tensor, "N K 3"] | None = None
    """Of the Gaussians, where there are any."""
    references: Sequence[str] = ()
    """Names of its references, in dictionary order."""
    shares: Sequence[float] = ()
    """Share of the scene that each of them styled; none where that was not measured."""
    matches: Sequence[Picture] = ()
    """Match maps, one per view or fewer."""
    metrics: Metrics = MappingProxyType({})


class PageView(NamedTuple):
    """A view of the scene as captured."""

    name: str
    original: Picture
    photograph: Picture | None = None
    """What a camera saw there."""
    depth: Picture | None = None


@dataclass(frozen=True, kw_only=True)
class Page:
    """What a page shows. Names, `lead` and `credits` are shown as text, whatever they hold."""

    title: str
    lead: str = ""
    facts: Mapping[str, str | int | float]
    """A few, by their labels ("Photographs": 34)."""
    views: Sequence[PageView]
    """At least one."""
    styles: Sequence[Style]
    references: Sequence[Reference] = ()
    scene: SplatScene | None = None
    """The Gaussians as captured; None = the stage shows pictures."""
    start: int = 0
    """Camera of the scene that the stage begins at."""
    metrics: Metrics = field(default_factory=dict)
    film: Path | None = None
    """H.264 or WebP; embedded where it is small, else linked beside the page."""
    credits: Sequence[str] = ()


def write_page(path: Path, page: Page, *, megabytes: float | None = None) -> int:
    """Write the page to `path` (.html), whole or not at all; return how many Gaussians it shows.

    With `megabytes` (2^20 bytes), Gaussians that show least are left out until the file is no larger. Raises DataError where
    pictures do not belong together, or where the page without any Gaussian is larger.
    """
    _check(page)
    room = None if megabytes is None else int(megabytes * 2**20)
    film = "" if page.film is None else _film(page.film, path, _SMALL_FILM if room is None else min(_SMALL_FILM, room / 3))
    fixed = _text(page, film, None, {})
    if page.scene is None:
        write_text(path, fixed)
        return 0
    count, kept = len(page.scene.gaussians), None
    weight: Tensor | None = None
    for _ in range(4):
        head, parts = packed_scene(page.scene, [page.scene.shown.harmonics, *_harmonics(page)], kept, page.start)
        text = _text(page, film, head, parts)
        size = len(text.encode())
        if room is None or size <= room:
            write_text(path, text)
            return int(head["count"])
        share = (room - len(fixed.encode())) / max(1, size - len(fixed.encode()))
        if share <= 0.02:
            raise DataError(
                f"{path}: {len(fixed.encode()) / 2**20:.1f} MiB without any Gaussian; allow more than {megabytes} MiB"
            )
        if weight is None:
            scene = page.scene
            weight = importance(scene.gaussians, scene.views, antialiased=scene.antialiased, near=scene.near)
        # A little less than would fit by the mean: what shows most compresses least.
        now = count if kept is None else len(kept)
        kept = weight.topk(max(1, int(0.98 * share * now))).indices.sort().values
    raise DataError(f"{path}: no fit into {megabytes} MiB; allow more")


def packed_scene(
    scene: SplatScene, harmonics: Sequence[Annotated[Tensor, "N K 3"]], kept: Tensor | None, start: int
) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Head and deflated sections of a scene's Gaussians, of those `kept`, in several colours, of which the first is captured.

    The page begins at the camera `start`.
    """
    gaussians = scene.gaussians.recoloured(harmonics[0])
    if kept is not None:
        gaussians, harmonics = gaussians.select(kept), [each[kept] for each in harmonics]
    packed = pack(gaussians)
    parts, styles = sections(packed), []
    for k, each in enumerate(harmonics):
        colours = packed.colours(each)
        styles.append(colour_header(colours))
        parts[f"style-{k}"] = colour_section(colours)
    return {**header(packed), **about(scene, start), "styles": styles}, parts


def about(scene: SplatScene, start: int) -> dict[str, Any]:
    """Cameras of a scene and what drawing it needs, for the page's script."""
    cameras = scene.views
    others = torch.linspace(0, len(cameras) - 1, min(_CAMERAS, len(cameras))).round().long().unique().tolist()
    chosen = [start, *(view for view in others if view > start), *(view for view in others if view < start)]
    depths = [_depth(scene, view) for view in chosen]
    up = torch.nn.functional.normalize(upwards(cameras).double(), dim=0)
    place = cameras.pose[:, :, 3].double()
    centre = place.mean(0)
    radius = _ROOM * float((place - centre).norm(dim=1).max()) + 0.5 * sorted(depths)[len(depths) // 2]
    return {
        "antialiased": scene.antialiased,
        "near": scene.near,
        "background": list(scene.background),
        "up": up.tolist(),
        "reach": {"centre": centre.tolist(), "radius": radius},
        "cameras": [_camera(cameras, view, depth) for view, depth in zip(chosen, depths, strict=True)],
    }


def _camera(cameras: Cameras, view: int, depth: float) -> dict[str, Any]:
    """A captured camera: world to camera by columns, fx fy cx cy, size, and the distance that it turns about."""
    camera = camera_of(cameras, view)
    intrinsics = camera.intrinsics
    return {
        "view": [round(x, 7) for x in camera.world_to_camera.T.flatten().tolist()],
        "lens": [round(float(intrinsics[k]), 3) for k in ((0, 0), (1, 1), (0, 2), (1, 2))],
        "size": [camera.width, camera.height],
        "depth": depth,
    }


def _depth(scene: SplatScene, view: int) -> float:
    """Distance along a camera's axis of the middle of what its picture shows: weighted median of the Gaussians in it."""
    camera = camera_of(scene.views, view)
    at = scene.gaussians.means.double() @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    depth = at[:, 2].clamp_min(1e-9)
    middle = camera.intrinsics[:2, 2] + at[:, :2] / depth[:, None] * camera.intrinsics.diagonal()[:2]
    size = torch.tensor([camera.width, camera.height]).double()
    inside = (at[:, 2] > scene.near) & ((middle - size / 2).abs() < size / 3).all(1)
    return float(depth[inside].median()) if bool(inside.any()) else 1.0


def _harmonics(page: Page) -> list[Tensor]:
    return [style.harmonics for style in page.styles if style.harmonics is not None]


def _check(page: Page) -> None:
    known = {reference.name for reference in page.references}
    if not page.views:
        raise DataError("page: no views; at least one")
    for style in page.styles:
        if not 0 < len(style.stills) <= len(page.views):
            raise DataError(f"page: style {style.name} has {len(style.stills)} pictures of {len(page.views)} views")
        if (style.harmonics is None) != (page.scene is None):
            raise DataError(f"page: style {style.name} has harmonics, or the page a scene, but not both")
        if style.shares and len(style.shares) != len(style.references):
            raise DataError(f"page: style {style.name} has {len(style.shares)} shares of {len(style.references)} references")
        for name in style.references:
            if name not in known:
                raise DataError(f"page: style {style.name} names reference {name}; known are {', '.join(sorted(known))}")


def script(*names: str) -> str:
    """The page's scripts, one after the other."""
    here = files(__package__)
    return "\n".join((here / name).read_text("utf-8") for name in ("splats.js", "place.js", "page.js", *names))


def _text(page: Page, film: str, head: Mapping[str, Any] | None, parts: Mapping[str, bytes]) -> str:
    """The page; `head` None = without Gaussians."""
    here = files(__package__)
    names = [CAPTURED, *(style.name for style in page.styles)]
    # With Gaussians one picture a style is enough: it stands in until the first frame, and where there is no WebGL 2.
    most = 1 if page.scene is not None else len(page.views)
    pictures = [[view.original for view in page.views], *(style.stills for style in page.styles)]
    stills = [[data_uri(shrink(each, _STILL)) for each in row[:most]] for row in pictures]
    heads = [{}] * len(names) if head is None else head["styles"]
    data = {
        "scene": None if head is None else {key: value for key, value in head.items() if key != "styles"},
        "styles": [
            {"name": name, "thumb": data_uri(shrink(row[0], _THUMB)), **about_colours}
            for name, row, about_colours in zip(names, pictures, heads, strict=True)
        ],
        "stills": dict(zip(names, stills, strict=True)),
    }
    height, width = page.views[0].original.shape[:2]
    known = {reference.name: reference for reference in page.references}
    blocks = "\n".join(_style(style, page.views, known) for style in page.styles)
    maps = "".join(_figure(view.depth, view.name, _MAP) for view in page.views if view.depth is not None)
    below = [
        ("Film", film),
        ("Views", _views(page.views) if any(view.photograph is not None for view in page.views) else ""),
        ("Styles", blocks),
        ("Depth", f'<div class="grid small">{maps}</div>' if maps else ""),
        ("Figures", _figures(page.metrics)),
    ]
    present = [(name, part) for name, part in below if part]
    code = f"{script()}\nopen(JSON.parse(at('data').textContent));\n"
    return Template((here / "page.html").read_text("utf-8")).substitute(
        title=escape(page.title),
        lead=f'<p class="lead">{escape(page.lead)}</p>' if page.lead else "",
        css=(here / "page.css").read_text("utf-8"),
        hash=f"'sha256-{base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()}'",
        nav="\n".join(f'<a href="#{name.lower()}">{name}</a>' for name, _ in present),
        stage=Template((here / "stage.html").read_text("utf-8")).substitute(
            still=f'src="{stills[0][0]}"', ratio=f"{width / height:.4f}", facts=_facts(page.facts)
        ),
        body="\n".join(f'<section id="{name.lower()}"><h2>{name}</h2>\n{part}\n</section>' for name, part in present),
        credits="\n".join(f"<p>{escape(line)}</p>" for line in page.credits),
        # "<" cannot end the script then, whatever a name holds.
        data=json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"),
        sections="\n".join(
            f'<script type="text/plain" id="data-{name}">{base64.b64encode(part).decode()}</script>'
            for name, part in parts.items()
        ),
        script=code,
    )


def _img(picture: Picture, side: int, alt: str) -> str:
    small = shrink(picture, side)
    height, width = small.shape[:2]
    return (
        f'<img src="{data_uri(small)}" alt="{escape(alt)}" width="{width}" height="{height}" decoding="async" loading="lazy">'
    )


def _figure(picture: Picture, name: str, side: int) -> str:
    return f"<figure>{_img(picture, side, name)}<figcaption>{escape(name)}</figcaption></figure>"


def _facts(facts: Mapping[str, str | int | float]) -> str:
    rows = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(number(fact))}</dd></div>" for name, fact in facts.items())
    return f'<dl class="facts">{rows}</dl>' if rows else ""


def _views(views: Sequence[PageView]) -> str:
    """Photographs beside what the scene shows from their places."""
    rows = "".join(
        f'<figure><div class="pair">{_img(view.photograph, _VIEW, f"Photograph {view.name}")}'
        f"{_img(view.original, _VIEW, f'View {view.name}')}</div><figcaption>{escape(view.name)}</figcaption></figure>"
        for view in views
        if view.photograph is not None
    )
    return (
        f'<p class="lead">Photographs that training did not see, and beside them the scene.</p><div class="grid">{rows}</div>'
    )


def _style(style: Style, views: Sequence[PageView], known: Mapping[str, Reference]) -> str:
    """References of a style, with the colours of its match maps and with shares where there are any; its figures; the maps."""
    rows = []
    colours = to_uint8(palette(len(style.references))[None])[0] if style.references else []
    for place, name in enumerate(style.references):
        chip = f'<i class="chip" style="background:rgb({",".join(map(str, colours[place]))})"></i>' if style.matches else ""
        share = f'<data value="{style.shares[place]:.4f}">{style.shares[place]:.0%}</data>' if style.shares else ""
        image = _img(known[name].image, _REFERENCE, f"Reference {name}")
        rows.append(f"<figure>{image}<figcaption>{chip}<span>{escape(name)}</span>{share}</figcaption></figure>")
    measured = "".join(
        f"<div><dt>{escape(row.label)}</dt><dd>{escape(row.value)} {escape(row.unit)}</dd></div>"
        for row in figures(style.metrics)
    )
    maps = "".join(_figure(each, view.name, _MAP) for view, each in zip(views, style.matches, strict=False))
    return f"""<article class="style"><h3>{escape(style.name)}</h3>
<div class="sources">{"".join(rows)}</div>
{f'<dl class="measured">{measured}</dl>' if measured else ""}
{f'<p class="lead">Which reference each place took its style from</p><div class="grid small">{maps}</div>' if maps else ""}
</article>"""


def _film(video: Path, page: Path, most: float) -> str:
    """A film, embedded where it has at most so many bytes."""
    size = video.stat().st_size
    with video.open("rb") as file:
        data = file.read(int(most) + 1)
    beside = quote(Path(os.path.relpath(video, page.parent)).as_posix())
    animated = video.suffix.lower() == ".webp"
    media, small = "image/webp" if animated else "video/mp4", size <= most
    source = f"data:{media};base64,{base64.b64encode(data).decode('ascii')}" if small else escape(beside)
    if animated and small:
        return f'<img class="flight" src="{source}" alt="Flight through the scene" decoding="async">'
    # The codec's box lies at the front of what we write; other codecs do not play in browsers.
    if animated or b"avc1" not in data:
        link = f'<a href="{escape(beside)}">{escape(video.name)}</a>'
        return f'<p class="lead">This film lies beside the page, for a player: {link}</p>'
    return (
        f'<video class="flight" src="{source}" controls loop muted playsinline preload="metadata" aria-label="Flight"></video>'
    )


def _figures(metrics: Metrics) -> str:
    tables = []
    for group, rows in groupby(figures(metrics), key=lambda figure: figure.group):
        body = "".join(
            f'<tr><th scope="row">{escape(row.label)}</th><td class="value">{escape(row.value)}</td>'
            f'<td class="unit">{escape(row.unit)}</td></tr>'
            for row in rows
        )
        tables.append(f"<table><caption>{escape(group or 'Quality and cost')}</caption><tbody>{body}</tbody></table>")
    return f'<div class="figures">{"".join(tables)}</div>' if tables else ""
