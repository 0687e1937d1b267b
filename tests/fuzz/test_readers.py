"""Every reader on mutated files: a value, or one line; none runs what it reads.

`FPRF_FUZZ=100000 pytest tests/fuzz -m fault` for a night. corpus.zip holds what a search guided by coverage
found (`benchmarks/fuzz_guided.py`): files that reach far into each reader.
"""

import os
import pickle
import random
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

import fprf
from benchmarks.readers import Target, fuzz, targets
from fprf.datamanagers.image_files import MAX_PIXELS
from fprf.errors import FprfError
from fprf.plugins.encoders.vgg import read_tensors

CORPUS = Path(__file__).with_name("corpus.zip")

NAMES = [
    *(f"COLMAP {kind}.{suffix}" for suffix in ("bin", "txt") for kind in ("cameras", "images", "points3D")),
    "transforms.json",
    "poses_bounds.npy",
    *(f"image, {suffix}" for suffix in ("png", "jpg", "webp", "bmp", "tiff")),
    "camera path",
    "style.json",
    "config.json",
    "sealed tensors",
    "checkpoint manifest",
    "archive of arrays",
    "list of photographs",
    "tf.train.Example",
    "metadata of Mega-NeRF",
    "camera of Polycam",
    "metadata of Record3D",
    *(f"{kind} of ODM" for kind in ("reconstruction", "shots", "cameras")),
    *(
        f"Gaussians, {name}"
        for name in ("x.ply", "x.compressed.ply", "x.splat", "x.spz", "x.sog", "meta.json")
    ),
]
SPLAT_ROW = 32
"""Bytes of a Gaussian in a .splat."""
LATER = [f"Gaussians, {name}" for name in ("x.glb", "x.gltf", "ascii.ply", "x.ksplat", "lod-meta.json")]
"""Readers that the corpus does not have."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Target]:
    return {target.name: target for target in targets(tmp_path_factory.mktemp("fuzz") / "files")}


@pytest.mark.parametrize("name", [*NAMES, *LATER])
def test_mutations_are_read_or_refused_in_one_line(made: dict[str, Target], name: str) -> None:
    found = fuzz(made[name], 40, seed=1)
    assert not found.faults
    assert found.values + found.refusals == 40 and found.refusals > 5


@pytest.mark.fault
@pytest.mark.parametrize("name", [*NAMES, *LATER])
def test_many_mutations(made: dict[str, Target], name: str) -> None:
    rounds = int(os.environ.get("FPRF_FUZZ", "2000"))
    found = fuzz(made[name], rounds, seed=random.SystemRandom().randrange(2**31), watch_memory=True)
    # Images may have as many pixels as they say: four channels as they lie in the file, and once more as they
    # are shown.
    most = 8 * MAX_PIXELS if name.startswith("image, ") else 64 << 20
    assert not found.faults and found.memory < most


@pytest.mark.parametrize("name", NAMES)
def test_files_of_the_corpus_are_read_or_refused(made: dict[str, Target], name: str) -> None:
    target = made[name]
    valid = target.file.read_bytes()
    values = 0
    refusals = 0
    with zipfile.ZipFile(CORPUS) as archive:
        for entry in archive.namelist():
            if entry.startswith(f"{name}/"):
                target.file.write_bytes(archive.read(entry))
                try:
                    target.read()
                    values += 1
                except FprfError:
                    refusals += 1
    target.file.write_bytes(valid)
    assert values and refusals, "a search finds files of both kinds"


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
            # Any whole number of rows is a .splat, which has no header.
            target.file.write_bytes(payload + b"\0" if len(payload) % SPLAT_ROW == 0 else payload)
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
    bare = re.compile(
        r"pickle\.loads?\(|allow_pickle=True|shell=True|yaml\.load|\beval\(|\bexec\(|os\.system\("
    )
    for path in Path(fprf.__file__).parent.rglob("*.py"):
        text = path.read_text()
        code = "\n".join(
            line for line in text.splitlines() if ".eval()" not in line and "torch.jit" not in line
        )
        assert not bare.search(code), path
        for call in re.findall(r"torch\.load\([^)]*\)", text):
            assert "weights_only=True" in call, path
