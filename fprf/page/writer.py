"""The page as one file: the scene in 3D with its styles, and below it held-out views and the references.

It loads nothing. Where there are no Gaussians, or no WebGL 2, the stage shows pictures in their place.
"""

import base64
import hashlib
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..errors import DataError, UsageError
from ..io.atomic import write_text
from ..io.images import Picture, data_uri, shrink, to_uint8, write_image
from ..io.maps import palette
from ..rendering.cameras import Cameras
from ..rendering.paths import upwards
from ..scenes import Scene
from ..splats.pinholes import camera_of, covering
from ..splats.scene import SplatScene
from . import PAGE_SCRIPTS, css, read_asset, script
from .pack import Packed, colour_header, colour_section, header, pack, sections
from .suns import Suns, packed_day

CAPTURED = "Captured"
_STAGE_PIXELS = 800
"""Longest side of a picture on the stage; by eye."""
_VIEW_PIXELS = 512
"""Longest side of a view below it; by eye."""
_MATCH_MAP_PIXELS = 320
"""Longest side of a match map; by eye."""
_CHAT_PICTURE_PIXELS = 1200
"""Longest side of the picture that chats show of a page, at most: what they take."""
_BESIDE_STYLE_PIXELS = 96
"""Longest side of a reference beside its style: twice as many as it takes there."""
REFERENCE_PIXELS = 320
"""Longest side of references: as match maps, which lie beside them."""
_MAX_PAGE_CAMERAS = 48
"""Captured cameras that one can go to, at most; by eye."""
_PACKING_SHARE = 0.5
"""Of the time that a scene is prepared in; the rest is the depths of its cameras (a million Gaussians, by eye)."""
_MAX_SEEN_CAMERAS = 256
"""Cameras that say what was photographed, at most; by eye: frames of neighbours overlap."""
_PHOTOGRAPHS_FILL = 0.75
"""Filling of a stage of another format, from 0 (all of a photograph is seen) to 1 (nothing beyond it is);
by eye. Views of captures show whole objects.
"""
_BEYOND_FOUND = 0.3
"""Share of a frame beyond each of its sides that views found about an object count as having seen; by eye."""
_REACH_RATIO = 1.6
"""Distance that one may go from the middle of the cameras, relative to the farthest of them; by eye."""
_REACH_DEPTHS = 0.5
"""Addition to it, in the median distance of what is looked at; by eye."""
_FITTED_SHARE = 0.98
"""Share kept of the Gaussians that would fit by the mean: what shows most compresses least."""
_MAX_FITTING_ROUNDS = 16
"""Times that a page is packed until it is small enough; each comes nearer."""
_MAX_NOTEBOOK_MEGABYTES = 32.0
"""Size of a page in a notebook, which is saved with it; by eye."""
_MAX_MEDIAN_GAUSSIANS = 100_000
"""Gaussians that a median distance is taken of: enough for a median."""


class Reference(NamedTuple):
    """A photograph that a style was taken from."""

    name: str
    image: Picture
    """[H W 3] of any size, or [H W 4] with straight alpha, its longer side at most REFERENCE_PIXELS."""


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
    lit: bool = False
    """It has a light of its own, in the place of those of the page's day."""


class PageView(NamedTuple):
    """A view of the scene as captured."""

    name: str
    original: Picture
    photograph: Picture | None = None
    """View of a camera."""


@dataclass(frozen=True, kw_only=True)
class Page:
    """Content of a page. Names, `lead` and `credits` are shown as text, whatever they hold."""

    title: str
    lead: str = ""
    facts: Mapping[str, str | int]
    """A few, by their labels ("Photographs": 34); the page adds how many Gaussians it shows."""
    views: Sequence[PageView]
    """At least one."""
    styles: Sequence[Style]
    references: Sequence[Reference] = ()
    scene: SplatScene | None = None
    """The Gaussians as captured; None = the stage shows pictures."""
    start: int = 0
    """Camera of the scene that the stage begins at."""
    suns: int = 0
    """Suns of a day that falls on the Gaussians, where there are any; 0 = none."""
    credits: Sequence[str] = ()
    address: str = ""
    """Address on the web (https://…/garden.html): chats show the picture beside it."""


def preview_of(path: Path) -> Path:
    """The picture beside a page, which chats show of it."""
    return path.with_suffix(".jpg")


def write_page(path: Path, page: Page, *, megabytes: float | None = None) -> int:
    """Write the page to `path` (.html), whole or not at all, and a preview beside it where the page has an
    address; return how many Gaussians it shows.

    With `megabytes` (2^20 bytes), Gaussians that show least are left out until the file is no larger. Raises
    DataError where a page of hardly any Gaussian is larger, UsageError where two looks have one name.
    """
    text, count = page_html(page, megabytes=megabytes, path=path)
    if page.address:
        picture = page.styles[0].stills[0] if page.styles else page.views[0].original
        write_image(preview_of(path), shrink(picture, _CHAT_PICTURE_PIXELS))
    write_text(path, text)
    return count


def shown_of(shown: int, captured: int) -> str:
    """Count of Gaussians on a page, in words."""
    if shown == captured:
        return f"{shown:,}"
    return f"{shown:,} of {captured:,}"


def page_html(
    page: Page, *, megabytes: float | None = None, path: Path = Path("page.html")
) -> tuple[str, int]:
    """The text of a page that lies at `path`, and how many Gaussians it shows. Raises as `write_page`."""
    names = [CAPTURED, *(style.name for style in page.styles)]
    if twice := [name for name in names if names.count(name) > 1]:
        raise UsageError(f"{path}: two looks are called {twice[0]!r}; rename the style's photograph or file")
    room = None if megabytes is None else int(megabytes * 2**20)
    fixed = _text(page, None, {})
    if (scene := page.scene) is None:
        return fixed, 0
    harmonics = [
        scene.shown.harmonics,
        *(style.harmonics for style in page.styles if style.harmonics is not None),
    ]
    # Pack all, and while it is too large keep the share that would fit, of the Gaussians that weigh most in
    # the views.
    empty = len(fixed.encode())
    kept = None
    suns = None
    if page.suns:
        suns = packed_day(scene.light_found, page.suns)
    for _ in range(_MAX_FITTING_ROUNDS):
        _, head, parts = packed_scene(scene, harmonics, page.start, kept, suns=suns)
        text = _text(page, head, parts)
        size = len(text.encode())
        count = int(head["count"])
        if room is None or size <= room:
            return text, count
        if room <= empty:
            break
        share = (room - empty) / max(1, size - empty)
        # A little less than would fit by the mean: what shows most compresses least.
        kept = scene.seen.weights.topk(max(1, int(_FITTED_SHARE * share * count))).indices.sort().values
    sizes = f"{empty / 2**20:.1f} MiB without any Gaussian, {size / 2**20:.1f} MiB with {count}"
    raise DataError(f"{path}: {sizes}; allow more than {megabytes:g} MiB")


def notebook_html(scene: Scene, name: str, view: int, styled: tuple[str, Scene] | None) -> str:
    """A page of a scene, as captured or in a style with its name, in an iframe; its stage is all of it. Gaussians
    that show least are left out of one that is too large for a notebook.
    """
    gaussians = scene if isinstance(scene, SplatScene) else None
    styles = []
    if styled is not None:
        shown = styled[1]
        harmonics = None
        if isinstance(shown, SplatScene):
            harmonics = shown.shown.harmonics
        styles = [Style(styled[0], [to_uint8(shown.render(scene.cameras, view).rgb)], harmonics)]
    views = [PageView(scene.names[view], to_uint8(scene.render(scene.cameras, view).rgb))]
    page = Page(title=name, facts={}, views=views, styles=styles, scene=gaussians, start=view)
    text, _ = page_html(page, megabytes=_MAX_NOTEBOOK_MEGABYTES, path=Path("notebook"))
    # Scripts without this page's origin: they reach nothing of the notebook.
    return f'<iframe srcdoc="{escape(text)}" sandbox="allow-scripts" width="100%" height="620" style="border:0"></iframe>'


def packed_scene(
    scene: SplatScene,
    harmonics: Sequence[Annotated[Tensor, "N K 3"]],
    start: int,
    kept: Annotated[Tensor, "n"] | None = None,
    level: int = 9,
    suns: Suns | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[Packed, dict[str, Any], dict[str, bytes]]:
    """Pack a scene's Gaussians, of those `kept`, in several colours, of which the first is captured, and the
    lights of a day on all of them; return the head and the deflated sections that the page reads, too.

    The page begins at the camera `start`. `level` of deflating: 1 where somebody waits. `progress` hears the
    share that is done.
    """
    gaussians = scene.gaussians.recoloured(harmonics[0])
    if kept is not None:
        gaussians = gaussians.select(kept)
        harmonics = [each[kept] for each in harmonics]
    packed = pack(gaussians, progress=lambda share: progress(_PACKING_SHARE * share))
    parts = sections(packed, level)
    styles = []
    for k, each in enumerate(harmonics):
        colours = packed.colours(each)
        styles.append(colour_header(colours))
        parts[f"style-{k}"] = colour_section(colours, level)
    if suns is not None:
        parts["light"] = suns.section(packed.order if kept is None else kept[packed.order], level)
    drawing = {
        "light": None if suns is None else suns.header,
        "antialiased": scene.antialiased,
        "near": scene.near,
        "background": list(scene.background),
        "fills": 0.0 if scene.poses is None else _PHOTOGRAPHS_FILL,
    }
    depths = min(len(scene.views), _MAX_PAGE_CAMERAS)
    looked = itertools.count()

    def depth(view: int) -> float:
        progress(_PACKING_SHARE + (1 - _PACKING_SHARE) * next(looked) / depths)
        return _depth(scene, view)

    # Views that were found about an object hold just it, so that its tips lie at their rim.
    found_about = scene.poses is None and _look_inwards(scene.views)
    place = about(scene.views, start, depth, _BEYOND_FOUND if found_about else 0.0, up=scene.up)
    return packed, {**header(packed), **drawing, **place, "styles": styles}, parts


def _look_inwards(cameras: Cameras) -> bool:
    """True where cameras stand about what they look at, and not within it."""
    place = cameras.pose[:, :, 3]
    return float(((place.mean(0) - place) * -cameras.pose[:, :, 2]).sum(1).mean()) > 0


def about(
    cameras: Cameras,
    start: int,
    depth: Callable[[int], float],
    beyond: float = 0.0,
    up: tuple[float, float, float] | None = None,
) -> dict[str, Any]:
    """Cameras of a scene, that at `start` first, and where one may go; `depth` is the distance that a camera
    turns about. Cameras count as having seen `beyond` of their frame on each side of it, too. `up` = None takes the
    cameras'.
    """
    # Evenly chosen cameras in their order, rotated so that the one to start from comes first.
    others = _evenly(len(cameras), _MAX_PAGE_CAMERAS)
    chosen = [start, *(view for view in others if view > start), *(view for view in others if view < start)]
    depths = []
    for view in chosen:
        depths.append(depth(view))
    above = upwards(cameras) if up is None else torch.tensor(up)
    above = torch.nn.functional.normalize(above.double(), dim=0)
    # One may go beyond the outermost camera, and half as far again as what is looked at: then nothing is left
    # to see.
    place = cameras.pose[:, :, 3].double()
    centre = place.mean(0)
    radius = (
        _REACH_RATIO * float((place - centre).norm(dim=1).max())
        + _REACH_DEPTHS * sorted(depths)[len(depths) // 2]
    )
    return {
        "up": above.tolist(),
        "reach": {"centre": centre.tolist(), "radius": radius},
        "cameras": [_camera(cameras, view, far) for view, far in zip(chosen, depths, strict=True)],
        "seen": [_frame(cameras, view, beyond) for view in _evenly(len(cameras), _MAX_SEEN_CAMERAS)],
    }


def _evenly(count: int, most: int) -> list[int]:
    """At most so many of `count` indices, in order."""
    return torch.linspace(0, count - 1, min(most, count)).round().long().tolist()


def _frame(cameras: Cameras, view: int, beyond: float) -> list[float]:
    """Rows of a matrix [3 4] from a point of the world to (u z, v z, z), where u and v are in [0, 1] in the
    frame, which is larger by a share `beyond` on each side, and the camera's place.
    """
    camera = covering(cameras, view, 0.0)
    scaled = camera.intrinsics.double()
    scaled[:2] /= torch.tensor([[camera.width], [camera.height]])
    scaled[:2] = (scaled[:2] + beyond * scaled[2]) / (1 + 2 * beyond)
    rows = scaled @ camera.world_to_camera[:3].double()
    return [float(f"{x:.6g}") for x in [*rows.flatten().tolist(), *cameras.pose[view, :, 3].tolist()]]


def _camera(cameras: Cameras, view: int, depth: float) -> dict[str, Any]:
    """A captured camera: world to camera by columns, fx fy cx cy, size, and the distance that it turns
    about.
    """
    camera = camera_of(cameras, view)
    intrinsics = camera.intrinsics
    return {
        "view": [round(x, 7) for x in camera.world_to_camera.T.flatten().tolist()],
        "lens": [round(float(intrinsics[k]), 3) for k in ((0, 0), (1, 1), (0, 2), (1, 2))],
        "size": [camera.width, camera.height],
        "depth": depth,
    }


def _depth(scene: SplatScene, view: int) -> float:
    """Distance along a camera's axis of the middle of what its picture shows: median of the Gaussians in
    it.
    """
    camera = camera_of(scene.views, view)
    # 100 000 are enough for a median, evenly taken. Of the Gaussians whose centres lie in the middle two
    # thirds of the picture.
    means = scene.gaussians.means
    at = (
        means[:: max(1, len(means) // _MAX_MEDIAN_GAUSSIANS)].double() @ camera.world_to_camera[:3, :3].T
        + camera.world_to_camera[:3, 3]
    )
    depth = at[:, 2].clamp_min(1e-9)
    middle = camera.intrinsics[:2, 2] + at[:, :2] / depth[:, None] * camera.intrinsics.diagonal()[:2]
    size = torch.tensor([camera.width, camera.height]).double()
    inside = (at[:, 2] > scene.near) & ((middle - size / 2).abs() < size / 3).all(1)
    if bool(inside.any()):
        return float(depth[inside].median())
    return 1.0


def _text(page: Page, head: Mapping[str, Any] | None, parts: Mapping[str, bytes]) -> str:
    """The page; `head` None = without Gaussians."""
    names = [CAPTURED, *(style.name for style in page.styles)]
    # With Gaussians one picture a style is enough: it stands in until the first frame, and where there is no
    # WebGL 2.
    most = 1 if page.scene is not None else len(page.views)
    pictures = [[view.original for view in page.views], *(style.stills for style in page.styles)]
    stills = []
    for row in pictures:
        stills.append([data_uri(shrink(each, _STAGE_PIXELS)) for each in row[:most]])
    made_of = [[], *(list(style.references) for style in page.styles)]
    lit = [False, *(style.lit for style in page.styles)]
    heads = [{}] * len(names) if head is None else head["styles"]
    data = {
        "scene": None if head is None else {key: value for key, value in head.items() if key != "styles"},
        "styles": [
            {"name": name, "of": of, "lit": own, **about_colours}
            for name, of, own, about_colours in zip(names, made_of, lit, heads, strict=True)
        ],
        "references": {each.name: data_uri(_thumbnail(each.image)) for each in page.references},
        "stills": dict(zip(names, stills, strict=True)),
    }
    known = {}
    for reference in page.references:
        known[reference.name] = reference
    blocks = "\n".join(_style(style, page.views, known) for style in page.styles)
    # Sections below the stage; those without content are left out, of the navigation too.
    below = [
        ("Views", _views(page.views) if any(view.photograph is not None for view in page.views) else ""),
        ("Styles", blocks),
    ]
    facts = {name: fact if isinstance(fact, str) else f"{fact:,}" for name, fact in page.facts.items()}
    if page.scene is not None and head is not None:
        facts["3D Gaussians"] = shown_of(int(head["count"]), len(page.scene.gaussians))
    rows = "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(fact)}</dd></div>" for name, fact in facts.items()
    )
    present = []
    for name, part in below:
        if part:
            present.append((name, part))
    body = []
    for name, part in present:
        body.append(f'<section id="{name.lower()}"><h2>{name}</h2>\n{part}\n</section>')
    scripts = []
    for name, packed in parts.items():
        text = base64.b64encode(packed).decode()
        scripts.append(f'<script type="text/plain" id="data-{name}">{text}</script>')
    code = f"{script(*PAGE_SCRIPTS)}\nopenPage(JSON.parse(at('data').textContent));\n"
    return Template(read_asset("page.html")).substitute(
        title=escape(page.title),
        description=escape(page.lead or "A place in 3D, in the light and colours of photographs."),
        preview=_preview(page.address),
        lead=f'<p class="lead">{escape(page.lead)}</p>' if page.lead else "",
        css=css(),
        hash=f"'sha256-{base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()}'",
        nav="\n".join(f'<a href="#{name.lower()}">{name}</a>' for name, _ in present),
        stage=Template(read_asset("stage.html")).substitute(
            still=f'src="{stills[0][0]}"',
            panel="",
        ),
        facts=f'<dl class="facts">{rows}</dl>' if rows else "",
        body="\n".join(body),
        credits="\n".join(f"<p>{escape(line)}</p>" for line in page.credits),
        # "<" cannot end the script then, whatever a name holds.
        data=json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"),
        sections="\n".join(scripts),
        script=code,
    )


def _preview(address: str) -> str:
    """Tags of a page's address and its picture; chats load nothing that lies in the page itself."""
    if not address:
        return ""
    base = escape(address.rpartition(".")[0])
    return (
        f'<meta property="og:url" content="{escape(address)}">\n'
        f'<meta property="og:image" content="{base}.jpg">\n'
        '<meta name="twitter:card" content="summary_large_image">'
    )


def _thumbnail(picture: Picture) -> Picture:
    """A reference as small as it is beside a style."""
    if picture.shape[2] == 4:  # over white
        alpha = picture[..., 3:].astype(np.float32) / 255
        picture = (picture[..., :3] * alpha + 255 * (1 - alpha)).round().astype(np.uint8)
    return shrink(picture, _BESIDE_STYLE_PIXELS)


def _img(picture: Picture, side: int, alt: str) -> str:
    if picture.shape[2] == 4:
        small = picture
    else:
        small = shrink(picture, side)
    height, width = small.shape[:2]
    size = f'width="{width}" height="{height}"'
    return f'<img src="{data_uri(small)}" alt="{escape(alt)}" {size} decoding="async" loading="lazy">'


def _views(views: Sequence[PageView]) -> str:
    """Photographs beside what the scene shows from their places."""
    rows = ""
    for view in views:
        if view.photograph is not None:
            photograph = _img(view.photograph, _VIEW_PIXELS, f"Photograph {view.name}")
            shown = _img(view.original, _VIEW_PIXELS, f"View {view.name}")
            caption = f"<figcaption>{escape(view.name)}</figcaption>"
            rows += f'<figure><div class="pair">{photograph}{shown}</div>{caption}</figure>'
    lead = "Photographs that training did not see, and beside them the scene."
    return f'<p class="lead">{lead}</p><div class="grid">{rows}</div>'


def _style(style: Style, views: Sequence[PageView], known: Mapping[str, Reference]) -> str:
    """References of a style, with the colours of its match maps and with shares where there are any; the
    maps.
    """
    rows = []
    if style.references:
        colours = to_uint8(palette(len(style.references))[None])[0]
    else:
        colours = []
    for place, name in enumerate(style.references):
        if style.matches:
            chip = f'<i class="chip" style="background:rgb({",".join(map(str, colours[place]))})"></i>'
        else:
            chip = ""
        if style.shares:
            share = f'<data value="{style.shares[place]:.4f}">{style.shares[place]:.0%}</data>'
        else:
            share = ""
        image = _img(known[name].image, REFERENCE_PIXELS, f"Reference {name}")
        rows.append(
            f"<figure>{image}<figcaption>{chip}<span>{escape(name)}</span>{share}</figcaption></figure>"
        )
    maps = ""
    for view, each in zip(views, style.matches, strict=False):
        image = _img(each, _MATCH_MAP_PIXELS, view.name)
        maps += f"<figure>{image}<figcaption>{escape(view.name)}</figcaption></figure>"
    return f"""<article class="style"><h3>{escape(style.name)}</h3>
<div class="sources">{"".join(rows)}</div>
{f'<p class="lead">Which reference each place took its style from</p><div class="grid small">{maps}</div>' if maps else ""}
</article>"""
