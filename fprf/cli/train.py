"""`fprf train [METHOD|CONFIG.json]`: train a scene, or go on where a run stopped."""

import contextlib
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import UsageError
from .blocks import train_blocks
from .parsing import load_method, methods, parse
from .progress import EventLog

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..config import RunConfig, TrainConfig
    from ..datamanagers.scene import Scene
    from ..training.model import Model
    from ..training.prepare import Prepared
    from ..training.run import Run
    from ..training.trainer import Report
    from ..viewer.live import LiveViewer, ViewAddress
    from .progress import Display


VIEW = "--view"


def take_view(args: Sequence[str]) -> "tuple[list[str], ViewAddress | None]":
    """Split `--view [[HOST:]PORT]` from the other arguments; None where it is absent. Raises UsageError for no port."""
    from ..viewer.live import ViewAddress

    rest: list[str] = []
    address: ViewAddress | None = None
    words = iter(range(len(args)))
    for i in words:
        name, equals, value = args[i].partition("=")
        if name != VIEW:
            rest.append(args[i])
            continue
        if not equals and i + 1 < len(args) and not args[i + 1].startswith("-"):
            value = args[next(words)]
        address = ViewAddress()
        if value or equals:
            host, _, port = value.rpartition(":")
            if not (port.isascii() and port.isdigit() and int(port) < 65536):
                raise UsageError(f"{VIEW} {value}: it takes a port from 0 to 65535, or HOST:PORT, or nothing")
            address = ViewAddress(host.strip("[]") or address.host, int(port), strict=True)
    return rest, address


def open_view(address: "ViewAddress", run: Path) -> "LiveViewer":
    """Start the viewer's process on a run folder. Raises UsageError where it cannot listen."""
    from ..viewer.live import LiveViewer

    return LiveViewer(address, run)


def finish_view(view: "LiveViewer") -> None:
    """After training, keep the view on a terminal as long as somebody looks. Ctrl-C is then no failure."""
    from .progress import Display

    with Display() as display:
        if view.fault is not None:
            display.say(f"{VIEW}: the viewer has ended ({view.fault}); training did not need it")
        elif display.live and view.looked_at:
            display.say("somebody is looking; Ctrl-C ends the view as well")
            with contextlib.suppress(KeyboardInterrupt):
                view.wait()


DEFAULT_METHOD = "fprf-splats"
"""Where none is named: the best quality for the time on every capture that was measured (docs/photographs.md)."""
CHANGED = "--changed-images"
_SEEN_MINUTES = 0.2
"""Minutes between checkpoints while a viewer follows them, at most."""
_TIMED_VIEWS = 2
"""Views after which the time of all features is estimated."""
_SMALL = 96
"""Pixels of an image's shorter side below which a `--downscale` that was asked for is probably a mistake."""
_SHOWN = 4
"""Differences of a run's config that a message names."""


def run(args: list[str]) -> int:
    """Parse, prepare, train, measure the scene's style."""
    if not args or args[0] in ("-h", "--help"):
        print(_usage())
        return 0 if args else 2
    if args[0].startswith("-"):
        args = [DEFAULT_METHOD, *args]
    config, method = load_method(args[0])
    source = Path(args[0])
    if source.suffix == ".json" and config.output is None:
        config = replace(config, output=source.parent)
    rest, place = take_view(args[1:])
    if "--plan" in rest:
        raise UsageError("--plan: is gone; training says first how many blocks there are, and blocks.json where they lie")
    flags, others = [arg for arg in rest if arg != CHANGED], CHANGED in rest
    about = (
        f"Train a scene with {method}.\n"
        f"{VIEW} [[HOST:]PORT] shows training live in the browser, at http://127.0.0.1:8080 if nothing is said;\n"
        f"{CHANGED} goes on with a run although its images are no longer those that it was begun with."
    )
    config = parse(config, flags, prog=f"fprf train {args[0]}", description=about)
    if place is None:
        config.verbs().train(method, others=others)
    else:
        # What is seen are checkpoints: they are written as often as one likes to see them.
        config = replace(config, checkpoint_minutes=min(config.checkpoint_minutes, _SEEN_MINUTES))
        root = config.output or default_output(config, method)
        with open_view(place, root) as view:
            print(f"live at {view.address}", file=sys.stderr, flush=True)
            config.verbs().train(method, others=others)
            finish_view(view)
    return 0


def default_output(config: "RunConfig", method: str) -> Path:
    """runs/SCENE-METHOD."""
    name = "" if config.data is None else config.data.resolve().name
    return Path("runs") / f"{name or 'scene'}-{method}"


def train_scene(config: "TrainConfig", method: str, *, quiet: bool = False, others: bool = False) -> Path:
    """Train to the end and return the run folder. An existing run there is resumed if its config and its images fit;
    with `others` the images may have changed.

    Raises UsageError where packages, weights or the scene are missing, DataError where another process is training there.
    """
    from ..datamanagers.images import useless_masks
    from ..io.atomic import remove_unfinished
    from ..style.scene import to_tensors
    from ..training import prepare, style_pass, trainer
    from ..training.block_plan import plan_scene
    from ..training.prepare import Forecast
    from ..training.run import Run, check_images, held, image_hashes, save_image_hashes
    from .progress import Display

    start = time.perf_counter()
    output = config.output or default_output(config, method)
    config = replace(config, output=output)
    folder = Run(output)
    with Display(quiet=quiet) as display:
        _check_needs(config, method, display)  # before there is a folder
    with held(output), Display(quiet=quiet) as display:
        display.say(f"{method} on {config.data}, run folder {output}")
        config = _sized(folder, config, display)
        check_same(folder, config)
        for place in (output, *output.glob("blocks/*")):
            remove_unfinished(place)
        marks: dict[str, str] = {}

        def look(scene: "Scene") -> None:
            for note in scene.notes:
                display.say(f"note: {note}")
            said = useless_masks(scene)
            if said:
                display.say(said)
            marks.update(image_hashes(scene))
            if folder.exists and not others:
                check_images(output, scene, marks)

        if config.blocks.cuts:
            scene, plan = plan_scene(config, folder.saved_facts())
            if len(plan.cells) > 1:
                look(scene)
                save_image_hashes(output, marks)
                train_blocks(config, method, folder, scene, plan, display, start)
                _say_outcome(folder, config, scene, display, time.perf_counter() - start)
                return output
        prepared = prepare.prepare(config, _told_features(config, display), look, folder.saved_facts())
        folder.root.mkdir(parents=True, exist_ok=True)
        folder.save_config(replace(config, output=None), method)  # the folder may be moved
        save_image_hashes(output, marks)
        folder.save_known(prepared.scene, config.data, prepared.facts)
        if prepared.basis is not None:
            folder.save_tensors("basis", prepared.basis.tensors())
        display.say(_described(prepared))
        device = prepare.device_of(config.device)
        log, forecast = EventLog(folder), Forecast(config, method, device.type)

        def report(event: "Report") -> None:
            display.training(event)
            log(event)
            if line := forecast(event):
                display.say(line)

        def train(model: "Model | None") -> "Model":
            return trainer.train(config, prepared, folder, report, spent=spent, model=model)

        spent = time.perf_counter() - start
        folder.log({"part": "preparing", "seconds": round(spent, 3)})
        model = config.executor.on(device.type).build().map(train, [None])[0]
        trained = time.perf_counter()
        folder.log({"part": "training", "seconds": round(trained - start - spent, 3)})
        display.say("measuring the scene's own style")
        style = style_pass.measure_style(config, model, prepared.scene.cameras, prepared.scene.train)
        folder.save_tensors("style", to_tensors(style))
        folder.log({"part": "own style", "seconds": round(time.perf_counter() - trained, 3)})
        _say_outcome(folder, config, prepared.scene, display, time.perf_counter() - start)
    return output


def _described(prepared: "Prepared") -> str:
    scene, facts = prepared.scene, prepared.facts
    width, height = scene.cameras.size[0].tolist()
    semantics = f", {facts.dim} semantic" if facts.dim else ", no semantic"
    light = ", tones" if facts.exposure else ""
    return (
        f"{scene.name}: {len(scene.train)} + {len(scene.test)} views of {width}x{height}, space {facts.space.kind}, "
        f"{facts.channels} content{semantics} channels{light}"
    )


def _check_needs(config: "TrainConfig", method: str, display: "Display") -> None:
    """Raise UsageError where something is missing that nothing downloads, after showing all that is missing."""
    from ..training.prepare import plugin_needs, scene_needs

    if config.data is not None and all(need.downloaded for need in plugin_needs(config)):
        return  # where the scene cannot be read its parser says so
    needs = [*scene_needs(config), *config.verbs().needs()]
    if len(needs) > 1:
        for need in needs:
            display.say(f"missing: {need.what}: {need.remedy}")
        raise UsageError(f"fprf train {method}: {len(needs)} things are missing; `fprf doctor {method}` looks again")
    raise UsageError(f"fprf train {method}: {needs[0].what}: {needs[0].remedy}")


def _sized(folder: "Run", config: "TrainConfig", display: "Display") -> "TrainConfig":
    """The config with the size of its images, which an existing run has decided already."""
    from ..training.prepare import scene_of, with_downscale

    if config.downscale is not None:
        if config.downscale > 1 and not folder.exists:
            width, height = scene_of(config).cameras.size[0].tolist()
            if min(width, height) < _SMALL:
                display.say(
                    f"warning: {width}x{height} pixels are few: --downscale {config.downscale} counts from the images as they "
                    "are delivered, also in a folder images_N; leave it out"
                )
        return config
    old = folder.load_config()[0].downscale if folder.exists else None
    if old is not None:
        return replace(config, downscale=old)
    config = with_downscale(config)
    if config.downscale != 1:
        width, height = scene_of(config).cameras.size[0].tolist()
        display.say(
            f"images are reduced to 1/{config.downscale}, {width}x{height}, for this device and time: --downscale 1 keeps them"
        )
    return config


def _told_features(config: "TrainConfig", display: "Display") -> "Callable[[int, int, str], None]":
    """Progress of the feature store, with a line where it will take most of a time limit."""
    begun: dict[str, float] = {}

    def progress(done: int, total: int, what: str) -> None:
        display.count(done, total, what)
        now = time.perf_counter()
        seconds = (now - begun.setdefault(what, now)) / max(done, 1) * total
        if done == _TIMED_VIEWS and config.minutes is not None and seconds > 30 * config.minutes:
            display.say(
                f"warning: {what} will take {seconds:.0f} s of the {60 * config.minutes:.0f} s of --minutes; "
                f"--downscale {2 * (config.downscale or 1)} and another --output take a quarter"
            )

    return progress


def _say_outcome(folder: "Run", config: "TrainConfig", scene: "Scene", display: "Display", seconds: float) -> None:
    """Say the quality that training reached and the next command."""
    from ..training.prepare import outcome

    quoted = shlex.quote(str(folder.root))
    reached = outcome(folder.root, config, scene)
    short = reached is not None and reached.too_short
    if reached is not None:
        display.say(reached.told(folder.root, config))
    ended = "ended" if short else "done"
    display.say(f"{ended} after {seconds:.0f} s: fprf stylize {quoted} --references PHOTO.jpg, fprf eval {quoted}")


def check_same(folder: "Run", config: "RunConfig") -> None:
    """A run goes on with its own config; only how long, how often saved and where may change.

    Blocks may be cut anew: those that the cut does not concern are kept.
    """
    if not folder.exists:
        return
    from ..config import RESUMABLE
    from ..plugins.typed_json import leaves
    from ..training.blocks import FREE

    old, _ = folder.load_config()
    cut = [getattr(each, "blocks", None) for each in (old, config)]
    free = (*(FREE if all(blocks is not None and blocks.cuts for blocks in cut) else RESUMABLE), *config.untrained)
    mine, theirs = leaves(config), leaves(old)
    changed = [path for path in theirs | mine if path.partition(".")[0] not in free and mine.get(path) != theirs.get(path)]
    if changed:
        shown = [f"{name} {theirs.get(name, '-')} ({mine.get(name, '-')} is asked)" for name in changed[:_SHOWN]]
        more = f" and {len(changed) - _SHOWN} others" if len(changed) > _SHOWN else ""
        other = next(path for k in range(2, 1000) if not (path := folder.root.with_name(f"{folder.root.name}-{k}")).exists())
        raise UsageError(
            f"{folder.root}: holds a run with {', '.join(shown)}{more}; go on with it by its own values, or begin another with "
            f"--output {shlex.quote(str(other))}"
        )


def _usage() -> str:
    lines = ["usage: fprf train [METHOD|CONFIG.json] --data DIR [any field]", ""]
    lines += [f"methods ({DEFAULT_METHOD} where none is named):"]
    listed = list(methods())
    width = max(len(name) for name, _ in listed)
    lines += [f"  {name:<{width}}  {about}" for name, about in listed]
    lines += ["", "`fprf train METHOD --help` lists every field; a saved config.json goes on with its run."]
    return "\n".join(lines)
