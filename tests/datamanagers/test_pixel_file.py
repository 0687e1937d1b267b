"""Pixels of many images lie in a file that nobody sees."""

import errno
import os
from pathlib import Path

import pytest
import torch

from fprf.datamanagers import batches as pixel_file
from fprf.datamanagers.batches import room_for
from fprf.errors import DataError


@pytest.mark.parametrize("held", [0, 10**9])
def test_what_is_written_is_read(tmp_path: Path, held: int) -> None:
    pixels = room_for(1000, tmp_path / "cache", held)
    assert pixels.shape == (1000, 3) and pixels.dtype == torch.uint8
    given = torch.randint(256, (1000, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    pixels[:] = given
    at = torch.tensor([999, 0, 5, 5])
    assert torch.equal(pixels[at], given[at])


def test_the_file_has_no_name(tmp_path: Path) -> None:
    pixels = room_for(5000, tmp_path, held=0)
    assert not list(tmp_path.iterdir())
    maps = Path("/proc/self/maps")
    if maps.is_file():
        assert str(tmp_path) in maps.read_text()
    del pixels


def test_a_full_disk_is_told_before_anything_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(file: int, offset: int, size: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(pixel_file.os, "posix_fallocate", full, raising=False)
    with pytest.raises(DataError, match="No space left"):
        room_for(1000, tmp_path, held=0)
