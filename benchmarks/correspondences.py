"""Restyling of real pictures by true answers at points: one place in two pictures, with pairs of points that were
set by hand (WxBS 1.1, Mishkin et al. 2015: day and night, seasons, years, from different standpoints).

    python -m benchmarks correspondences [--folder FOLDER] [--seeds 0 1 2] [--output JSON]

FOLDER holds folders of pairs: 01 and 02, pictures, and corrs.txt, a row of x1 y1 x2 y2 a pair of points. Each picture is
the scene once and the other one the reference, whole. At a point the restyled scene is compared with what the
reference shows there; both are means of a small box, since points are set to a few pixels. The scene is made as
in `light.py`. The means of all pictures and of those that were recognised as the very place are reported.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from fprf.checks import at_least
from fprf.cli.parsing import parse
from fprf.datamanagers.basis import fit_basis
from fprf.datamanagers.images import load_image
from fprf.errors import DataError
from fprf.interfaces import Encoder
from fprf.io.images import shrink, to_uint8, write_image
from fprf.ops.config import GuidedConfig
from fprf.plugins.encoders.config import SEMANTICS
from fprf.splats.restyle import ColourEncoder
from fprf.style.dictionary import Encoders, build_dictionary, encode_photograph
from fprf.style.placing import blurred

from .common import SHARED, console, report
from .halves import METHODS, NO_CHANGE, Image
from .report import Column, printed
from .single_image import encoded, flat_landmarks, flat_look, flat_scene, reinhard, render_flat
from .style_metrics import delta_e
from .town.truth import Row, mean_rows

_COMPONENTS = 31
"""Principal components of the semantics, as of a capture."""
_REGIONS = 24
"""Regions of the scene."""
_COLUMNS: tuple[Column, ...] = (("psnr", "PSNR ↑", ".2f"), ("delta_e", "ΔE2000 ↓", ".1f"))


@dataclass(frozen=True, kw_only=True)
class CorrespondencesConfig:
    """One place in two pictures: each restyles the other, points that were set by hand judge it."""

    folder: Path = SHARED / "data/wxbs"
    """Folders of pairs, at any depth."""
    width: int = 320
    """Longer side of the pictures in pixels."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of the clusters, regions and codes."""
    output: Path | None = None
    """JSON file for the figures; none = only the tables."""

    def __post_init__(self) -> None:
        at_least("width", self.width, 64)
        at_least("seeds", len(self.seeds), 1)


class Side(NamedTuple):
    """One picture of a pair."""

    image: Image
    points: Annotated[Tensor, "P 2"]
    """Pixels of the reduced picture."""


def read_pair(folder: Path, longest: int) -> tuple[Side, Side]:
    """Both pictures of a pair, reduced. Raises DataError where a file is missing or no table of points."""
    corners = np.loadtxt(folder / "corrs.txt", ndmin=2)
    if corners.ndim != 2 or corners.shape[1] != 4:
        raise DataError(f"{folder / 'corrs.txt'}: a table of {corners.shape}; rows of x1 y1 x2 y2 are read")
    sides = []
    for k, stem in enumerate(("01", "02")):
        found = sorted(folder.glob(f"{stem}.*"))
        if not found:
            raise DataError(f"{folder}: no picture {stem}; each pair has 01 and 02")
        whole = load_image(found[0])
        image = torch.from_numpy(shrink(whole, longest)).float() / 255
        scale = image.shape[1] / whole.shape[1]
        sides.append(Side(image, torch.from_numpy(corners[:, 2 * k : 2 * k + 2] * scale)))
    return sides[0], sides[1]


def at_points(side: Side, picture: Image) -> Annotated[Tensor, "P 3"]:
    """Colours of a picture of this side's size at its points."""
    height, width = picture.shape[:2]
    x, y = side.points.long().unbind(1)
    return blurred(picture)[y.clamp(0, height - 1), x.clamp(0, width - 1)]


def scores(side: Side, picture: Image, truth: Annotated[Tensor, "P 3"]) -> Row:
    """PSNR and mean ΔE2000 at points."""
    shown = at_points(side, picture)
    error = float((shown - truth).square().mean())
    apart = delta_e(shown[None], truth[None])
    return {"psnr": -10 * float(np.log10(max(error, 1e-10))), "delta_e": float(apart.mean())}


@torch.inference_mode()
def judge(
    scene: Side, light: Side, semantic: Encoder, folder: Path, seed: int
) -> tuple[dict[str, Row], bool]:
    """Scores by method of one picture in the light of the other, and whether it is recognised."""
    size = (scene.image.shape[0], scene.image.shape[1])
    maps = semantic(scene.image.permute(2, 0, 1)[None])[0].float()
    basis = fit_basis(maps.flatten(1).T, _COMPONENTS)
    guided = GuidedConfig()
    features = encoded(scene.image, semantic, guided, basis)
    flat = flat_scene(scene.image.flatten(0, 1), features, size, regions=_REGIONS, seed=seed)
    encoders = Encoders(
        ColourEncoder(),
        semantic,
        basis,
        flat.style,
        longest=max(size),
        guided=guided,
        seed=seed,
        landmarks=flat_landmarks(scene.image, features),
    )
    path = folder / "light.png"
    write_image(path, to_uint8(light.image))
    reference = encode_photograph(path, encoders, name="light.png")
    dictionary = build_dictionary([reference], seed=seed)._replace(origin=basis.origin())
    truth = at_points(light, light.image)
    rows = {NO_CHANGE: scores(scene, scene.image, truth)}
    whole = reinhard(scene.image.reshape(-1, 3), light.image.reshape(-1, 3)).reshape(scene.image.shape)
    rows["reinhard"] = scores(scene, whole, truth)
    for name, (stylizer, bold) in METHODS.items():
        look = flat_look(flat, dictionary, stylizer, None, bold)
        rows[name] = scores(scene, render_flat(flat, look, None), truth)
    matched = flat_look(flat, dictionary._replace(placed=()), METHODS["default"][0], None)
    rows["default, matched alone"] = scores(scene, render_flat(flat, matched, None), truth)
    return rows, reference.placed is not None


def main(argv: list[str]) -> int:
    """`python -m benchmarks correspondences`."""
    torch.set_num_threads(1)
    config = parse(
        CorrespondencesConfig(), argv, prog="python -m benchmarks correspondences", description=__doc__ or ""
    )
    folders = sorted(path.parent for path in config.folder.rglob("corrs.txt"))
    if not folders:
        print(f"correspondences: skipped, no pairs in {config.folder}; name a folder with WxBS 1.1")
        return 0
    semantic = SEMANTICS.build()
    pairs: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix="fprf-correspondences-") as made:
        for folder in folders:
            sides = read_pair(folder, config.width)
            for seed in config.seeds:
                for k in (0, 1):
                    rows, recognised = judge(sides[k], sides[1 - k], semantic, Path(made), seed)
                    name = f"{folder.parent.name}/{folder.name}"
                    pairs.append(
                        {"pair": name, "scene": k + 1, "seed": seed, "recognised": recognised, "rows": rows}
                    )
    means = {"all": mean_rows([each["rows"] for each in pairs])}
    known = [each["rows"] for each in pairs if each["recognised"]]
    if known:
        means["recognised"] = mean_rows(known)
    for title, table in means.items():
        console().print(printed(title, table, _COLUMNS))
    for each in pairs:
        each["psnr"] = {name: round(row["psnr"] or 0.0, 2) for name, row in each.pop("rows").items()}
    settings = {"pairs": len(folders), "width": config.width, "seeds": list(config.seeds)}
    counts = {"pictures": len(pairs), "recognised": len(known)}
    report(
        config.output,
        {
            "benchmark": "correspondences",
            "settings": settings,
            "counts": counts,
            "means": means,
            "pairs": pairs,
        },
    )
    return 0
