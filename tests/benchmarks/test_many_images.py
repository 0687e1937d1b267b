import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor

from benchmarks import many_images
from fprf.datamanagers import batches


def test_only_one_of_the_variants_holds_all_pixels_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if not Path("/proc/self/status").is_file():
        pytest.skip("no /proc here")
    limits = []

    def allocate(pixels: int, folder: Path, held: int = 0) -> Tensor:
        limits.append(held)
        return torch.empty(pixels, 3, dtype=torch.uint8)

    monkeypatch.setattr(batches, "allocate_pixels", allocate)
    monkeypatch.setattr(many_images.resource, "setrlimit", lambda *_: None)
    many_images.write_scene(tmp_path, 9, (16, 12))
    for held in (False, True):
        many_images.part(tmp_path, tmp_path / "cache", 1024, 1, held)
    assert limits == [0, sys.maxsize]
