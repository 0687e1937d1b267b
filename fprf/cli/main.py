"""The command line: `fprf VERB ...`. A verb's module is imported when it is used; `--help` imports nothing
heavy.

Packages add verbs in the entry-point group `fprf.commands` (`cli/config.py`); a built-in verb takes
precedence over one of the same name.

Exit codes: 0 done, 1 our fault, 2 what the user can mend (a mistake, too little memory; one line on standard
error), 130 interrupted, 141 where nobody reads the output any more.
"""

import io
import os
import sys
import traceback
from collections.abc import Sequence

from .. import __version__
from ..errors import FprfError
from ..memory import keep_memory, out_of_memory, shortage
from .verbs import VERBS as VERBS
from .verbs import Verb as Verb
from .verbs import packaged, run_packaged
from .verbs import verb_module as verb_module

_COMPLETION = ("--complete", "--show-completion", "--install-completion")
"""Verbs of completion: the one that shells ask, and the one that prints their scripts."""
_PIPE_CLOSED = 141
"""Exit status of a program that SIGPIPE ended."""
_SPIN_ROUNDS = "1000"
"""Of a thread of GNU's OpenMP that waits for others: some 20 microseconds (the times are told in `_run`)."""
_SPIN_MILLISECONDS = "0"
"""Of a thread of LLVM's OpenMP that waits for others."""


def main(args: Sequence[str] | None = None) -> int:
    """Run one verb and return its exit code."""
    given = list(sys.argv[1:] if args is None else args)
    debug = "--debug" in given or os.environ.get("FPRF_DEBUG", "") not in ("", "0")
    given = [arg for arg in given if arg != "--debug"]
    # The encoding of a pipe may lack letters that names of files have: printing them must not end a verb.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")
    try:
        code = _run(given)
        sys.stdout.flush()
        return code
    except SystemExit as end:  # `fprf VERB --help` ends this way
        if isinstance(end.code, int):
            return end.code
        return int(end.code is not None)
    except BrokenPipeError:  # the reader left, as `head` does
        os.dup2(
            os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno()
        )  # else the interpreter complains when it ends
        return _PIPE_CLOSED
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except Exception as error:
        if debug:
            traceback.print_exc()
        if isinstance(error, FprfError):
            print(f"error: {error}", file=sys.stderr)
            return 2
        # Too little memory is nobody's fault: one line says what it took.
        if out_of_memory(error):
            print(
                f"error: {shortage('fprf', error, 'close other programs, or take a larger --downscale')}",
                file=sys.stderr,
            )
            return 2
        if not debug:
            frames = traceback.extract_tb(error.__traceback__)
            if frames:
                place = f" ({frames[-1].filename}:{frames[-1].lineno} in {frames[-1].name})"
            else:
                place = ""
            print(f"internal error: {type(error).__name__}: {error}{place}", file=sys.stderr)
            print(
                "This is a fault of fprf or of a plug-in. Run it again with --debug and report the traceback.",
                file=sys.stderr,
            )
        return 1


def _run(args: list[str]) -> int:
    """Run a verb, built-in or of a package. Raises UsageError where there is no such verb."""
    if not args or args[0] in ("-h", "--help"):
        print(_help())
        return 0 if args else 2
    if args[0] == "--version":
        print(f"fprf {__version__}")
        return 0
    if args[0] in _COMPLETION:
        from . import completion

        if args[0] == "--complete":
            words = completion.complete(args[1:])
            print("\n".join(words), end="\n" if words else "")
        elif args[0] == "--show-completion":
            print(completion.script("".join(args[1:2])), end="")
        else:
            print(completion.install("".join(args[1:2])))
        return 0
    # OpenCV would tell damaged images a second time, beside our one line.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "FATAL")
    # Threads that wait for others give way soon, unless the user decided otherwise. By default OpenMP's spin
    # for milliseconds: where 20 other programs used the two cores a training step took 2304 ms, and 236 ms
    # with this; alone it costs a twentieth.
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", _SPIN_ROUNDS)
        os.environ.setdefault("KMP_BLOCKTIME", _SPIN_MILLISECONDS)
    keep_memory()
    # Each verb's module is imported when it is asked for: help and mistakes cost no torch.
    verb = args[0]
    rest = args[1:]
    if verb in VERBS:
        return int(verb_module(verb).run(rest))
    return run_packaged(verb, rest)


def _help() -> str:
    colour = sys.stdout.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"
    if colour:
        bold = "\x1b[1m"
        dim = "\x1b[2m"
        plain = "\x1b[0m"
    else:
        bold = ""
        dim = ""
        plain = ""
    others = packaged()
    width = max(map(len, [*VERBS, *others]))
    broad = max(len(verb.usage) for verb in VERBS.values())
    lines = [
        f"{bold}fprf {__version__}{plain}: restyle 3D radiance fields with photographs, feed-forward",
        "",
        "usage: fprf VERB [ARGUMENTS]",
        "",
        *(
            f"  {bold}{name:<{width}}{plain}  {verb.usage:<{broad}}  {dim}{verb.summary}{plain}"
            for name, verb in VERBS.items()
        ),
        "",
        *(f"  {bold}{name:<{width}}{plain}  {dim}of {package}{plain}" for name, package in others.items()),
        *([""] if others else []),
        "`fprf VERB --help` shows every flag of a verb, `fprf train` lists the methods. Start with `fprf demo`.",
        "`fprf --install-completion` lets the shell complete verbs, flags, plug-ins, runs and regions.",
    ]
    return "\n".join(lines)
