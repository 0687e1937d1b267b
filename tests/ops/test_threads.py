"""The cache of compiled kernels."""

from pathlib import Path

import pytest

from fprf.ops import threads

KERNEL = """
def scaled(x):
    return VALUE * x
"""


def test_kernels_are_compiled_anew_when_another_file_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A constant of another file is compiled in: under the same sources what is kept is taken."""
    path, found = tmp_path / "kernel.py", []
    path.write_text(KERNEL)
    for value, sources in ((2.0, "before"), (3.0, "before"), (3.0, "after")):
        monkeypatch.setattr(threads, "sources", lambda sources=sources: sources)
        names = {"VALUE": value, "__name__": "kernel"}
        exec(compile(KERNEL, str(path), "exec"), names)
        found.append(threads.cached_jit()(names["scaled"])(1.0))
    assert found == [2.0, 2.0, 3.0] and list((tmp_path / "__pycache__").glob("*.nbi"))
    monkeypatch.undo()
    hashes = []
    for text in ("A = 1", "A = 2", "\nimport torch", ""):
        path.write_text(text)
        hashes.append(threads.sources.__wrapped__(tmp_path))
    assert len(set(hashes)) == 3 and hashes[2] == hashes[3], "kernels don't read files with torch"
