import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fprf.errors import DataError
from fprf.training.run import LOCK, held

HOLDER = "import sys, time; from pathlib import Path; from fprf.training.run import held\n"
HOLDER += "with held(Path(sys.argv[1])):\n    print('held', flush=True)\n    time.sleep(60)"


def holder(folder: Path) -> subprocess.Popen[str]:
    process = subprocess.Popen([sys.executable, "-c", HOLDER, str(folder)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    return process


def test_a_second_process_is_told_who_is_there_until_that_is_killed(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    process = holder(folder)
    try:
        with pytest.raises(DataError, match=rf"run: process {process.pid} on .+ is training here; wait") as told, held(folder):
            pytest.fail("two hold it")
        assert "\n" not in str(told.value)
    finally:
        process.send_signal(signal.SIGKILL)
        process.communicate()
    assert (folder / LOCK).exists()
    with held(folder):
        assert str(os.getpid()) in (folder / LOCK).read_text()
    assert not (folder / LOCK).exists()


def test_the_same_process_cannot_hold_it_twice(tmp_path: Path) -> None:
    with held(tmp_path):
        with pytest.raises(DataError, match=f"process {os.getpid()}"), held(tmp_path):
            pass
        assert (tmp_path / LOCK).exists(), "the refused one leaves the holder's file"
    with held(tmp_path):
        pass


def test_an_empty_folder_is_not_left_behind_and_a_full_one_is(tmp_path: Path) -> None:
    with held(tmp_path / "a" / "b"):
        pass
    assert not (tmp_path / "a" / "b").exists()
    with pytest.raises(ValueError, match="x"), held(tmp_path / "c"):
        (tmp_path / "c" / "file").touch()
        raise ValueError("x")
    assert [p.name for p in (tmp_path / "c").iterdir()] == ["file"]


def test_a_file_in_its_place_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "run"):
        with pytest.raises(DataError, match="file"), held(folder):
            pass


def test_a_note_of_nonsense_is_not_repeated(tmp_path: Path) -> None:
    with held(tmp_path):
        (tmp_path / LOCK).write_bytes(b"\x1b[31m\n\xff" * 9)
        with pytest.raises(DataError, match="another process is training here"), held(tmp_path):
            pass


def _count(folder: Path, rounds: int) -> None:
    """Add to a number that only one may touch at a time."""
    done = 0
    while done < rounds:
        try:
            with held(folder):
                counter = folder / "counter"
                value = int(counter.read_text())
                time.sleep(0.001)
                counter.write_text(str(value + 1))
                done += 1
        except DataError:
            time.sleep(0.0005)


def test_never_two_at_a_time(tmp_path: Path) -> None:
    (tmp_path / "counter").write_text("0")
    workers = [multiprocessing.get_context("fork").Process(target=_count, args=(tmp_path, 15)) for _ in range(3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(60)
    assert (tmp_path / "counter").read_text() == "45"
