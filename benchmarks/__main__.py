"""`python -m benchmarks NAME [flags]`: run one benchmark, or list them all."""

import importlib
import sys

from fprf.errors import FprfError
from fprf.process import keep_memory

BENCHMARKS = {
    "blocks_scenes": "a capture in blocks against one field, for the same seconds",
    "cells": "captures in cells of Gaussians against one piece and blocks of fields",
    "coordinates": "a capture in projected, Earth-centred, very large and very small coordinates against its own",
    "decoders": "fidelity of decoders, and what a style loss buys",
    "district": "a district of 2000 images in cells: seconds, memory and killed workers",
    "district_style": "a style on millions of Gaussians: seconds and memory, part by part, killed half-way",
    "evidence": "all pages of docs/evidence",
    "executors": "blocks on workers of Ray against one after the other",
    "exports": "exported files drawn again, against the field's own renders",
    "false_edges": "how often styles cut through things",
    "feature_store": "size, error and speed of feature targets by stride",
    "first_use": "quality of small captures at equal steps",
    "fuzz": "every reader on a million mutated files",
    "fuzz_guided": "every reader under libFuzzer",
    "gallery": "the pictures and figures of docs/gallery",
    "gaussians": "the rasteriser of 3D Gaussians: time and error",
    "hosts": "a cluster of two hosts that loses one",
    "images": "time and error of decoding photographs",
    "kernels": "what each compiled kernel brings end to end",
    "kills": "training that is killed a hundred times",
    "large_scene": "a town of 400 images in blocks: quality, seams, memory, time",
    "many_images": "more images than memory",
    "match_confidence": "what scores of matches say, on painted pairs of photographs",
    "methods": "fields and Gaussians on the same captures for the same seconds",
    "mutants": "how many small mistakes in the mathematics the tests notice",
    "paper": "the paper's tables on any scene",
    "pareto": "time against error, knob by knob",
    "peak_memory": "peak memory of each part of the work, each in a process of its own",
    "peer": "frames of any system, scored by the code that scores ours",
    "phone": "photographs without poses to a restyled scene",
    "poses": "wrong poses, and what refining wins back",
    "precision": "errors of bfloat16 and TF32",
    "profiling": "where the time of a training step and of a view goes",
    "restyle": "every stylizer against the truth: a town in the light of other towns",
    "roofline": "how near the tri-plane lookup comes to the memory's speed",
    "scaling": "cost against the number of images, pixels, references and points",
    "semantic_matching": "which encoder finds like with like",
    "speed": "training, views and styles against the naive path, with their errors",
    "splat_restyle": "time and memory of restyling captures of Gaussians",
    "stress": "every stage on adversarial inputs, against a reference and a bound",
    "styles": "every stylizer on painted photographs and on runs",
    "town": "write a town as a scene folder",
    "page": "the page: pictures against the rasteriser, frames, sorting, memory, and a dropped photograph",
}
"""Module of this package and one line for each. `benchmarks/gpu.sh` measures a machine with a GPU."""


def main(args: list[str]) -> int:
    """0 done; 2 for a mistake in the arguments, which one line on standard error names."""
    if not args or args[0] in ("-h", "--help"):
        width = max(map(len, BENCHMARKS))
        print("usage: python -m benchmarks NAME [flags]\n")
        print("\n".join(f"  {name:<{width}}  {about}" for name, about in BENCHMARKS.items()))
        return 0 if args else 2
    if args[0] not in BENCHMARKS:
        print(f"error: {args[0]}: no such benchmark; allowed are {', '.join(BENCHMARKS)}", file=sys.stderr)
        return 2
    keep_memory()  # as the command line does: else large gradients are mapped anew in every step
    try:
        return importlib.import_module(f".{args[0]}", __package__).main(args[1:]) or 0
    except FprfError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
