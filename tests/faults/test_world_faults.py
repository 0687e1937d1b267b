"""Faults 1, 12, 14 and 17: kills, images that are gone, signals from outside, places and names of all kinds."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import pytest
import torch
from tiny_world import World, flags, parameters

from fprf.cli import main as cli
from fprf.training import checkpoint
from fprf.training.run import Run


@pytest.mark.fault
def test_kills_at_random_moments_leave_the_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a process of its own: threads of this one would not survive a fork."""
    words = ["-m", "benchmarks", "kills", "--kills", "5", "--steps", "25", "--output", str(tmp_path / "kills.json")]
    here, environment = Path(__file__).parents[2], os.environ | {"TMPDIR": str(tmp_path)}
    subprocess.run([sys.executable, *words], check=True, cwd=here, timeout=280, env=environment, capture_output=True)
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
    words = [sys.executable, "-m", "fprf", "train", "fprf-lite", *flags(world, tmp_path / "run"), "--steps", "100000"]
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
    """A folder of spaces, other scripts and 200 letters; the C locale, another time zone, no HOME, no terminal."""
    place = tmp_path / "with space" / "ünïcode 場面 'quotes'" / ("x" * 200)
    place.mkdir(parents=True)
    shutil.copytree(world.town, place / "town")
    args = [*flags(world, place / "run"), "--data", str(place / "town")]
    environment = {k: v for k, v in os.environ.items() if k not in ("HOME", "LANG", "TERM")}
    environment |= {"LC_ALL": "C", "TZ": "Pacific/Kiritimati", "PYTHONUTF8": "0", "XDG_CACHE_HOME": str(place / "cache")}
    done = subprocess.run([sys.executable, "-m", "fprf", "train", "fprf-lite", *args], env=environment, capture_output=True)
    assert done.returncode == 0, done.stderr.decode(errors="replace")
    here, there = parameters(Run(place / "run"), 15), parameters(Run(world.run), 15)
    assert all(torch.equal(here[name], there[name]) for name in there)
