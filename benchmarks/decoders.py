"""Decoders in one run: how faithfully each returns photographs, and what a style term buys.

    python -m benchmarks decoders [--shared DIR] [--steps 4000] [--output benchmarks/results/decoders.json]

Without steps (0) only the decoders that ship, and the released one, are judged.

Photographs to learn from, others to judge by, VGG-19's weights and the decoder that the paper's authors released lie in a
folder beside the checkout, named by --shared or FPRF_SHARED; what is absent is skipped with the reason. All decoders of VGG-19
see the same guided-filtered features (the released one was trained with another radius of the filter). Fidelity is the PSNR of
decode(encode(photo)), photographs of at most 384 pixels. The losses compare crops of the judging photographs, each in the style
of the next by AdaIN, in units of VGG-19's filters; 0 is a perfect match. Seconds are processor time of this process.
"""

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import torch
from safetensors.torch import load_file

from fprf.interfaces import Encoder
from fprf.plugins.decoders.config import MlpDecoderConfig, Objective
from fprf.plugins.decoders.decoders import MlpDecoder
from fprf.plugins.encoders.config import BundledContentConfig, EncoderConfig, Vgg19Config
from fprf.pretraining.config import PretrainDecoderConfig
from fprf.pretraining.decoder import (
    LONGEST,
    Crops,
    StyleNetwork,
    decoder_report,
    load_style_network,
    prepare_crops,
    pretrain_decoder,
    restyling_report,
)
from fprf.pretraining.photos import find_photos

from .common import RESULTS, SHARED, arguments, report

LEARN = "data/pretrain"
JUDGE = "data/pst/content"
VGG = "weights/vgg19_imagenet.safetensors"
RELEASED = "weights/fprf_official_mlp_decoder.safetensors"
PHOTOS = 20
GOALS: dict[Objective, float] = {"identity": 33.0, "paper": 31.0}
"""Fidelity in dB that a decoder of each objective shall have."""
MEASURED = (
    ("psnr_db", "fidelity, mean", "psnr_db"),
    ("psnr_worst_db", "fidelity, worst photograph", "psnr_db"),
    ("style_loss", "style loss", "filter_deviations_squared"),
    ("content_loss", "content loss", "filter_deviations_squared"),
)
Row = dict[str, str | float | None]


def row(name: str, value: float | str, unit: str, goal: float | None = None, peer: float | None = None) -> Row:
    """A figure, or why there is none."""
    if isinstance(value, str):
        return {"name": name, "figure": None, "unit": unit, "goal": goal, "peer": None, "skipped": value}
    return {"name": name, "figure": float(f"{value:.4g}"), "unit": unit, "goal": goal, "peer": peer}


def released(path: Path) -> MlpDecoder:
    """sigmoid(W1 relu(W0 f)), no biases, as a decoder of ours."""
    tensors = load_file(path)
    hidden, channels = tensors["0.weight"].shape
    decoder = MlpDecoder(channels, hidden)
    with torch.no_grad():
        for layer, name in ((decoder.first, "0.weight"), (decoder.second, "1.weight")):
            layer.weight.copy_(tensors[name])
            layer.bias.zero_()
    return decoder.requires_grad_(False)


class Judge:
    """The same photographs and pairs for every decoder of an encoder."""

    def __init__(self, encoder: EncoderConfig, photos: list[Path], network: StyleNetwork, *, measure: bool) -> None:
        self.encoder: Encoder = encoder.build()
        self.photos, self.network = photos, network
        self.crops: Crops = prepare_crops(
            self.encoder, network, photos, side=128, longest=LONGEST, seed=7, measure=measure
        )  # fmt: skip

    def figures(self, decoder: MlpDecoder) -> dict[str, float]:
        """Fidelity and losses."""
        found = decoder_report(self.encoder, decoder, self.photos) | restyling_report(self.crops, self.network, decoder)
        return {name: float(value) for name, value in found.items()}

    def rows(self, name: str, decoder: MlpDecoder, *, goal: float | None, peer: dict[str, float] | None = None) -> list[Row]:
        """The figures as rows; `peer` are those of the released decoder."""
        found, told = self.figures(decoder), peer or {}
        print(name, json.dumps(found), file=sys.stderr, flush=True)
        return [
            row(f"{name}: {what}", found[key], unit, goal if key == "psnr_db" else None, told.get(key))
            for key, what, unit in MEASURED
        ]


def main(argv: list[str]) -> None:
    parser = arguments("decoders", __doc__)
    parser.add_argument("--shared", type=Path, default=SHARED)
    parser.add_argument("--output", type=Path, default=RESULTS / "decoders.json")
    parser.add_argument("--keep", type=Path, help="folder for the decoders that are trained; by default they are dropped")
    parser.add_argument("--steps", type=int, default=4000, help="steps of each decoder that is trained here")
    parser.add_argument("--photos", type=int, default=120, help="photographs that they learn from")
    parser.add_argument("--weights", type=float, nargs="*", default=[1e-3, 1e-2], help="of the style and the content loss")
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    rows: list[Row] = []
    absent = [str(part) for part in (LEARN, JUDGE, VGG) if not (args.shared / part).exists()]
    if absent:
        rows.append(row("decoders", f"{', '.join(absent)}: not in the folder of --shared or FPRF_SHARED", "psnr_db"))
    else:
        with tempfile.TemporaryDirectory() as folder:
            rows += measured(args, args.keep or Path(folder))
    report(args.output, {"rows": rows})


def measured(args: argparse.Namespace, folder: Path) -> list[Row]:
    """Every decoder that can be had, those of VGG-19 against the released one."""
    network = load_style_network(args.shared / VGG)
    photos = find_photos([args.shared / JUDGE])[:PHOTOS]
    vgg = Vgg19Config(weights=args.shared / VGG)
    judge = Judge(vgg, photos, network, measure=True)
    rows, peer = [], None
    if (args.shared / RELEASED).is_file():
        decoder = released(args.shared / RELEASED)
        peer = judge.figures(decoder)
        rows += judge.rows("released by the paper's authors", decoder, goal=None)
    else:
        rows.append(row("released by the paper's authors", f"{RELEASED}: not in the shared folder", "psnr_db"))
    for objective, goal in GOALS.items():
        rows += judge.rows(f"vgg19 relu2_1, shipped, {objective}", shipped(judge.encoder, objective), goal=goal, peer=peer)
    for weight in (0.0, *args.weights) if args.steps else ():
        name = f"vgg19 relu2_1, trained here, {f'the paper losses at {weight:g}' if weight else 'identity alone'}"
        decoder, seconds = trained(args, vgg, weight, folder / f"weight-{weight:g}.safetensors")
        rows += judge.rows(name, decoder, goal=31.0 if weight else 33.0, peer=peer)
        rows.append(row(f"{name}: training", seconds, "seconds"))
    bundled = Judge(BundledContentConfig(), photos, network, measure=False)
    for objective, goal in GOALS.items():
        rows += bundled.rows(f"bundled content encoder, shipped, {objective}", shipped(bundled.encoder, objective), goal=goal)
    return rows


def shipped(encoder: Encoder, objective: Objective) -> MlpDecoder:
    decoder = MlpDecoderConfig(objective=objective).build(encoder=encoder.identity, channels=encoder.channels)
    assert isinstance(decoder, MlpDecoder)
    return decoder


def trained(args: argparse.Namespace, encoder: Vgg19Config, weight: float, output: Path) -> tuple[MlpDecoder, float]:
    """A decoder by `fprf pretrain decoder`, and the processor time that it took."""
    config = PretrainDecoderConfig(
        images=(args.shared / LEARN,), photos=args.photos, steps=args.steps, encoder=encoder, style=weight, content=weight,
        style_weights=encoder.weights if weight else None, samples=0.0,
    )  # fmt: skip
    begun = time.process_time()
    pretrain_decoder(config, output, lambda line: print(line, file=sys.stderr, flush=True))
    seconds = time.process_time() - begun
    built = encoder.build()
    decoder = MlpDecoderConfig(weights=output).build(encoder=built.identity, channels=built.channels)
    assert isinstance(decoder, MlpDecoder)
    return decoder, seconds
