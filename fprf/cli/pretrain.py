"""`fprf pretrain decoder`: train the decoder D_VGG of an encoder. Prints a report as JSON."""

import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from ..errors import UsageError
from ..io.atomic import write_json
from ..io.overwriting import Origin
from ..pretraining.config import PretrainConfig, PretrainDecoderConfig
from .parsing import parse, read_paths
from .style_flags import say

Report = dict[str, float | int | str]
C = TypeVar("C", bound=PretrainConfig)


def run(args: list[str]) -> int:
    """`fprf pretrain decoder --images DIR... --output FILE ...`: 0 when the weights are written."""
    kind, rest = (args[0], args[1:]) if args else ("", [])
    if kind in ("-h", "--help"):
        print("usage: fprf pretrain decoder --images DIR... --output FILE [--help]")
        return 0
    if kind != "decoder":
        raise UsageError(
            f"fprf pretrain: {kind or 'nothing'!r} to train; allowed is decoder (encoders: `python -m tools.distil` in a clone)"
        )
    from ..pretraining.decoder import pretrain_decoder

    about = "The colour decoder D_VGG of one encoder, trained for identity."
    return pretrain(PretrainDecoderConfig(), rest, "fprf pretrain decoder", about, pretrain_decoder)


def pretrain(
    default: C,
    args: list[str],
    prog: str,
    about: str,
    train: Callable[[C, Path, Callable[[str], None]], Report],
) -> int:
    """Parse the arguments, train, and write and print the report; 0 when the weights are written."""
    config = parse(default, args, prog=prog, description=about)
    if not config.images:
        raise UsageError(f"{prog}: no photographs; name their folders with --images DIR ...")
    if config.output is None:
        raise UsageError(f"{prog}: nowhere to write; name the weights file with --output FILE")
    if config.output.is_dir():
        raise UsageError(f"{prog}: --output {config.output} is a folder; name the weights file to write")
    report_file = config.output.with_name(config.output.stem + ".report.json")
    origin = Origin(by=prog, reads=read_paths(config), overwrite=config.overwrite)
    origin.check([config.output, report_file])
    from ..pretraining.loop import training_folder
    from ..training.locks import lock_folder

    begun = time.monotonic()
    folder = training_folder(config.output)
    # Checkpoints stay until everything is written: a full disk costs no training.
    with lock_folder(folder), origin.writing([config.output, report_file]):
        measured = train(config, config.output, say)
        report = {
            "weights": str(config.output),
            **measured,
            "seed": config.seed,
            "seconds": round(time.monotonic() - begun, 1),
        }
        # The weights by their bare name, since both may be moved.
        told = {"kind": prog.split()[-1], **report, "weights": config.output.name}
        write_json(report_file, told)
        shutil.rmtree(folder, ignore_errors=True)
    print(json.dumps(report, indent=2))
    return 0
