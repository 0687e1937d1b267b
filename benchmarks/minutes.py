"""Quality against training time: captures trained for several budgets, each judged on its held-out views.

    python -m benchmarks minutes CAPTURE ... [--minutes 0.5 1 3] [--fit-poses] [--output FILE.json]

`CAPTURE` is a scene folder, or a file of transforms in one. Each budget is a training of its own by `fprf train
fprf-splats --minutes M`, without another flag, since a training plans by its budget. Each is an entry of the file,
with its own commit; entries of other captures and budgets stay. `--fit-poses` judges held-out views once more after
their poses were fitted. Kernels are compiled before anything is timed.
"""

import json
import os
import tempfile
from pathlib import Path

from .common import add_entry, arguments, cost_of

_FIGURES = ("size", "psnr", "psnr_fitted_poses", "ssim", "lpips", "train_steps", "gaussians")
"""Of the evaluation, that are kept."""


def main(argv: list[str]) -> None:
    parser = arguments("minutes", __doc__)
    parser.add_argument(
        "captures", nargs="+", type=Path, help="scene folders, or files of transforms in them"
    )
    parser.add_argument(
        "--minutes", nargs="+", type=float, default=[0.5, 1.0, 3.0], help="budgets, wall time"
    )
    parser.add_argument("--fit-poses", action="store_true", help="of held-out views, judged once more")
    parser.add_argument("--output", type=Path, help="JSON file that the figures are added to")
    asked = parser.parse_args(argv)
    for capture in asked.captures:
        folder = capture.parent if capture.suffix == ".json" else capture
        train = ["train", "fprf-splats", "--data", str(folder)]
        if capture.suffix == ".json":
            train += ["--parser", "transforms", "--parser.file", capture.name]
        with tempfile.TemporaryDirectory() as scratch:
            cost_of(*train, "--output", Path(scratch) / "first", "--steps", "1")
            for minutes in asked.minutes:
                run = Path(scratch) / f"{minutes:g}"
                cost = cost_of(*train, "--output", run, "--minutes", f"{minutes:g}")
                cost_of("eval", run, "--no-images", "--fit-poses", str(asked.fit_poses).lower())
                found = json.loads((run / "metrics.json").read_text("utf-8"))
                row = {"scene": folder.name, "minutes": minutes, **cost._asdict()}
                row |= {name: found[name] for name in _FIGURES if name in found}
                row["load_average"] = os.getloadavg()[0]
                add_entry(asked.output, f"{folder.name}, {minutes:g} min", row)
