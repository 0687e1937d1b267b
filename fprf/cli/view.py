"""`fprf view [RUN|CAPTURE.ply]`: a scene in the browser, or the page that makes one; a photograph dropped on
it restyles it.
"""

import contextlib
import functools
import os
import signal
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..checks import at_least, between
from ..errors import CheckpointError, UsageError
from ..plugins.stylizers.config import RegionToneConfig, StylizerConfig
from ..splats.config import GaussianSemanticsConfig
from ..style.config import StyleConfig
from ..training.quality import QualityConfig
from .parsing import parse
from .style_flags import say

if TYPE_CHECKING:
    from ..page.session import Viewed

_MAX_EXIT_SECONDS = 15.0
"""After an interrupt, within which all must have ended: longer than what the start page waits for."""


@dataclass(frozen=True, kw_only=True)
class ViewConfig(QualityConfig):
    """The run to show, and access to it."""

    run: Path | None = None
    """Run folder, or a capture of 3D Gaussians: .ply .splat .spz .sog .glb .ksplat, or a SOG folder; none = a
    start page in the browser, which takes photographs, a video, a capture or a run.
    """
    output: Path = Path("my_scenes")
    """Folder of what the start page makes, with a folder for each scene."""
    up: tuple[float, float, float] | None = None
    """Direction that points up in a capture's own axes; none = as the file says, else away from its ground,
    else 0 -1 0.
    """
    north: tuple[float, float, float] | None = None
    """Direction of north in a capture's own axes; none = as the file says, else not known."""
    activated: bool = False
    """Read opacities, sizes and colours of a capture that look activated already as such; one line says where
    they do.
    """
    inside: bool | None = None
    """Look at a capture from within, as in rooms and streets, or around an object; none = found out."""
    semantic: GaussianSemanticsConfig = GaussianSemanticsConfig()
    """Semantics of a capture; a run has its own."""
    stylizer: StylizerConfig | None = None
    """Stylizer that puts styles onto regions; none = region-tone, as `fprf stylize` and `fprf restyle` have
    it.
    """
    references: tuple[Path, ...] = ()
    """At most 12 photographs, or folders of them, to begin with: on the shelf, and all in the mix."""
    host: str = "127.0.0.1"
    """Address to listen on; any but this machine's own needs a token."""
    port: int = 8080
    """Port to listen on; 0 = any that is free."""
    token: str | None = None
    """Secret that the address must carry (?token=...), at least 16 characters; none = made where one is
    needed.
    """
    pixels: int = 640
    """Longest side of the sharpest picture, 64 to 2048."""
    follow: bool = False
    """Wait for the first checkpoint of a training that has only begun. A run in training is followed
    without.
    """
    max_memory: float | None = None
    """MiB that blocks of a large scene may take; none = no limit."""
    device: str = "auto"
    """cpu, cuda, mps, or auto."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least("port", self.port, 0)
        between("port", float(self.port), 0.0, 65535.0)
        between("pixels", float(self.pixels), 64.0, 2048.0)


def run(args: list[str]) -> int:
    """Serve until interrupted."""
    description = (
        "Look at a run in the browser; without one, make a scene there of photographs, a video or a capture."
    )
    config = parse(ViewConfig(), args, prog="fprf view", description=description, positional=("run",))
    # Other ends than an interrupt clean up too; one that is ignored, as under nohup, stays so.
    for name in ("SIGTERM", "SIGHUP"):
        if (number := getattr(signal, name, None)) is not None and signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, signal.default_int_handler)
    from ..page.access import make_access
    from ..page.messages import SHELF
    from ..page.server import ViewerServer

    access = make_access(config.host, config.token)
    with contextlib.ExitStack() as stack:
        # The address is taken first: while torch is imported the browser already has a page.
        server = stack.enter_context(ViewerServer(access, config.port))
        from ..page.uploads import is_capture, newest_step

        # `--follow` waits for a run folder that training has not made yet.
        path = config.run
        if config.follow and path is not None and is_capture(path):
            raise UsageError(f"--follow: {path} is a capture, which no training goes on with; leave it out")
        if path is not None and not (config.follow or is_capture(path) or (path / "config.json").is_file()):
            raise CheckpointError(
                f"{path}: no config.json here, so it is no run folder; `fprf train` makes one"
            )
        if any(
            each.is_dir() for each in config.references
        ):  # decoding needs a library that the page does not wait for
            from ..datamanagers.images import photographs

            config = replace(config, references=tuple(photographs(config.references, say)))
        if len(config.references) > SHELF:
            raise UsageError(
                f"--references: {len(config.references)} photographs; the shelf takes {SHELF}: name fewer"
            )
        print(server.address, flush=True)
        load = functools.partial(_load, config, server.wait)
        try:
            if path is None:
                from ..page.start import Start

                start = Start(config.output, server, load)
                server.show_start(start)
                stack.callback(start.close)
            else:
                opening = functools.partial(load, path)
                session = None
                # A run that training has only begun is waited for: its first checkpoint is about to come.
                begun = not is_capture(path) and newest_step(path) < 0
                waiting = ""
                if begun:
                    waiting = f"{path}: no checkpoint yet; it is shown as soon as training saves one"
                    server.wait("opening", waiting, 0.0)
                if not (config.follow or begun):
                    session = server.open(opening)
                if not is_capture(path):
                    from ..page.following import TrainingFollower

                    # A run that is in training: the scene is loaded anew with each checkpoint.
                    TrainingFollower(server, path, opening, session, waiting).run(threading.Event())
            threading.Event().wait()
        except KeyboardInterrupt:
            # Whatever a thread is in the middle of, the terminal comes back.
            last = threading.Timer(_MAX_EXIT_SECONDS, os._exit, (130,))
            last.daemon = True
            last.start()
            raise
    return 0


def _load(
    config: ViewConfig,
    wait: "Callable[[str, str, float | None], None]",
    path: Path,
    name: str | None = None,
) -> "Viewed":
    """The scene of a run or a capture, under its own name where none is given."""
    from ..page.session import Viewed, view_of_run
    from ..page.uploads import is_capture

    if not is_capture(path):
        from ..training.loading import open_run

        viewed = view_of_run(open_run(path, config.device, config))
        style = StyleConfig(stylizer=config.stylizer or RegionToneConfig())
        name = name or viewed.name
        return replace(viewed, name=name, style=style, references=config.references, pixels=config.pixels)
    from ..page.messages import READ_SHARE, SEARCHED_SHARE
    from ..splats.captures import FINDING_VIEWS, open_capture, with_asked_north
    from ..splats.config import LookConfig
    from ..splats.files import read_capture

    def progress(what: str, done: int, total: int) -> None:
        share = done / max(1, total)
        if what == FINDING_VIEWS:
            words = f"{path.name}: judging places to look at {len(capture.gaussians):,} Gaussians from, {done} of {total}"
            wait("opening", words, READ_SHARE + (SEARCHED_SHARE - READ_SHARE) * share)
            return
        words = f"Looking at {path.name}, once: {done} of {total}"
        wait("looking", "" if done >= total else words, share)

    wait("opening", f"Reading {path.name}", 0.0)
    capture = read_capture(path, activated=config.activated)
    for note in capture.notes:
        say(f"{capture.path}: {note}")
    look = LookConfig(
        up=config.up,
        north=config.north,
        inside=config.inside,
        activated=config.activated,
        semantic=config.semantic,
    )
    capture = with_asked_north(capture, look)
    wait("opening", f"{path.name}: {len(capture.gaussians):,} Gaussians are read", READ_SHARE)
    scene = open_capture(capture, look, progress=progress, say=say)
    name = name or path.resolve().name.partition(".")[0]
    style = StyleConfig(stylizer=config.stylizer or RegionToneConfig(centred=False))
    viewed = Viewed(scene, name, 0, root=config.output / name, capture=capture, style=style)
    return replace(viewed, references=config.references, pixels=config.pixels)
