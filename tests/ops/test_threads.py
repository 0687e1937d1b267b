"""The cache of compiled kernels."""

import importlib
import sys
from pathlib import Path

import pytest

from fprf.ops import threads

KERNEL = """
VALUE = 0.0


def scaled(x):
    return VALUE * x
"""


def test_kernels_are_compiled_anew_when_another_file_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A constant of another file is compiled in: under the same sources what is kept is taken."""
    monkeypatch.setattr(threads.numba.config, "CACHE_DIR", "")
    path = tmp_path / "kernel_of_a_test.py"
    found = []
    path.write_text(KERNEL)
    monkeypatch.syspath_prepend(tmp_path)
    module = importlib.import_module(path.stem)
    for module.VALUE, text in ((2.0, "before"), (3.0, "before"), (3.0, "after")):
        monkeypatch.setattr(threads, "sources", lambda text=text: text)
        found.append(threads.cached_jit()(module.scaled)(1.0))
    del sys.modules[path.stem]
    assert found == [2.0, 2.0, 3.0] and list((tmp_path / "__pycache__").glob("*.nbi"))


def test_sources_are_the_files_without_torch(tmp_path: Path) -> None:
    hashes = []
    for text in ("A = 1", "A = 2", "\nimport torch", ""):
        (tmp_path / "kernel.py").write_text(text)
        hashes.append(threads.sources.__wrapped__(tmp_path))
    assert len(set(hashes)) == 3 and hashes[2] == hashes[3]
