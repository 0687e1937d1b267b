"""How often styles cut through things: trained runs in photographs' styles, regions by themselves, by default, and gently.

    python benchmarks/false_edges.py RUN ... --styles DIR [--references NAME ...] [--output JSON] [--sheets DIR]

false_edges: share of the pairs of pixels on one even surface that the style moves apart (`fprf/evaluation/false_edges.py`).
structure: what the style keeps of the luminance's structure. palette: distance of the pictures' colours (means and deviations
of the channels) to the reference's, over the same of the plain render. change: mean difference to the plain render.
Runs must be of a version that measures contacts between regions. Sheets show other people's photographs.
"""

import argparse
import statistics
from dataclasses import replace
from pathlib import Path

import torch
from sheets import sheet
from torch import Tensor

from fprf.datamanagers.images import load_image
from fprf.evaluation.false_edges import false_edges
from fprf.evaluation.structure import structure
from fprf.io.atomic import write_json
from fprf.io.images import shrink, write_image
from fprf.plugins.stylizers.config import RegionToneConfig
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.presets import PRESETS, with_preset
from fprf.training.cached_view import cache_view
from fprf.training.loading import load_run
from fprf.training.restyle import apply_style

HERE = Path(__file__).resolve().parents[1]
BASE = StyleConfig()
STYLES = {
    "regions by themselves": replace(BASE, stylizer=RegionToneConfig(smoothness=0.0)),
    "default": BASE,
    **{name: with_preset(BASE, name) for name in PRESETS},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--styles", type=Path, required=True, help="folder of photographs")
    parser.add_argument("--references", nargs="+", default=["night_town", "red_dusk_tree", "snow_avenue", "cherry_blossom"])
    parser.add_argument("--views", type=int, default=2, help="views of each run, evenly through the capture")
    parser.add_argument("--longest", type=int, default=170, help="longer side in pixels")
    parser.add_argument("--output", type=Path, default=HERE / "benchmarks/results/false_edges.json")
    parser.add_argument("--sheets", type=Path)
    asked = parser.parse_args()
    scenes = []
    for root in asked.runs:
        trained = load_run(root, "cpu")
        known, encoders = trained.known, trained.encoders()
        cameras = known.cameras.scaled(max(1.0, float(known.cameras.size.amax()) / asked.longest))
        chosen = [(2 * i + 1) * len(cameras) // (2 * asked.views) for i in range(asked.views)]
        views = [cache_view(trained.model, known.facts, cameras, view, trained.config.render) for view in chosen]
        plain = [view.restyled().rgb for view in views]
        rows: dict[str, list[dict[str, float]]] = {name: [] for name in STYLES}
        shown: dict[str, dict[str, Tensor]] = {}
        for name in asked.references:
            path = asked.styles / f"{name}.jpg"
            reference = torch.from_numpy(shrink(load_image(path), asked.longest)).float() / 255
            shown[name] = {"reference": reference, "plain": plain[0]}
            for title, style in STYLES.items():
                look = apply_style(trained, StyleFile(replace(style, references=(path,))), encoders).restyle
                made = [view.restyled(look).rgb for view in views]
                shown[name][title] = made[0]
                rows[title] += [judged(a, b, reference) for a, b in zip(plain, made, strict=True)]
        means = {
            title: {key: round(statistics.fmean(row[key] for row in found), 4) for key in found[0]}
            for title, found in rows.items()
        }
        scenes.append(
            {"scene": known.name, "steps": trained.step, "views": chosen, "references": asked.references, "means": means}
        )
        print(known.name, means, flush=True)
        if asked.sheets is not None:
            asked.sheets.mkdir(parents=True, exist_ok=True)
            write_image(asked.sheets / f"{known.name}.jpg", sheet(list(shown.values())))
    total = {
        title: {
            key: round(statistics.fmean(scene["means"][title][key] for scene in scenes), 4) for key in scenes[0]["means"][title]
        }
        for title in STYLES
    }
    write_json(asked.output, {"benchmark": "false_edges", "longest": asked.longest, "means": total, "scenes": scenes})


def judged(plain: Tensor, styled: Tensor, reference: Tensor) -> dict[str, float]:
    """The figures of one view."""
    return {
        "false_edges": false_edges(plain, styled) or 0.0,
        "structure": structure(plain, styled),
        "palette": _palette(styled, reference) / max(_palette(plain, reference), 1e-6),
        "change": float((styled - plain).abs().mean()),
    }


def _palette(a: Tensor, b: Tensor) -> float:
    ends = [torch.cat([x.reshape(-1, 3).mean(0), x.reshape(-1, 3).std(0)]) for x in (a, b)]
    return float((ends[0] - ends[1]).norm())


if __name__ == "__main__":
    main()
