"""Every reader on mutated files: a value, or one line. `FPRF_FUZZ=100000 pytest tests/fuzz -m fault` for a night."""

import os
import random
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.readers import Target, fuzz, mutated, targets
from fprf.datamanagers.images import MAX_PIXELS
from fprf.datamanagers.parsers.config import ColmapConfig
from fprf.errors import DataError

NAMES = [
    *(f"COLMAP {kind}.{suffix}" for suffix in ("bin", "txt") for kind in ("cameras", "images", "points3D")),
    "transforms.json",
    "poses_bounds.npy",
    *(f"image, {suffix}" for suffix in ("png", "jpg", "webp", "bmp", "tiff")),
    "camera path",
    "style.json",
    "config.json",
    "sealed tensors",
    "style dictionary",
    "checkpoint manifest",
    "archive of arrays",
    "list of photographs",
    "tf.train.Example",
    "metadata of Mega-NeRF",
    "camera of Polycam",
    "metadata of Record3D",
    *(f"{kind} of ODM" for kind in ("reconstruction", "shots", "cameras")),
    *(f"Gaussians, {name}" for name in ("x.ply", "x.compressed.ply", "x.splat", "x.spz", "x.sog", "meta.json")),
]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Target]:
    return {target.name: target for target in targets(tmp_path_factory.mktemp("fuzz") / "files")}


@pytest.mark.parametrize("name", NAMES)
def test_mutations_are_read_or_refused_in_one_line(made: dict[str, Target], name: str) -> None:
    whole = made[name].file.read_bytes()
    found = fuzz(made[name], 60, seed=1)
    assert not found.faults
    assert found.values + found.refusals == 60 and found.refusals > 5
    assert made[name].file.read_bytes() == whole


@pytest.mark.fault
@pytest.mark.parametrize("name", NAMES)
def test_many_mutations(made: dict[str, Target], name: str) -> None:
    rounds = int(os.environ.get("FPRF_FUZZ", "2000"))
    found = fuzz(made[name], rounds, seed=random.SystemRandom().randrange(2**31), watch_memory=True)
    # Images may have as many pixels as they say: four channels as they lie in the file, and once more as they are shown.
    most = 8 * MAX_PIXELS if name.startswith("image, ") else 64 << 20
    assert not found.faults and found.memory < most


@settings(max_examples=100, deadline=None)
@given(data=st.binary(max_size=200), seed=st.integers(0, 2**31))
def test_mutations_are_functions_of_their_seed_and_never_fail(data: bytes, seed: int) -> None:
    assert mutated(data, random.Random(seed)) == mutated(data, random.Random(seed))


@pytest.mark.parametrize("count", [2**63, 2**28, 2**64 - 1, 10**6])
@pytest.mark.parametrize("kind", ["cameras", "images", "points3D"])
def test_a_count_that_the_file_cannot_hold_takes_no_memory(made: dict[str, Target], kind: str, count: int) -> None:
    target = made[f"COLMAP {kind}.bin"]
    whole = target.file.read_bytes()
    target.file.write_bytes(struct.pack("<Q", count) + whole[8:])
    try:
        import tracemalloc

        tracemalloc.start()
        with pytest.raises(DataError, match="bytes, "):
            target.read()
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
        tracemalloc.stop()
    finally:
        target.file.write_bytes(whole)


@pytest.mark.parametrize(
    "name",
    ["/etc/passwd", "../x.png", "a/../../x.png", "C:\\x.png", "\\\\server\\x.png", "..\\x.png", "", "a\nb.png", "\u202egnp.x"],
)
def test_no_name_in_a_model_leads_out_of_the_folder(made: dict[str, Target], name: str) -> None:
    target = made["COLMAP images.txt"]
    whole = target.file.read_bytes()
    target.file.write_bytes(whole.replace(b"0.png", name.encode()))
    try:
        with pytest.raises(DataError) as told:
            ColmapConfig().build().parse(target.file.parents[2], 1)
        assert "\n" not in str(told.value)
    finally:
        target.file.write_bytes(whole)
