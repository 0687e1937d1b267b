"""Parts of a scene as tasks: blocks of fields and cells of Gaussians, each killed, moved or trained again
without the others.

The whole scene is trained first, coarsely; each part goes on from there, on any machine, in any order.

    RUN/blocks.json, cells.json              the partition (see `blocks.partition`)
    RUN/blocks/surroundings, overview        the whole scene
    RUN/blocks/NN, cells/NN                  a part:
        task.json                            digest of all that decides what it learns; another one starts it anew
        checkpoints/, events.jsonl           as of any run
        done.json                            that it is finished, and what it was trained as
"""

import hashlib
import json
import os
import shutil
import time
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any

from ..datamanagers.scene import ParsedScene
from ..errors import CheckpointError
from ..interfaces import Executor, Learner
from ..io.atomic import write_json
from ..io.strict_json import open_json
from ..plugins.codec import from_json, to_json
from ..progress import Display, Report
from ..run_config import RunConfig
from .driver import Schedule, learn, reporter
from .locks import lock_folder
from .run import Run

WHOLE = -1
"""The number of the whole scene among the parts."""
_TASK = "task.json"
_DONE = "done.json"
_DONE_FORMAT = 1
"""Version of done.json."""
_MOVING = "moving-"
"""Begins the names of folders that change their number."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """Message to a worker; the rest lies in the run folder. Small, so that it can be sent to other
    machines.
    """

    root: str
    """Run folder."""
    data: str
    """Scene folder."""
    part: int
    """Number of the part, or WHOLE."""
    minutes: float | None
    """Its part of the time limit."""
    quiet: bool = False
    """Show nothing."""


@dataclass(frozen=True, kw_only=True)
class Done:
    """Content of done.json."""

    format: int
    asked: dict[str, Any]
    """`Part.asked` of the part when it was trained."""
    step: int = 0
    seconds: float = 0.0
    """Training time."""
    tensors: dict[str, Any] = field(default_factory=dict)
    """Manifest of what the part keeps beside its checkpoints."""


@dataclass(frozen=True, kw_only=True)
class Part(ABC):
    """A part of a scene, ready to be trained."""

    name: str
    """Name in messages."""
    folder: Path
    asked: dict[str, Any]
    """`task`, the digest of what it is trained as, and how long it is to be trained: it is finished where
    done.json says so.
    """
    schedule: Schedule

    @abstractmethod
    def build(self) -> Learner:
        """The learner of the part, at its start."""

    def keep(self, learner: Learner) -> dict[str, Any]:
        """Write what is kept of a finished part beside its checkpoints; its manifest."""
        return {}

    def is_intact(self) -> bool:
        """Return whether all files of a finished part are still there."""
        return True


def train_part(part: Part, report: Callable[[Report], None]) -> bool:
    """Train a part to its end, from its newest checkpoint; False where it was finished already.

    A folder that was trained as something else is started anew. Raises DataError where another process trains
    there.
    """
    with lock_folder(part.folder):
        # Whoever runs a task again, on whichever machine, finds out here that nothing is left to do.
        done = read_done(part.folder)
        if done is not None and done.asked == part.asked and part.is_intact():
            return False
        begin(part.folder, part.asked["task"])
        learner = part.build()
        step, seconds = learn(learner, Run(part.folder), part.schedule, report)
        document = {"format": _DONE_FORMAT, "asked": part.asked, "step": step, "seconds": seconds}
        write_json(part.folder / _DONE, document | {"tensors": part.keep(learner)})
    return True


def run_task(task: Task, open_part: Callable[[Task], Part]) -> None:
    """Train a part, here or on a worker, and show how it goes."""
    with Display(quiet=task.quiet) as display:
        part = open_part(task)
        if not train_part(part, reporter(display, Run(part.folder), part.name)):
            display.say(f"{part.name} is finished already")


def train_all(
    config: RunConfig,
    run: Run,
    executor: Executor,
    open_part: Callable[[Task], Part],
    order: Sequence[int],
    *,
    whole_share: float,
    spent: float,
    quiet: bool,
) -> None:
    """Train the whole scene, then its parts in the given order; what is finished stays.

    The whole scene may take a share of the minutes that are left of a limit when `spent` seconds are over,
    each part as much of the rest as the others.
    """
    # Tasks name folders absolutely: a worker may run elsewhere, on a disk that both see.
    begun = time.perf_counter() - spent
    folder = config.data or Path()
    # `town` is no folder
    root = str(run.root.resolve())
    data = str(folder.resolve() if folder.exists() else folder)
    for parts, share in (([WHOLE], whole_share), (order, 1 / len(order))):
        # What is left is looked at again after the whole scene: where that ended early the parts have its
        # time, too.
        minutes = None
        if config.minutes is not None:
            left = config.minutes - (time.perf_counter() - begun) / 60
            minutes = share * max(left, 0.05 * config.minutes)
        work = partial(run_task, open_part=open_part)  # which other processes can be sent
        executor.map(
            work, [Task(root=root, data=data, part=part, minutes=minutes, quiet=quiet) for part in parts]
        )


def digest_of(
    config: RunConfig,
    free: Collection[str],
    scene: ParsedScene,
    views: Sequence[int],
    parts: Mapping[str, Any],
    content: bytes = b"",
) -> str:
    """Digest of what a part is trained as: the config but for fields that are `free`, its views, and whatever
    else decides.
    """
    # Cameras as floats in full; images as checksums of their files.
    tree = to_json(config)
    assert isinstance(tree, dict)
    document = {
        "config": {name: value for name, value in tree.items() if name not in free},
        "cameras": [getattr(scene.cameras, of.name)[views].tolist() for of in fields(scene.cameras)],
    }
    digest = hashlib.sha256(
        json.dumps(document | dict(parts), sort_keys=True, default=str).encode() + content
    )
    for view in views:
        digest.update(zlib.crc32(scene.paths[view].read_bytes()).to_bytes(4, "little"))
    return digest.hexdigest()[:32]


def task_of(folder: Path) -> str | None:
    """The digest of the task that a part was begun as; None where task.json is absent or damaged, which
    counts as not begun.
    """
    try:
        with open_json(folder / _TASK, "") as document:
            return from_json(document["task"], str, path="task")
    except CheckpointError:
        return None


def begin(folder: Path, task: str) -> None:
    """Begin a part as a task, or resume it: what was trained there as another one is removed."""
    # First of all: a part that is trained further is not finished, even if this is cut short.
    (folder / _DONE).unlink(missing_ok=True)
    if task_of(folder) == task:
        return
    shutil.rmtree(folder / "checkpoints", ignore_errors=True)
    for name in (_TASK, "block.safetensors", "events.jsonl"):
        (folder / name).unlink(missing_ok=True)
    write_json(folder / _TASK, {"task": task})


def read_done(folder: Path) -> Done | None:
    """done.json; None where the part is not finished. Raises CheckpointError where it cannot be read."""
    file = folder / _DONE
    if not file.is_file():
        return None
    with open_json(file, "remove it and train again") as document:
        if document["format"] == _DONE_FORMAT:
            return from_json(document, Done, path="done")
        return None


def renumber(folder: Path, asked: Mapping[int, str]) -> None:
    """Move each part in a folder that was begun as what some number is asked for now to that number.

    One in the way that nobody asks for is removed. Where it is cut off, the next call finishes it.
    """
    tasks = {}
    for mark in sorted(folder.glob(f"*/{_TASK}")):
        tasks[mark.parent] = task_of(mark.parent)
    known = {}
    for part, task in tasks.items():
        if task is not None:
            known[part] = task
    targets = {}
    for number in asked:
        targets[number] = folder / f"{number:02d}"
    # Those that are where they belong stay; of the others each number takes the first that was begun as what
    # it is asked for.
    moves: dict[int, Path] = {}
    for number, task in asked.items():
        if known.get(targets[number]) == task:
            known.pop(targets[number])
    for number, task in asked.items():
        holder = next((part for part, was in known.items() if was == task), None)
        if holder is not None:
            known.pop(holder)
            moves[number] = holder
    # Twice, so that no folder stands in another's way.
    for number, holder in moves.items():
        os.rename(holder, folder / f"{_MOVING}{asked[number]}")
    for number in moves:
        shutil.rmtree(targets[number], ignore_errors=True)
        os.rename(folder / f"{_MOVING}{asked[number]}", targets[number])
    for left in folder.glob(f"{_MOVING}*"):
        shutil.rmtree(left)
