"""`fprf pretrain`: train the encoders that ship, or the decoder D_VGG of any encoder. Prints a report as JSON."""

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from ..errors import UsageError
from ..pretraining.config import DistilConfig, PretrainConfig, PretrainDecoderConfig, SemanticDistilConfig
from .parsing import parse

__all__ = ["run"]

KINDS = ("content", "semantic", "decoder")
Report = dict[str, float | int | str]
C = TypeVar("C", bound=PretrainConfig)


def run(args: list[str]) -> int:
    """`fprf pretrain content|semantic|decoder --images DIR... --output FILE ...`: 0 when the weights are written."""
    kind, rest = (args[0], args[1:]) if args else ("", [])
    if kind in ("-h", "--help"):
        print(f"usage: fprf pretrain {'|'.join(KINDS)} --images DIR... --output FILE [--help]")
        return 0
    if kind == "content":
        from ..pretraining.content import pretrain_content

        return _run(DistilConfig(), rest, kind, "A small content encoder that imitates VGG-19 relu2_1.", pretrain_content)
    if kind == "semantic":
        from ..pretraining.semantic import pretrain_semantic

        return _run(
            SemanticDistilConfig(), rest, kind, "A small semantic encoder that imitates MobileNetV2s.", pretrain_semantic
        )
    if kind == "decoder":
        from ..pretraining.decoder import pretrain_decoder

        about = "The colour decoder D_VGG of one encoder, trained for identity."
        return _run(PretrainDecoderConfig(), rest, kind, about, pretrain_decoder)
    raise UsageError(f"fprf pretrain: {kind or 'nothing'!r} to train; allowed are {', '.join(KINDS)}")


def _run(
    default: C, args: list[str], kind: str, about: str, pretrain: Callable[[C, Path, Callable[[str], None]], Report]
) -> int:
    config = parse(default, args, prog=f"fprf pretrain {kind}", description=about)
    if not config.images:
        raise UsageError(f"fprf pretrain {kind}: no photographs; name their folders with --images DIR ...")
    if config.output is None:
        raise UsageError(f"fprf pretrain {kind}: nowhere to write; name the weights file with --output FILE")
    begun = time.monotonic()
    found = pretrain(config, config.output, _say)
    report = {"weights": str(config.output), **found, "seed": config.seed, "seconds": round(time.monotonic() - begun, 1)}
    from ..pretraining.loop import write_report

    write_report(config.output, kind, report)
    print(json.dumps(report, indent=2))
    return 0


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
