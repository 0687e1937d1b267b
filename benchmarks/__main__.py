"""`python -m benchmarks NAME [flags]`: run one benchmark, or list them all."""

import importlib
import importlib.util
import shlex
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from fprf.errors import FprfError, UsageError
from fprf.memory import keep_memory

from .town.write import cached_town


class Benchmark(NamedTuple):
    """A module of this package with `main(argv)`."""

    about: str
    quick: str
    """Flags that `--quick` stands for: the whole way, in about a minute, with figures that mean nothing.

    {town} is the folder of a small town, {run} a short training of a tiny model on it, {folder} one that is
    thrown away, {results} that of the results of this repository.
    """
    needs: str = "nothing but fprf"
    """Data, extras and time; said before it starts."""
    packages: tuple[str, ...] = ()
    """Modules that must be there."""


RESULTS = Path(__file__).parent / "results"
"""Figures that the documents show."""
_RUN = "{run} --repeats 1 --rays 256 --device cpu"
_TRAINED = "a run of fields; without one it trains fprf-lite on the town first"
BENCHMARKS = {
    "compare": Benchmark(
        "two results of one benchmark; fails where the new one has lost a tenth",
        "{results}/speed_fox.json {results}/speed_fox.json",
        "two JSON files",
    ),
    "correspondences": Benchmark(
        "every method by the true answer at points: one place in two pictures, from two standpoints",
        "--folder {folder}/pairs --seeds 0",
        "the pairs of WxBS 1.1; without them it is skipped",
    ),
    "edges": Benchmark(
        "codes that pixels at the borders of a town's things take, against their true classes",
        "--runs 1 --steps 40 --views 1 --palettes night",
    ),
    "exports": Benchmark(
        "exported files drawn again, against the scene's own renders", "{run} --views 1", _TRAINED
    ),
    "fuzz": Benchmark(
        "every reader on a million mutated files", "--rounds 40", "hours for the million; Linux"
    ),
    "fuzz_guided": Benchmark(
        "every reader under libFuzzer",
        '--minutes 0.2 --only "image, png"',
        "the package atheris; Linux",
        ("atheris",),
    ),
    "gaussians": Benchmark("the rasteriser of 3D Gaussians: time and error", "--count 500 --times 2"),
    "kernels": Benchmark("what each compiled kernel brings end to end", "{run} --repeats 1", _TRAINED),
    "kills": Benchmark(
        "training that is killed a hundred times", "--kills 3 --steps 25", "ten minutes; Linux"
    ),
    "light": Benchmark(
        "every method by the true answer: fixed cameras, the left half of another light is the reference",
        "--folder {town}/images --lights 1 --seeds 0 --width 64",
        "folders of pictures of fixed cameras; without them it is skipped",
    ),
    "sun": Benchmark(
        "a town captured under clouds, lit by nine suns, against its tracer",
        "--steps 60 --pictures 16 --suns 1 --views 1",
        "a run of Gaussians of a town in the palette overcast; without one it trains it first",
    ),
    "unlit": Benchmark(
        "towns captured in the sun, whose light is taken away, against their tracer's clouds",
        "--steps 60 --towns 1 --views 1",
        "nothing but fprf; some minutes",
    ),
    "captured_sun": Benchmark(
        "the sun that towns were captured in, found from Gaussians of their tracer",
        "--towns 1 --clouded 1 --earlier 0",
    ),
    "reference_sun": Benchmark(
        "the sun of photographs for --sun auto: pictures of towns in the sun and under clouds",
        "--towns 1",
    ),
    "sun_traced": Benchmark(
        "scenes of primitives captured under clouds, lit, against another renderer's paths",
        "--scenes yard --steps 60 --views 16 --suns 1 --samples 2",
        "the package mitsuba; half an hour",
        ("mitsuba",),
    ),
    "mutants": Benchmark(
        "how many small mistakes in the mathematics the tests notice",
        "--only fprf/rendering/splines.py --sample 2",
        "the extra test; hours for all modules; Linux",
        ("pytest", "hypothesis"),
    ),
    "minutes": Benchmark(
        "Gaussians of captures against minutes of training",
        "{town} --minutes 0.05",
        "captures; two free cores, as all budgets are wall time",
    ),
    "page": Benchmark(
        "the page: pictures against the rasteriser, frames, sorting, memory, and a dropped photograph",
        "--parts million --few",
        "playwright and a Chromium; runs of Gaussians but for the part million",
    ),
    "paper": Benchmark(
        "the paper's ablations on the town, or on another scene by photographs",
        "--method {run}/config.json --data {town} --steps 5 --views 1 --palettes night --device cpu",
        "a scene of --data; VGG-19's weights in the cache where photographs restyle it",
    ),
    "pareto": Benchmark("time against error, knob by knob", _RUN, _TRAINED),
    "peer": Benchmark(
        "frames of any system, scored by the code that scores ours",
        "{town}/images --cameras {town}/transforms.json --plain {town}/images --depth {town}/depth --truth {town}/images",
        "a folder of frames and their cameras",
    ),
    "restyle": Benchmark(
        "every stylizer against the truth: a town in the light of other towns",
        "{run} --views 1 --longest 48 --palettes night --missing sky --clusters 4 --device cpu",
        "a run of a town; without one it trains fprf-lite on one first",
    ),
    "scenes": Benchmark(
        "methods on captures for the same time, judged on the same views",
        "--steps 20 --side 80",
        "captures; without any, the garden",
    ),
    "semantic_matching": Benchmark(
        "which encoder finds like with like, and what its scores say",
        "--most 1 --seeds 0 --views 1 --size 64 48",
        "painted triplets in --triplets; without them the town alone",
    ),
    "speed": Benchmark(
        "training, views and styles against the naive path, with their errors",
        f"{_RUN} --points 500 --clusters 4",
        _TRAINED,
    ),
    "splat_restyle": Benchmark("time and memory of restyling captures of Gaussians", "--synthetic 2000"),
    "stress": Benchmark(
        "every stage on adversarial inputs, against a reference and a bound",
        f"{_RUN} --mutations 2 --flips 5",
        _TRAINED,
    ),
    "styles": Benchmark(
        "every stylizer on painted photographs and on runs",
        "{run} --triplets 0 --views 2 --longest 64",
        "triplets, photographs and VGG-19's weights in --shared; without them a run of the town",
    ),
    "town": Benchmark(
        "write a town as a scene folder",
        "{folder}/town --views 2 --width 24 --height 18",
        "a folder to write into",
    ),
    "record": Benchmark(
        "measure a result again and write it with commit, command, date and sources",
        "quick --folder {folder} --sources fprf/ops -- gaussians --count 500 --times 2",
        "what the benchmark needs that made it",
    ),
    "tables": Benchmark("tables of the documents, made from the results", "--check", "a clone"),
    "wild": Benchmark(
        "every method by the true answer: half of a photograph in the wild restyles the scene at its pose",
        "--runs {run} --split test --longest 64 --seeds 0 --device cpu",
        "runs of captures in several lights; without them it is skipped",
    ),
}
"""`benchmarks/gpu.sh` measures a machine with a GPU."""


def main(args: list[str]) -> int:
    """0 done; 2 for a mistake in the arguments or a package that is absent, which one line on standard error
    names.
    """
    if not args or args[0] in ("-h", "--help"):
        width = max(map(len, BENCHMARKS))
        print("usage: python -m benchmarks NAME [--quick] [flags]\n")
        print("\n".join(f"  {name:<{width}}  {each.about}" for name, each in BENCHMARKS.items()))
        return 0 if args else 2
    name = args[0]
    flags = args[1:]
    try:
        if name not in BENCHMARKS:
            raise UsageError(f"{name}: no such benchmark; allowed are {', '.join(BENCHMARKS)}")
        chosen = BENCHMARKS[name]
        if not {"-h", "--help"} & set(flags):
            print(f"{name} needs {chosen.needs}", file=sys.stderr)
            absent = [package for package in chosen.packages if importlib.util.find_spec(package) is None]
            if absent:
                raise UsageError(f"{name}: {', '.join(absent)} not installed; pip install {' '.join(absent)}")
        keep_memory()  # as the command line does: else large gradients are mapped anew in every step
        with tempfile.TemporaryDirectory(prefix="fprf-quick-") as folder:
            if "--quick" in flags:
                flags.remove("--quick")
                town = cached_town(views=8, width=48, height=36)
                run = f"{folder}/run"
                if "{run}" in chosen.quick:
                    from fprf.training.driver import train

                    from .kills import tiny

                    train(
                        replace(tiny(town, steps=20), output=Path(run), checkpoint_minutes=5.0), "fprf-lite"
                    )
                flags = [
                    *shlex.split(chosen.quick.format(town=town, run=run, folder=folder, results=RESULTS)),
                    *flags,
                ]
            return importlib.import_module(f".{name}", __package__).main(flags) or 0
    except FprfError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
