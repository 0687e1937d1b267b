"""Distil an encoder that ships from large ones: `python -m tools.distil content|semantic --images DIR...
--output FILE`.
"""

import sys

from fprf.cli.pretrain import pretrain
from fprf.errors import FprfError

from .config import DistilConfig, SemanticDistilConfig


def main(args: list[str]) -> int:
    """0 when the weights are written; 2 for a mistake in the arguments, which one line on standard error
    names.
    """
    kind, rest = (args[0], args[1:]) if args else ("", [])
    try:
        if kind == "content":
            from .content import pretrain_content

            about = "A small content encoder that imitates VGG-19 relu2_1."
            return pretrain(DistilConfig(), rest, "python -m tools.distil content", about, pretrain_content)
        if kind == "semantic":
            from .semantic import pretrain_semantic

            about = "A small semantic encoder that imitates MobileNetV2s."
            return pretrain(
                SemanticDistilConfig(), rest, "python -m tools.distil semantic", about, pretrain_semantic
            )
    except FprfError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(
        "usage: python -m tools.distil content|semantic --images DIR... --output FILE [--help]",
        file=sys.stderr,
    )
    return 0 if kind in ("-h", "--help") else 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
