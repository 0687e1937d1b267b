"""The half-image protocol: the left half of a photograph in another light is the reference, its right half the
truth (Martin-Brualla et al. 2021, NeRF in the Wild, section 5).

A pair is one place from one standpoint in two lights: A is the scene, B the other light. Methods see all of A
and the left half of B; the right halves of what they make of A and of B are compared. Oracles see both.

Letters: N pixels, K regions. Colours are sRGB in [0, 1].
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor

from fprf.evaluation.metrics import image_metrics
from fprf.io.images import Picture, to_uint8, write_image
from fprf.plugins.stylizers.config import (
    AdainConfig,
    LocalAdainConfig,
    RegionOtConfig,
    RegionToneConfig,
    StylizerConfig,
)
from fprf.style.config import StyleConfig
from fprf.style.dictionary import Encoders, StyleDictionary, build_dictionary, encode_photograph

from .common import console, report
from .report import Column, contact_sheet, printed
from .single_image import reinhard
from .style_metrics import delta_e
from .town.truth import Row, mean_rows

Image = Annotated[Tensor, "H W 3"]

_RIDGE_VARIANCE = 1e-4
"""Variance added to colours before an affine map is fitted: half of five 8-bit steps, squared."""


class Halves(NamedTuple):
    """Left and right half of a picture; the middle column of an odd width is in neither."""

    left: Image
    right: Image


def halves(image: Annotated[Tensor, "H W ..."]) -> Halves:
    """Cut a picture, or a map of the same shape."""
    middle = image.shape[1] // 2
    return Halves(image[:, :middle], image[:, image.shape[1] - middle :])


def scores(picture: Image, truth: Image, where: Annotated[Tensor, "H W"] | None = None) -> Row:
    """PSNR, SSIM, LPIPS and mean ΔE2000 of a picture, in the pixels that are `where`."""
    found = image_metrics(picture, truth, where)
    apart = delta_e(picture, truth)
    if where is not None:
        apart = apart[where]
    return {**{name: found[name] for name in ("psnr", "ssim", "lpips")}, "delta_e": float(apart.mean())}


def best_affine(
    before: Annotated[Tensor, "N 3"], after: Annotated[Tensor, "N 3"], share: Annotated[Tensor, "N K"]
) -> Annotated[Tensor, "N 3"]:
    """Oracle: the affine map of colours that brings each region nearest to the truth, mixed by membership."""
    out = torch.zeros_like(before, dtype=torch.float64)
    x = before.double()
    y = after.double()
    for weight in share.double().T:
        total = weight.sum()
        if float(total) <= 0:
            continue
        mean_x = weight @ x / total
        mean_y = weight @ y / total
        away = (x - mean_x) * weight[:, None]
        own = away.T @ (x - mean_x) / total + _RIDGE_VARIANCE * torch.eye(3).to(x)
        matrix = torch.linalg.solve(own, away.T @ (y - mean_y) / total)
        out += weight[:, None] * ((x - mean_x) @ matrix + mean_y)
    return out.to(before).clamp(0, 1)


NO_CHANGE = "no change"
AFFINE = "best affine map"
REGION_AFFINE = "best affine map of a region"
"""Oracles: they see the truth."""
METHODS: Mapping[str, tuple[StylizerConfig, float]] = {
    "adain": (AdainConfig(), StyleConfig.bold),
    "local-adain": (LocalAdainConfig(), StyleConfig.bold),
    "region-ot": (RegionOtConfig(), StyleConfig.bold),
    "default": (RegionToneConfig(), StyleConfig.bold),
    "bold 0": (RegionToneConfig(), 0.0),
    "bold 1": (RegionToneConfig(), 1.0),
}
"""Stylizers by name, and how bold they are."""
COLUMNS: Sequence[Column] = (
    ("psnr", "PSNR ↑", ".2f"),
    ("ssim", "SSIM ↑", ".3f"),
    ("lpips", "LPIPS ↓", ".3f"),
    ("delta_e", "ΔE2000 ↓", ".1f"),
)


class Judged(NamedTuple):
    """One pair."""

    place: str
    scene: str
    """Name of A."""
    light: str
    """Name of B."""
    seed: int
    rows: dict[str, Row]
    """By method."""
    pictures: dict[str, Image]
    """B, and what methods make of A; of oracles the right half alone."""


def judge_pair(
    plain: Image, light: Image, styled: Mapping[str, Image], regions: Annotated[Tensor, "H W K"]
) -> tuple[dict[str, Row], dict[str, Image]]:
    """Scores by method and the pictures: those given, transfers of colour, and the oracles.

    `regions` is the pixels' membership in the regions of the scene.
    """
    before = halves(plain).right
    truth = halves(light).right
    known = halves(light).left.reshape(-1, 3)
    pictures = {NO_CHANGE: plain}
    pictures["reinhard"] = reinhard(plain.reshape(-1, 3), known).reshape(plain.shape)
    pictures |= styled
    rows = {name: scores(halves(picture).right, truth) for name, picture in pictures.items()}
    share = halves(regions).right.reshape(-1, regions.shape[-1])
    for name, belongs in ((AFFINE, torch.ones(len(share), 1)), (REGION_AFFINE, share)):
        best = best_affine(before.reshape(-1, 3), truth.reshape(-1, 3), belongs).reshape(truth.shape)
        rows[name] = scores(best, truth)
        pictures[name] = best
    return rows, {"light": light, **pictures}


def half_reference(light: Image, encoders: Encoders, folder: Path, *, seed: int) -> StyleDictionary:
    """The dictionary of the left half of a photograph, as the commands make it of a file (in `folder`)."""
    path = folder / "half.png"
    write_image(path, to_uint8(halves(light).left))
    dictionary = build_dictionary([encode_photograph(path, encoders, name="half.png")], seed=seed)
    if encoders.basis is None:
        return dictionary
    return dictionary._replace(origin=encoders.basis.origin().to(dictionary.keys))


def half_document(name: str, judged: Sequence[Judged], settings: Mapping[str, object]) -> dict[str, Any]:
    """Means over all pairs and by place, with the spread over the seeds, and PSNR of each pair."""
    places = list(dict.fromkeys(each.place for each in judged))
    by_seed: dict[int, list[dict[str, Row]]] = {}
    for each in judged:
        by_seed.setdefault(each.seed, []).append(each.rows)
    means = mean_rows([each.rows for each in judged])
    for method, row in means.items():
        of_seeds = [mean_rows(rows)[method]["psnr"] for rows in by_seed.values()]
        known = [value for value in of_seeds if value is not None]
        row["psnr_of_seeds"] = max(known) - min(known)
    return {
        "benchmark": name,
        "settings": dict(settings),
        "means": means,
        "places": {
            place: mean_rows([each.rows for each in judged if each.place == place]) for place in places
        },
        "pairs": [
            {
                "place": each.place,
                "scene": each.scene,
                "light": each.light,
                "seed": each.seed,
                "psnr": {method: round(row["psnr"] or 0.0, 3) for method, row in each.rows.items()},
            }
            for each in judged
        ],
    }


def half_sheet(judged: Sequence[Judged]) -> Picture:
    """A row for each pair of the first seed: B, and A by every method."""
    first = [each for each in judged if each.seed == judged[0].seed]
    rows = {f"{each.place[:4]} {k}": list(each.pictures.values()) for k, each in enumerate(first)}
    return contact_sheet(rows, list(first[0].pictures), height=120)


def report_halves(
    name: str,
    judged: Sequence[Judged],
    settings: Mapping[str, object],
    output: Path | None,
    sheet: Path | None,
) -> None:
    """Print tables of all and of each place; write JSON and sheet where they are asked for."""
    document = half_document(name, judged, settings)
    tables = {f"mean over {len(judged)} pairs": document["means"], **document["places"]}
    for title, rows in tables.items():
        console().print(printed(title, rows, COLUMNS))
    report(output, document)
    if sheet is not None:
        write_image(sheet, half_sheet(judged))
