"""`fprf train METHOD|CONFIG.json`: train a scene, or go on where a run stopped."""

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import UsageError
from .beside import VIEW, linger, open_view, take_view
from .blocks import show_plan, train_blocks
from .event_log import EventLog
from .parsing import LIST_FLAGS, load_method, methods, parse

if TYPE_CHECKING:
    from ..config import TrainConfig
    from ..datamanagers.scene import Scene
    from ..engine.model import Model
    from ..engine.prepare import Prepared
    from ..engine.run import Run
    from ..engine.trainer import Report
    from ..viewer.aside import Aside

__all__ = ["default_output", "run", "train_scene"]

PLAN = "--plan"
CHANGED = "--changed-images"


def run(args: list[str]) -> int:
    """Parse, prepare, train, measure the scene's style."""
    if not args or args[0] in ("-h", "--help"):
        print(_usage())
        return 0 if args else 2
    if args[0].startswith("-"):
        raise UsageError(f"fprf train {args[0]}: the method comes first, for example `fprf train fprf-lite {args[0]} ...`")
    config, method = load_method(args[0])
    source = Path(args[0])
    if source.suffix == ".json" and config.output is None:
        config = replace(config, output=source.parent)
    rest, place = take_view(args[1:])
    others = CHANGED in rest
    rest = [arg for arg in rest if arg != CHANGED]
    flags = [arg for arg in rest if arg != PLAN]
    if LIST_FLAGS in flags:
        print(f"{PLAN}\n{VIEW}\n{CHANGED}")
    about = (
        f"Train a scene with {method}. {PLAN} alone shows its blocks and what they will cost, and runs nothing;\n"
        f"{VIEW} [[HOST:]PORT] shows training live in the browser, at http://127.0.0.1:8080 if nothing is said;\n"
        f"{CHANGED} goes on with a run although its images are no longer those that it was begun with."
    )
    config = parse(config, flags, prog=f"fprf train {args[0]}", description=about)
    if len(flags) < len(rest):
        show_plan(config, method, config.output or default_output(config, method))
    elif place is None:
        train_scene(config, method, others=others)
    else:
        with open_view(place) as view:
            train_scene(config, method, view=view, others=others)
    return 0


def default_output(config: "TrainConfig", method: str) -> Path:
    """runs/SCENE-METHOD."""
    return Path("runs") / f"{config.data.resolve().name or 'scene'}-{method}"


def train_scene(
    config: "TrainConfig", method: str, *, quiet: bool = False, view: "Aside | None" = None, others: bool = False
) -> Path:
    """Train to the end and return the run folder. An existing run there is resumed if its config and its images fit;
    with `others` the images may have changed.

    `view` shows how it goes; where there is a terminal, and somebody looks at the end, it stays until they leave.

    Raises DataError where another process is training there.
    """
    from ..engine import originals, prepare, style_pass, trainer
    from ..engine.lay_out import plan_scene
    from ..engine.lock import held
    from ..engine.model import build_model
    from ..engine.run import Run
    from ..output.atomic import remove_unfinished
    from ..style.scene import to_tensors
    from .progress import Display

    start = time.perf_counter()
    output = config.output or default_output(config, method)
    config = replace(config, output=output)
    folder = Run(output)
    with held(output), Display(quiet=quiet) as display:
        display.say(f"{method} on {config.data}, run folder {output}")
        if view is not None:
            display.say(f"live at {view.address}")
        _check_same(folder, config)
        for place in (output, *output.glob("blocks/*")):
            remove_unfinished(place)
        marks: dict[str, str] = {}

        def look(scene: "Scene") -> None:
            marks.update(originals.fingerprints(scene))
            if folder.exists and not others:
                originals.refuse_others(output, scene, marks)

        if config.blocks.cuts:
            scene, plan = plan_scene(config)
            if plan.cut:
                look(scene)
                originals.keep(output, marks)
                train_blocks(config, method, folder, scene, plan, display, start, view)
                display.say(f"done after {time.perf_counter() - start:.0f} s: fprf eval {output}")
                linger(view, display)
                return output
        prepared = prepare.prepare(config, display.features, look)
        folder.root.mkdir(parents=True, exist_ok=True)
        folder.save_config(replace(config, output=None), method)  # the folder may be moved
        originals.keep(output, marks)
        folder.save_known(prepared.scene, config.data, prepared.facts)
        if prepared.basis is not None:
            folder.save_tensors("basis", prepared.basis.tensors())
        display.say(_described(prepared))
        log = EventLog(folder)

        def report(event: "Report") -> None:
            display.training(event)
            log(event)
            if view is not None:
                view(event)

        def train(model: "Model | None") -> "Model":
            return trainer.train(config, prepared, folder, report, spent=spent, model=model)

        spent = time.perf_counter() - start
        folder.log({"part": "preparing", "seconds": round(spent, 3)})
        if view is None:
            model = config.executor.on(prepare.device_of(config.device).type).build().map(train, [None])[0]
        else:  # here, where its parameters can be looked at
            model = build_model(config, prepared.facts).to(prepare.device_of(config.device))
            view.begin(output, model, config.device)
            model = train(model)
        trained = time.perf_counter()
        folder.log({"part": "training", "seconds": round(trained - start - spent, 3)})
        display.say("measuring the scene's own style")
        style = style_pass.measure_style(config, model, prepared.scene.cameras, prepared.scene.train)
        folder.save_tensors("style", to_tensors(style))
        folder.log({"part": "own style", "seconds": round(time.perf_counter() - trained, 3)})
        display.say(f"done after {time.perf_counter() - start:.0f} s: fprf eval {output}")
    linger(view, display)
    return output


def _described(prepared: "Prepared") -> str:
    scene, facts = prepared.scene, prepared.facts
    width, height = (int(v) for v in scene.cameras.size[0])
    semantics = f", {facts.dim} semantic" if facts.dim else ", no semantic"
    return (
        f"{scene.name}: {len(scene.train)} + {len(scene.test)} views of {width}x{height}, space {facts.space.kind}, "
        f"{facts.channels} content{semantics} channels"
    )


def _check_same(folder: "Run", config: "TrainConfig") -> None:
    """A run goes on with its own config; only how long, how often saved and where may change.

    Blocks may be cut anew: those that the cut does not concern are kept.
    """
    if not folder.exists:
        return
    from ..config import RESUMABLE
    from ..engine.lay_out import FREE

    old, _ = folder.load_config()
    free = FREE if old.blocks.cuts and config.blocks.cuts else RESUMABLE
    mine, theirs = vars(old), vars(config)  # another method may have other fields
    changed = [name for name in mine | theirs if name not in free and mine.get(name) != theirs.get(name)]
    if changed:
        raise UsageError(
            f"{folder.root}: holds a run with another {', '.join(changed)}; resume it with "
            f"`fprf train {folder.root / 'config.json'}`, or choose another --output"
        )


def _usage() -> str:
    lines = ["usage: fprf train METHOD|CONFIG.json [--data DIR] [any field]", "", "methods:"]
    listed = list(methods())
    width = max(len(name) for name, _ in listed)
    lines += [f"  {name:<{width}}  {about}" for name, about in listed]
    lines += ["", "`fprf train METHOD --help` lists every field; a saved config.json goes on with its run."]
    return "\n".join(lines)
