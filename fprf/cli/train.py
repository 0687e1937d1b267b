"""`fprf train [METHOD|CONFIG.json]`: train a scene, or go on where a run stopped."""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from ..errors import PluginError
from ..io.paths import as_path
from ..plugins import registry
from .parsing import first_line, load_method, parse, read_paths

DEFAULT_METHOD = "fprf-splats"
"""Method where none is named: the best quality for the time on every capture that was measured
(docs/measurements.md).
"""
VIEW = "--view"
CHANGED = "--changed-images"
OVERWRITE = "--overwrite"


def run(args: list[str]) -> int:
    """Parse, prepare, train, measure the scene's style."""
    if not args or args[0] in ("-h", "--help"):
        print(_usage())
        return 0 if args else 2
    if args[0].startswith("-"):
        args = [DEFAULT_METHOD, *args]
    config, method = load_method(args[0])
    # A saved config goes on with its run, wherever that lies now.
    source = as_path(args[0])
    if source.suffix == ".json" and config.output is None:
        config = replace(config, output=source.parent)
    flags, overwrite = _take_overwrite([arg for arg in args[1:] if arg not in (VIEW, CHANGED)])
    changed = CHANGED in args
    about = (
        f"Train a scene with {method}.\n"
        f"{VIEW} shows training live in the browser, as `fprf view RUN --follow` does, which takes another address;\n"
        f"{CHANGED} goes on with a run although its images are no longer those that it was begun with;\n"
        f"{OVERWRITE} true begins anew where another run, or files of other programs, are in its place."
    )
    config = parse(config, flags, prog=f"fprf train {args[0]}", description=about)
    from ..training.driver import default_output, train
    from ..training.run import make_room

    make_room(config.output or default_output(config, method), read_paths(config), overwrite)
    if VIEW not in args:
        train(config, method, changed_images=changed)
        return 0
    # The viewer reads the run folder alone, in a process of its own: it cannot stop the training.
    with viewed(config.output or default_output(config, method)):
        train(config, method, changed_images=changed)
    return 0


def _take_overwrite(args: list[str]) -> tuple[list[str], bool]:
    """The other flags, and whether `--overwrite`, alone or with a truth, is among them."""
    rest: list[str] = []
    overwrite = False
    after = False
    for arg in args:
        key, equals, value = arg.partition("=")
        if key == OVERWRITE:
            overwrite = not equals or value.lower() == "true"
            after = not equals
        elif after and arg.lower() in ("true", "false"):
            overwrite = arg.lower() == "true"
            after = False
        else:
            rest.append(arg)
            after = False
    return rest, overwrite


@contextmanager
def viewed(run: Path) -> Iterator[None]:
    """`fprf view RUN --follow` beside the block, in a process of its own: whatever becomes of it, training
    goes on.
    """
    from ..training.driver import is_watched

    # An interrupt at the terminal is training's; the viewer is then ended here.
    process = subprocess.Popen(
        [sys.executable, "-m", "fprf", "view", str(run), "--follow"], start_new_session=True
    )
    try:
        yield
        while (
            sys.stderr.isatty() and process.poll() is None and is_watched(run)
        ):  # Ctrl-C ends the page as well
            time.sleep(0.5)
    finally:
        process.terminate()
        try:
            process.wait(5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def methods() -> dict[str, str]:
    """The installed methods with the first line of their documentation; a broken one says so instead."""
    listed = {}
    for name in registry.installed("fprf.methods"):
        try:
            listed[name] = first_line(registry.load_object("fprf.methods", name))
        except PluginError as fault:
            listed[name] = f"(broken) {fault}"
    return listed


def _usage() -> str:
    listed = methods()
    width = max(map(len, listed))
    lines = [
        "usage: fprf train [METHOD|CONFIG.json] --data DIR [any field]",
        "",
        f"methods ({DEFAULT_METHOD} where none is named):",
        *(f"  {name:<{width}}  {about}" for name, about in listed.items()),
        "",
        "`fprf train METHOD --help` lists every field; a saved config.json goes on with its run.",
    ]
    return "\n".join(lines)
