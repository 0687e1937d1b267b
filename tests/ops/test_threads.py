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
        monkeypatch.setattr(threads, "_sources", lambda sources=sources: sources)
        names = {"VALUE": value, "__name__": "kernel"}
        exec(compile(KERNEL, str(path), "exec"), names)
        found.append(threads.cached_jit()(names["scaled"])(1.0))
    assert found == [2.0, 2.0, 3.0] and list((tmp_path / "__pycache__").glob("*.nbi"))
    monkeypatch.undo()
    assert len(threads._sources()) == 64
