"""Without a cache that can be written to everything goes on, with the same results; one line says so."""

import errno
import os
import pwd
import subprocess
import sys
from pathlib import Path

import numba
import pytest
import torch

from fprf.io import cache, tensorfiles
from fprf.io.cache import cache_folder, cache_home, files_in, refusal, user_folder
from fprf.io.tensorfiles import keep, load_sealed, save_kept

TENSORS = {"x": torch.arange(24.0).view(2, 3, 4).transpose(1, 2), "n": torch.tensor([3])}


@pytest.fixture
def homeless(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A user whom the system does not know, in a working directory of its own."""

    def unknown(uid: int) -> None:
        raise KeyError(f"getpwuid(): uid not found: {uid}")

    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(pwd, "getpwuid", unknown)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def closed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A file in the place of the user's cache."""
    (tmp_path / "closed").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "closed"))
    return tmp_path / "closed"


def test_the_cache_is_where_the_variables_say(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    assert cache_home() == tmp_path / ".cache"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
    assert cache_folder("features") == user_folder("features") == tmp_path / "other/fprf/features"


def test_a_user_without_a_home_gets_a_folder_that_ends_with_the_process(
    homeless: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cache._say_once.cache_clear()
    assert cache_home() is None
    folder = cache_folder("features")
    assert folder.is_dir() and folder == cache_folder("features") != cache_folder("captures")
    said = capsys.readouterr().err
    assert said.count("XDG_CACHE_HOME") == said.count("NUMBA_CACHE_DIR") == said.count("slower") == 1
    assert not list(homeless.iterdir()), "no folder named ~"


@pytest.mark.parametrize("place", ["/dev/null", "/proc/1/nothing", "/dev/full"])
def test_places_that_cannot_be_written_to(
    place: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if not Path(place).exists() and not Path(place).parent.exists():
        pytest.skip(f"no {place} here")
    cache._say_once.cache_clear()
    monkeypatch.setenv("XDG_CACHE_HOME", place)
    assert refusal(user_folder("features"))
    assert not files_in(user_folder("features"), "*")
    assert not cache_folder("features").is_relative_to(place)
    cache_folder("captures")
    assert capsys.readouterr().err.count(place) == 1, "said once"


def test_a_folder_that_is_only_read_is_still_read(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = cache_folder("captures")
    assert save_kept(folder / "a.safetensors", TENSORS)

    def read_only(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(cache.tempfile, "TemporaryFile", read_only)
    assert cache_folder("captures") == folder and not capsys.readouterr().err
    assert torch.equal(load_sealed(folder / "a.safetensors")["x"], TENSORS["x"])


@pytest.mark.parametrize("everywhere", [False, True])
def test_on_a_full_disk_tensors_stay_elsewhere(
    everywhere: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    real = tensorfiles.safetensors.torch.save_file

    def full(tensors: dict[str, torch.Tensor], path: Path, *rest: object) -> None:
        if everywhere or path.is_relative_to(tmp_path):
            path.write_bytes(b"half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(tensors, path, *rest)

    monkeypatch.setattr(tensorfiles.safetensors.torch, "save_file", full)
    kept = keep(tmp_path / "a.safetensors", TENSORS)
    for name, tensor in TENSORS.items():
        assert torch.equal(kept[name], tensor) and kept[name].is_contiguous()
    keep(tmp_path / "b.safetensors", TENSORS)
    assert not list(tmp_path.iterdir()), "nothing half written is left"
    said = capsys.readouterr().err
    assert said.count(f"{tmp_path}: No space left on device") == 1


KERNEL = """
def scaled(x):
    return 2.5 * x
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A module beside which nothing can be cached."""
    folder = tmp_path / "package"
    folder.mkdir()
    (folder / "__pycache__").write_text("")
    (folder / "kernel_without_a_cache.py").write_text(KERNEL)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, "kernel_without_a_cache", raising=False)
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    return folder


def compiled() -> float:
    import kernel_without_a_cache

    from fprf.ops.threads import cached_jit

    kernel = cached_jit(nogil=True)(kernel_without_a_cache.scaled)
    assert kernel(2.0) == kernel(2.0)
    return float(kernel(4.0))


def test_kernels_are_compiled_in_memory(
    module: Path, closed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert compiled() == 10.0
    cache_folder("features")
    assert capsys.readouterr().err.count(f"({closed}: ") == 1, "once for kernels and features"


def test_kernels_of_a_user_without_a_home(module: Path, homeless: Path) -> None:
    assert compiled() == 10.0
    assert not (homeless / "~").exists()


@pytest.mark.parametrize("what", ["full", "damaged", "closed"])
def test_kernels_whose_files_the_system_or_their_bytes_refuse(
    what: str, module: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "numba"))
    if what == "full":

        def full(*_: object) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        monkeypatch.setattr(numba.core.caching.IndexDataCacheFile, "_save_data", full)
        assert compiled() == 10.0
        assert not list(tmp_path.rglob("*.nbi")), "no index of code that was never written"
        return
    assert compiled() == 10.0
    (index,) = tmp_path.rglob("*.nbi")
    if what == "damaged":
        index.write_bytes(index.read_bytes()[:7])
    else:
        index.unlink()
        index.mkdir()
    monkeypatch.delitem(sys.modules, "kernel_without_a_cache")
    assert compiled() == 10.0


SCRIPT = """
import os, sys
from pathlib import Path

import numba, torch
from fprf.io import cache, tensorfiles
from fprf.ops.threads import cached_jit

def scaled(x):
    return 2.5 * x

numba.njit(scaled)(1.0)
tensorfiles.save(Path("warm.safetensors"), {"x": torch.ones(3)}, sealed=True)
for name in ("HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR"):
    os.environ.pop(name, None)
numba.config.CACHE_DIR = ""
os.setgroups([])
os.setgid(54321)
os.setuid(54321)
for home in (None, "/", str(Path("closed").absolute())):
    if home is not None:
        os.environ["HOME"] = home
    assert cached_jit()(scaled)(4.0) == 10.0
    kept = tensorfiles.keep(Path("closed/a.safetensors"), {"x": torch.arange(5.0)})
    assert torch.equal(kept["x"], torch.arange(5.0))
    folder = cache.cache_folder("features")
    assert folder.is_dir()
print(folder)
"""


def test_a_user_id_that_the_system_does_not_know(tmp_path: Path) -> None:
    """A process of such a user; what it needs is imported before, since Python itself may be closed to it."""
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        pytest.skip("needs root, to become another user")
    tmp_path.chmod(0o777)
    (tmp_path / "closed").mkdir(mode=0o700)
    (tmp_path / "script.py").write_text(SCRIPT)
    command = [sys.executable, "script.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not Path(done.stdout.strip()).exists(), "it ends with its process"
    assert not (tmp_path / "~").exists()
