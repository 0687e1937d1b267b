"""Frames of any system, read from files and scored by the code that scores ours."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from torch import Tensor

from fprf.cli.parsing import parse
from fprf.datamanagers.images import IMAGE_SUFFIXES, load_image
from fprf.datamanagers.parsers.files import Record, as_record, read_bytes, read_json, read_npy, read_npz
from fprf.datamanagers.parsers.views import rigid_pose
from fprf.errors import DataError
from fprf.plugins.encoders.config import BundledContentConfig, BundledSemanticConfig
from fprf.progress import Display
from fprf.rendering.cameras import Cameras, grid_rays
from fprf.training.field_scene import load_run
from fprf.training.views import render_view

from .common import ReportConfig, write_report
from .report import provenance, words
from .steadiness import published, steadiness
from .style_metrics import matched_regions, mean_scores, structure, style_distances

Frames = Mapping[str, Annotated[Tensor, "H W 3"]]
"""Pictures by the stems of their files, in the order of these."""


@dataclass(frozen=True, kw_only=True)
class PeerConfig(ReportConfig):
    """Stylised frames of any system, scored by the same code; see docs/evidence/protocol.md."""

    frames: Path = Path()
    """Folder of the stylised frames, in the order of their names: a path for consistency."""
    cameras: Path = Path("transforms.json")
    """Their cameras: a transforms.json whose file_path have the frames' stems. Pinholes."""
    plain: Path | None = None
    """Folder of the same frames before they were stylised, by the same names: what consistency is relative
    to.
    """
    depth: Path | None = None
    """Folder of NAME.npz (array `depth`) or NAME.npy: [H W], in the unit of the poses; 0 or infinite =
    nothing there.
    """
    depth_along: Literal["ray", "axis"] = "ray"
    """Kind of depth: distances along each pixel's ray, or along the camera's axis."""
    run: Path | None = None
    """A run of ours on the same scene: renders the plain frames and depths that are not given."""
    truth: Path | None = None
    """Folder of the true frames, where they are known, by the same names."""
    references: tuple[Path, ...] = ()
    """Photographs that gave the style."""
    device: str = "auto"
    """cpu, cuda, mps, or auto: where a run is rendered."""


def read_pictures(folder: Path, names: Sequence[str] | None = None) -> Frames:
    """All pictures of a folder, or those with these stems, in [0, 1]. Raises DataError for none, or a missing
    one.
    """
    files = {path.stem: path for path in sorted(folder.glob("*")) if path.suffix.lower() in IMAGE_SUFFIXES}
    if not files:
        raise DataError(
            f"{folder}: no pictures ({' '.join(sorted(IMAGE_SUFFIXES))}); name the folder that the frames lie in"
        )
    wanted = list(files) if names is None else list(names)
    missing = [name for name in wanted if name not in files]
    if missing:
        raise DataError(
            f"{folder}: no picture named {missing[0]} ({len(missing)} are missing); name them as the frames"
        )
    return {name: torch.from_numpy(load_image(files[name])).float() / 255 for name in wanted}


def read_cameras(path: Path, frames: Frames) -> Cameras:
    """The camera of each frame out of a transforms.json, at the size of the frame.

    A frame belongs to the entry whose `file_path` has its stem; where no stem agrees and the numbers do, to
    the one at its place by name. Pinholes alone. Raises DataError for what does not fit.
    """
    entries = {
        Path(record.text("file_path") or "").stem: record
        for record in as_record(path, read_json(path)).records("frames")
    }
    chosen = [entries[name] for name in frames if name in entries]
    if not chosen and len(entries) == len(frames):
        chosen = [entries[name] for name in sorted(entries)]
    if len(chosen) != len(frames):
        raise DataError(
            f"{path}: cameras for {len(chosen)} of {len(frames)} frames; name the frames as the entries' file_path"
        )
    sizes = [(image.shape[1], image.shape[0]) for image in frames.values()]
    views = [_camera(record, *size) for record, size in zip(chosen, sizes, strict=True)]
    return Cameras(
        pose=torch.stack(
            [torch.from_numpy(rigid_pose(r.where, r.matrix("transform_matrix"))) for r in chosen]
        ),
        focal=torch.tensor([focal for focal, _ in views], dtype=torch.float64),
        centre=torch.tensor([centre for _, centre in views], dtype=torch.float64),
        size=torch.tensor(sizes),
        distortion=torch.zeros(len(views), 6, dtype=torch.float64),
        lens=torch.zeros(len(views), dtype=torch.int64),
    )


def read_depths(
    folder: Path, names: Iterable[str], cameras: Cameras, along: Literal["ray", "axis"]
) -> list[Annotated[Tensor, "H W"]]:
    """Distances along the unit ray of NAME.npz (array `depth`) or NAME.npy, [H W] in the unit of the poses.

    `along` says what the files hold: distances along the ray, or along the camera's axis. Raises DataError.
    """
    depths = []
    for view, name in enumerate(names):
        packed = folder / f"{name}.npz"
        plain = folder / f"{name}.npy"
        if packed.is_file():
            array = read_npz(packed, "depth")
        elif plain.is_file():
            array = read_npy(str(plain), read_bytes(plain))
        else:
            raise DataError(
                f"{folder}: neither {packed.name} nor {plain.name}; write a depth for every frame"
            )
        depth = torch.from_numpy(array.astype("float64"))
        width, height = cameras.size[view].tolist()
        if depth.shape != (height, width):
            raise DataError(
                f"{folder}/{name}: depth of shape {tuple(depth.shape)}, the frame has {height} rows of {width}"
            )
        if along == "axis":
            _, direction = grid_rays(cameras, view)
            depth = depth / (-direction @ cameras.pose[view, :, 2]).view(height, width)
        depths.append(depth)
    return depths


def _camera(record: Record, width: int, height: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Focal lengths and centre in pixels of a frame that may be smaller or larger than the calibrated
    picture.
    """
    bent = [key for key in ("k1", "k2", "k3", "k4", "p1", "p2") if record.number(key)]
    if bent:
        raise DataError(f"{record.where}: {bent[0]} is not 0; only pinholes are judged, undistort the frames")
    own_width = record.number("w") or width
    own_height = record.number("h") or height
    across = width / own_width
    down = height / own_height
    angle = record.number("camera_angle_x")
    fx = record.number("fl_x")
    if fx is None:
        if angle is None or not 0 < angle < math.pi:
            raise DataError(
                f"{record.where}: no fl_x, and no camera_angle_x between 0 and pi; give the focal length as fl_x"
            )
        fx = own_width / 2 / math.tan(angle / 2)
    fy = record.number("fl_y")
    cx = record.number("cx")
    cy = record.number("cy")
    centre = (own_width / 2 if cx is None else cx, own_height / 2 if cy is None else cy)
    return (fx * across, (fx if fy is None else fy) * down), (centre[0] * across, centre[1] * down)


REGIONS = 6
"""Regions in which frames and references are compared."""
_LARGEST = 512
"""References are reduced to this longest side."""
Progress = Callable[[int, int, str], None]


def peer(config: PeerConfig, progress: Progress) -> dict[str, Any]:
    """The document. What cannot be said for lack of input is None, and `missing` names the flag that would
    tell.

    Raises DataError for frames, cameras and depths that do not fit each other.
    """
    frames = read_pictures(config.frames)
    images = list(frames.values())
    cameras = read_cameras(config.cameras, frames)
    plain, depths = _plain_and_depths(config, frames, cameras, progress)
    missing: dict[str, str] = {}
    document: dict[str, Any] = {
        "benchmark": "peer",
        "frames": len(images),
        "size": [int(side) for side in cameras.size[0]],
        "steadiness": None,
        "published": None,
        "truth": None,
        "style": None,
    }
    if depths is None:
        missing |= dict.fromkeys(("steadiness", "published"), "--depth or --run")
    else:
        document["published"] = published(images, depths, cameras)
        if plain is None:
            missing["steadiness"] = "--plain or --run"
        else:
            document["steadiness"] = steadiness(plain, images, depths, cameras)._asdict()
    if config.truth is None:
        missing["truth"] = "--truth"
    else:
        document["truth"] = mean_scores(images, list(read_pictures(config.truth, list(frames)).values()))[0]
    if plain is None or not config.references:
        missing["style"] = "--references, and --plain or --run"
    else:
        document["style"] = _style(config, images, plain)
    return {**document, "missing": missing}


def _plain_and_depths(
    config: PeerConfig, frames: Frames, cameras: Cameras, progress: Progress
) -> tuple[list[Tensor] | None, list[Tensor] | None]:
    """Unstylised frames and depths: from their folders or else from the run, as far as there are any."""
    plain = None if config.plain is None else list(read_pictures(config.plain, list(frames)).values())
    depths = None if config.depth is None else read_depths(config.depth, frames, cameras, config.depth_along)
    if config.run is not None and (plain is None or depths is None):
        trained = load_run(config.run, config.device)
        rendered = []
        for view in range(len(cameras)):
            progress(view, len(cameras), "rendering unstylised frames")
            rendered.append(
                render_view(trained.model, trained.known.facts, cameras, view, trained.config.render)
            )
        plain = [each.rgb for each in rendered] if plain is None else plain
        depths = [each.depth for each in rendered] if depths is None else depths
    for (name, own), image in zip(frames.items(), plain or frames.values(), strict=True):
        if image.shape != own.shape:
            raise DataError(
                f"--plain: {name} is {_size(image)}, the stylised frame {_size(own)}; both must agree"
            )
    return plain, depths


def _style(config: PeerConfig, styled: Sequence[Tensor], plain: Sequence[Tensor]) -> dict[str, float | None]:
    """Distance to the references (1 = no change) and what is left of the frames' structure (1 = all of
    it).
    """
    references = [
        _reduced(torch.from_numpy(load_image(path, upright=True)).float() / 255) for path in config.references
    ]
    here, there = matched_regions(BundledSemanticConfig().build(), plain, references, regions=REGIONS, seed=0)
    judge = {"bundled-content": BundledContentConfig().build()}
    before = list(zip(plain, here, strict=True))
    target = list(zip(references, there, strict=True))
    distances = style_distances(judge, before, {"frames": list(zip(styled, here, strict=True))}, target)
    kept = [structure(a, b) for a, b in zip(plain, styled, strict=True)]
    return {"style_distance": distances["frames"]["mean"], "structure": sum(kept) / len(kept)}


def _reduced(image: Tensor) -> Tensor:
    scale = _LARGEST / max(image.shape[:2])
    if scale >= 1:
        return image
    size = [max(1, round(side * scale)) for side in image.shape[:2]]
    return torch.nn.functional.interpolate(image.permute(2, 0, 1)[None], size, mode="area")[0].permute(
        1, 2, 0
    )


def _size(image: Tensor) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


_ROWS = (
    ("steadiness", "score", "consistency (0 = as steady and sharp as unstylised)", ".3f"),
    ("steadiness", "short", "error of neighbouring frames / contrast", ".3f"),
    ("steadiness", "plain_short", "the same, unstylised", ".3f"),
    ("steadiness", "long", "error 7 frames apart / contrast", ".3f"),
    ("steadiness", "plain_long", "the same, unstylised", ".3f"),
    ("steadiness", "sharpness", "sharpness (1 = as unstylised)", ".3f"),
    ("truth", "psnr", "PSNR to the truth, dB", ".2f"),
    ("truth", "ssim", "SSIM to the truth", ".3f"),
    ("truth", "delta_e", "ΔE2000 to the truth", ".1f"),
    ("style", "style_distance", "distance to the references (1 = no change)", ".3f"),
    ("style", "structure", "structure kept", ".3f"),
)
_PUBLISHED = (("short", "t, t-1"), ("long", "t, t-7"))


def peer_page(document: Mapping[str, Any]) -> str:
    """Markdown: what is known, and which flag would tell what is not."""
    width, height = document["size"]
    lines = [
        f"{document['frames']} frames of {width}x{height}. {words(document['provenance'])}.",
        "",
        "| | |",
        "|---|---:|",
    ]
    for part, key, label, form in _ROWS:
        value = None if document[part] is None else document[part][key]
        lines.append(f"| {label} | {'–' if value is None else format(value, form)} |")
    for key, label in _PUBLISHED:
        published = document["published"] and document["published"][key]
        for figure, name, form in (
            ("lpips", "LPIPS", ".4f"),
            ("rmse", "RMSE", ".4f"),
            ("e_warp", "E_warp", ".2e"),
        ):
            value = None if not published else published[figure]
            lines.append(
                f"| as others report it: {name} ({label}) | {'–' if value is None else format(value, form)} |"
            )
    if document["missing"]:
        lines += ["", *(f"- {part}: not known without {flag}" for part, flag in document["missing"].items())]
    return "\n".join(lines) + "\n"


def main(argv: list[str]) -> int:
    """`python -m benchmarks peer FRAMES --cameras FILE`."""
    about = (PeerConfig.__doc__ or "").strip()
    config = parse(
        PeerConfig(), argv, prog="python -m benchmarks peer", description=about, positional=("frames",)
    )
    with Display() as display:
        document = peer(config, display.count)
    document["provenance"] = provenance(config.device)
    page = peer_page(document)
    print(page)
    write_report(config, document, lambda: page)
    return 0
