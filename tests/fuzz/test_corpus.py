"""What a search guided by coverage found (`benchmarks/fuzz_guided.py`): files that reach far into each reader, read again."""

import zipfile
from pathlib import Path

import pytest
from test_readers import NAMES

from benchmarks.readers import Target, targets
from fprf.errors import FprfError

CORPUS = Path(__file__).with_name("corpus.zip")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Target]:
    return {target.name: target for target in targets(tmp_path_factory.mktemp("corpus") / "files")}


@pytest.mark.parametrize("name", NAMES)
def test_files_of_the_corpus_are_read_or_refused(made: dict[str, Target], name: str) -> None:
    target = made[name]
    valid, values, refusals = target.file.read_bytes(), 0, 0
    with zipfile.ZipFile(CORPUS) as archive:
        files = [archive.read(entry) for entry in archive.namelist() if entry.startswith(f"{name}/")]
    for data in files:
        target.file.write_bytes(data)
        try:
            target.read()
            values += 1
        except FprfError:
            refusals += 1
    target.file.write_bytes(valid)
    assert values and refusals, "a search finds files of both kinds"
