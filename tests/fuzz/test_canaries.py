"""A pickle in the place of every file that we load: none may run. The canary is a file that its code would make."""

import pickle
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from test_readers import LATER, NAMES

import fprf
from benchmarks.readers import targets
from fprf.errors import FprfError
from fprf.plugins.encoders.vgg import read_tensors


@dataclass
class Canary:
    place: Path

    def __reduce__(self) -> tuple[object, ...]:
        return (Path.touch, (self.place,))


@pytest.fixture
def canary(tmp_path: Path) -> Path:
    place = tmp_path / "canary"
    pickle.loads(pickle.dumps(Canary(place)))
    assert place.exists(), "else there is nothing to be seen"
    place.unlink()
    return place


def payloads(canary: Path, folder: Path) -> list[bytes]:
    """As a plain pickle, a file of torch.save (new and old), an array of objects, and an archive of one."""
    bad = Canary(canary)
    torch.save(bad, folder / "new.pt")
    torch.save(bad, folder / "old.pt", _use_new_zipfile_serialization=False)
    np.save(folder / "objects.npy", np.array([bad], dtype=object))
    np.savez(folder / "objects.npz", points=np.array([bad], dtype=object))
    files = [(folder / name).read_bytes() for name in ("new.pt", "old.pt", "objects.npy", "objects.npz")]
    return [pickle.dumps(bad, protocol=2), *files]


def test_no_reader_runs_what_it_reads(tmp_path: Path, canary: Path) -> None:
    made = targets(tmp_path / "files")
    assert {target.name for target in made} == {*NAMES, *LATER}
    for target in made:
        whole = target.file.read_bytes()
        for payload in payloads(canary, tmp_path):
            target.file.write_bytes(payload)
            with pytest.raises(FprfError):
                target.read()
            assert not canary.exists(), target.name
        target.file.write_bytes(whole)
    for name in ("new.pt", "old.pt"):
        with pytest.raises(FprfError):
            read_tensors(tmp_path / name)
        assert not canary.exists()


def test_the_code_has_no_way_to_run_what_it_reads() -> None:
    """No unpickling but of tensors, no evaluation of texts, no shell."""
    bare = re.compile(r"pickle\.loads?\(|allow_pickle=True|shell=True|yaml\.load|\beval\(|\bexec\(|os\.system\(")
    for path in Path(fprf.__file__).parent.rglob("*.py"):
        text = path.read_text()
        code = "\n".join(line for line in text.splitlines() if ".eval()" not in line and "torch.jit" not in line)
        assert not bare.search(code), path
        for call in re.findall(r"torch\.load\([^)]*\)", text):
            assert "weights_only=True" in call, path
