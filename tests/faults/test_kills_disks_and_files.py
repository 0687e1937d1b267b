"""Faults 1 to 4, 6, 7, 12, 14 and 17: kills, a save that dies anywhere, full disks and folders that cannot be
written to, files gone bad, images that are gone, signals from outside, places and names of all kinds.
"""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import pytest
import safetensors.torch
import torch
from tiny_world import World, after_one_step, flags, parameters, save_checkpoint

from fprf.cli import main as cli
from fprf.errors import CheckpointError, DataError
from fprf.io.video import write_video
from fprf.training import checkpoint
from fprf.training.locks import lock_folder
from fprf.training.model import Model
from fprf.training.run import Run

Trainer = tuple[Model, torch.optim.Optimizer]

DEAD = 73


def forked(work: Callable[[], object]) -> int:
    """The exit code of a process that did the work: 0 done, 1 an exception."""
    process = os.fork()
    if process == 0:
        code = 1
        try:
            work()
            code = 0
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def deadly(function: Callable[..., object], calls: Iterator[int], at: int) -> Callable[..., object]:
    """Ends the process before the `at`-th of all calls, as a kill would: nothing is cleaned up."""

    def call(*args: object, **named: object) -> object:
        if next(calls) == at:
            os._exit(DEAD)
        return function(*args, **named)

    return call


@pytest.fixture
def trainer(world: World) -> Trainer:
    return after_one_step(world)


@pytest.fixture
def root(trainer: Trainer, tmp_path: Path) -> Path:
    """Checkpoints of steps 5 and 9, a number of the model telling which."""
    model, optimizer = trainer
    for step in (5, 9):
        mark(model, step)
        save_checkpoint(tmp_path / "c", model, optimizer, step=step, seconds=step / 2)
    return tmp_path / "c"


def mark(model: Model, step: int) -> None:
    with torch.no_grad():
        model.learned()[0].view(-1)[0] = step


def marked(root: Path, model: Model) -> tuple[int, float]:
    saved, damaged = checkpoint.load_latest(root)
    assert saved is not None and not damaged
    checkpoint.restore(saved.state, model, None)
    return saved.step, float(model.learned()[0].detach().view(-1)[0])


def test_a_save_that_dies_at_any_call_leaves_the_old_or_the_new(
    root: Path, trainer: Trainer, monkeypatch
) -> None:
    """Every call to the system that Python makes for it, in turn; what was left is tidied and the next save
    works.
    """
    model, optimizer = trainer
    seen = []
    for at in range(500):
        mark(model, 12)

        def save(at: int = at) -> None:
            calls = count()
            for name in ("open", "fsync", "replace", "unlink", "rmdir", "mkdir", "close"):
                monkeypatch.setattr(os, name, deadly(getattr(os, name), calls, at))
            save_checkpoint(root, model, optimizer, step=12, seconds=6.0)

        code = forked(save)
        found = marked(root, model)
        assert found in ((9, 9.0), (12, 12.0)), (at, found)
        checkpoint.tidy(root)
        assert marked(root, model) == found and 1 <= len(checkpoint.steps(root)) <= 3
        assert {p.name for p in root.iterdir()} == {f"step-{step:07d}" for step in checkpoint.steps(root)}
        assert not list(root.rglob(".*"))
        seen.append(found[0])
        if code == 0:
            break
        assert code == DEAD
        shutil.rmtree(root)
        for step in (5, 9):
            mark(model, step)
            save_checkpoint(root, model, optimizer, step=step, seconds=step / 2)
    assert code == 0 and checkpoint.steps(root) == [9, 12]
    assert seen == sorted(seen) and seen.count(9) > 8 and seen.count(12) > 2, (
        "kills before and after the manifest"
    )


def test_a_file_that_the_system_cuts_off_is_one_line_and_costs_nothing(
    root: Path, trainer: Trainer, tmp_path: Path
) -> None:
    """As on a full disk, by a limit to the size of files: safetensors' own writes fail."""
    model, optimizer = trainer

    def save() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
        try:
            save_checkpoint(root, model, optimizer, step=12, seconds=6.0)
        except DataError as error:
            os.write(handle, str(error).encode())

    told = tmp_path / "told"
    handle = os.open(told, os.O_WRONLY | os.O_CREAT)
    assert forked(save) == 0
    os.close(handle)
    line = told.read_text()
    assert (
        "model.safetensors: cannot be written (" in line and "KiB are needed, " in line and "\n" not in line
    )
    assert checkpoint.steps(root) == [5, 9] and marked(root, model) == (9, 9.0)
    assert sorted(p.name for p in root.iterdir()) == ["step-0000005", "step-0000009"]


def test_a_film_that_the_system_cuts_off_is_no_film(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (60, 64, 64, 3), np.uint8)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        with pytest.raises(DataError, match="0 of 60 frames"):
            write_video(tmp_path / "x.mp4", noise, 24, h264=False)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_to_is_told_before_any_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fprf.training.field_setup.prepare", None)
    place = Path("/proc/fprf-run")
    if not place.parent.is_dir():
        pytest.skip("no folder that refuses everybody")
    with pytest.raises(DataError, match="cannot be written"), lock_folder(place):
        pass


def test_every_tensor_byte_and_every_cut_is_found(world: World, tmp_path: Path) -> None:
    shutil.copytree(world.run / "checkpoints", tmp_path / "c")
    (step,) = checkpoint.steps(tmp_path / "c")
    for name in ("model.safetensors", "optimizer.safetensors", "manifest.json"):
        path = tmp_path / "c" / f"step-{step:07d}" / name
        raw = path.read_bytes()
        start = 8 + int.from_bytes(raw[:8], "little") if name != "manifest.json" else len(raw)
        for part in range(50):
            at = start + part * (len(raw) - start) // 50
            if at < len(raw):
                path.write_bytes(raw[:at] + bytes([raw[at] ^ 16]) + raw[at + 1 :])
                with pytest.raises(CheckpointError, match="is damaged"):
                    checkpoint.load(tmp_path / "c", step)
            path.write_bytes(raw[: part * len(raw) // 50])
            with pytest.raises(CheckpointError, match=r"step-0000015"):
                checkpoint.load(tmp_path / "c", step)
        path.write_bytes(raw)
    assert checkpoint.load(tmp_path / "c", step).step == step


def test_swapped_files_are_found(root: Path, trainer: Trainer) -> None:
    for name in ("model.safetensors", "manifest.json"):
        path, other = (root / f"step-{step:07d}" / name for step in (9, 5))
        raw = path.read_bytes()
        shutil.copy(other, path)
        saved, damaged = checkpoint.load_latest(root)
        assert saved is not None and saved.step == 5 and len(damaged) == 1
        path.write_bytes(raw)
    assert marked(root, trainer[0]) == (9, 9.0)


@pytest.mark.parametrize("file", ["model", "optimizer"])
def test_numbers_that_are_not_finite_are_refused_at_load(root: Path, file: str) -> None:
    """Fault 7: whoever wrote them, and with whatever checksums."""
    folder = root / "step-0000009"
    tensors = safetensors.torch.load_file(folder / f"{file}.safetensors")
    name = next(n for n, t in tensors.items() if t.is_floating_point() and t.ndim)
    tensors = {n: t.clone() for n, t in tensors.items()}
    tensors[name].view(-1)[-1] = float("nan")
    safetensors.torch.save_file(tensors, folder / f"{file}.safetensors")
    saved, damaged = checkpoint.load_latest(root)
    assert saved is not None and saved.step == 5 and f"{file}.safetensors: tensor {name}" in damaged[0]


MOUNTED = """
import os, subprocess, sys
from pathlib import Path
sys.path.insert(0, sys.argv[4])
folder, town = Path(sys.argv[1]), Path(sys.argv[2])
subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={sys.argv[3]}", "none", str(folder)], check=True)
if sys.argv[3] == "8m":
    subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True)
from benchmarks.kills import tiny
from dataclasses import replace
from fprf.cli import main as cli
from fprf.config_files import save_config
config = Path(sys.argv[2]).parent / "config.json"
save_config(config, replace(tiny(town, 40), output=folder / "run"), "fprf-lite")
code = cli.main(["train", str(config)])
left = sorted(str(p.relative_to(folder)) for p in folder.rglob("*"))
print(code, left)
from fprf.training import checkpoint
print("latest", checkpoint.load_latest(folder / "run" / "checkpoints")[0] is not None)
"""


@pytest.mark.fault
@pytest.mark.parametrize(
    ("size", "reason"), [("300k", "No space left on device"), ("8m", "Read-only file system")]
)
def test_a_disk_that_is_full_or_read_only(world: World, tmp_path: Path, size: str, reason: str) -> None:
    """A real one, in a name space of its own: 300 KiB hold a checkpoint and no more; 8 MiB are mounted
    read-only.
    """
    if subprocess.run(["unshare", "-m", "true"], capture_output=True).returncode:
        pytest.skip("may not mount here")
    (tmp_path / "disk").mkdir()
    shutil.copytree(world.town, tmp_path / "town")
    project = Path(__file__).parents[2]
    words = [
        sys.executable,
        "-c",
        MOUNTED,
        str(tmp_path / "disk"),
        str(tmp_path / "town"),
        size,
        str(project),
    ]
    done = subprocess.run(["unshare", "-m", *words], capture_output=True, text=True, timeout=240)
    errors = [line for line in done.stderr.splitlines() if not line.startswith("{")]
    assert (
        len(errors) == 1 and errors[0].startswith("error: ") and f"cannot be written ({reason}" in errors[0]
    ), done.stderr
    assert done.stdout.startswith("2 ")
    if size == "8m":
        assert "2 []" in done.stdout and "checkpoint" not in errors[0], "before any work"
    else:
        assert "KiB are free" in errors[0] and "latest True" in done.stdout


@pytest.mark.fault
def test_kills_at_random_moments_leave_the_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a process of its own: threads of this one would not survive a fork."""
    words = [
        "-m",
        "benchmarks",
        "kills",
        "--kills",
        "5",
        "--steps",
        "25",
        "--output",
        str(tmp_path / "kills.json"),
    ]
    here = Path(__file__).parents[2]
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    subprocess.run(
        [sys.executable, *words], check=True, cwd=here, timeout=280, env=environment, capture_output=True
    )
    found = json.loads((tmp_path / "kills.json").read_text())
    assert found["kills"] >= 5 and found["bitwise_equal"] == found["runs"] > 0
    assert not found["unfinished_files_left"] and not found["other_failures"]


@pytest.mark.parametrize("harm", ["gone", "empty", "cut", "text", "rotated"])
def test_an_image_that_is_gone_or_changed_is_named(
    world: World, tmp_path: Path, harm: str, capsys: pytest.CaptureFixture[str]
) -> None:
    town = shutil.copytree(world.town, tmp_path / "town")
    image = sorted((town / "images").iterdir())[3]
    raw = image.read_bytes()
    if harm == "gone":
        image.unlink()
    elif harm == "rotated":
        image.write_bytes(cv2.imencode(".png", cv2.imread(str(image)).swapaxes(0, 1))[1].tobytes())
    else:
        image.write_bytes({"empty": b"", "cut": raw[: len(raw) // 2], "text": b"not an image"}[harm])
    args = [*flags(world, tmp_path / "run"), "--data", str(town)]
    assert cli.main(["train", "fprf-lite", *args]) == 2
    (error,) = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("{")]
    assert error.startswith("error: ") and image.name in error
    assert not checkpoint.steps(tmp_path / "run" / "checkpoints")


def test_an_image_that_is_another_at_the_second_start_is_named(
    world: World, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    town = shutil.copytree(world.town, tmp_path / "town")
    images = sorted((town / "images").iterdir())
    images[3].write_bytes(images[4].read_bytes())  # of the same shape
    args = ["train", str(run / "config.json"), "--data", str(town), "--steps", "16"]
    assert cli.main(args) == 2
    (error,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert f"{images[3]} is another" in error and "--changed-images" in error
    assert checkpoint.steps(run / "checkpoints")[-1] == 15
    assert cli.main([*args, "--changed-images"]) == 0
    assert checkpoint.steps(run / "checkpoints")[-1] == 16


@pytest.mark.fault
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_from_outside_saves_and_ends_with_130(world: World, tmp_path: Path, number: int) -> None:
    words = [
        sys.executable,
        "-m",
        "fprf",
        "train",
        "fprf-lite",
        *flags(world, tmp_path / "run"),
        "--steps",
        "100000",
    ]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        end = time.monotonic() + 200
        events = tmp_path / "run" / "events.jsonl"
        while not (events.exists() and '"psnr"' in events.read_text()) and time.monotonic() < end:
            time.sleep(0.2)
        time.sleep(2)
        process.send_signal(number)
        _, error = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130 and error.endswith("interrupted\n")
    (step,) = checkpoint.steps(tmp_path / "run" / "checkpoints")
    assert step > 0 and checkpoint.load(tmp_path / "run" / "checkpoints", step).step == step


@pytest.mark.fault
def test_places_names_clocks_and_languages_of_all_kinds(world: World, tmp_path: Path) -> None:
    """A folder of spaces, other scripts and 200 letters; the C locale, another time zone, no HOME, no
    terminal.
    """
    place = tmp_path / "with space" / "ünïcode 場面 'quotes'" / ("x" * 200)
    place.mkdir(parents=True)
    shutil.copytree(world.town, place / "town")
    args = [*flags(world, place / "run"), "--data", str(place / "town")]
    environment = {k: v for k, v in os.environ.items() if k not in ("HOME", "LANG", "TERM")}
    environment |= {
        "LC_ALL": "C",
        "TZ": "Pacific/Kiritimati",
        "PYTHONUTF8": "0",
        "XDG_CACHE_HOME": str(place / "cache"),
    }
    done = subprocess.run(
        [sys.executable, "-m", "fprf", "train", "fprf-lite", *args], env=environment, capture_output=True
    )
    assert done.returncode == 0, done.stderr.decode(errors="replace")
    here = parameters(Run(place / "run"), 15)
    there = parameters(Run(world.run), 15)
    assert all(torch.equal(here[name], there[name]) for name in there)
