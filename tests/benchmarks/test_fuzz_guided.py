"""`benchmarks/fuzz_guided.py`: a search tells what it did and what failed; a corpus is sealed into the same bytes each time."""

import zipfile
from pathlib import Path
from types import ModuleType

import pytest

from benchmarks import fuzz_guided


@pytest.fixture
def script() -> ModuleType:
    return fuzz_guided


SAID = "#12 NEW cov: 30 ft: 41\n#99 DONE cov: 44 ft: 60\nstat::number_of_executed_units: 99\nstat::peak_rss_mb: 100\n"


def test_faults_are_told_with_their_bytes_and_the_search_goes_on(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = [(77, "x\nKeyError: 'w'\n" + SAID), (0, SAID)]

    def run(name: str, corpus: Path, options: list[str]) -> tuple[int, str]:
        code, said = answers.pop(0)
        if code:
            place = next(each.split("=", 1)[1] for each in options if each.startswith("-artifact_prefix="))
            (Path(place) / "crash-1").write_bytes(b"\x00\x01")
        return code, said

    monkeypatch.setattr(script, "run", run)
    found = script.search("a reader", tmp_path / "corpus", 60.0)
    assert found["rounds"] == 198 and found["reached"] == 44 and not answers
    assert found["faults"] == [{"said": "KeyError: 'w'", "bytes": ["AAE="]}]


def test_a_corpus_is_sealed_into_the_same_bytes(script: ModuleType, tmp_path: Path) -> None:
    corpus = tmp_path / "corpus"
    (corpus / "b").mkdir(parents=True)
    (corpus / "b" / "2").write_bytes(b"two")
    (corpus / "b" / "1").write_bytes(b"one")
    for name in ("x.zip", "y.zip"):
        script.seal(corpus, tmp_path / name)
    assert (tmp_path / "x.zip").read_bytes() == (tmp_path / "y.zip").read_bytes()
    with zipfile.ZipFile(tmp_path / "x.zip") as archive:
        assert {name: archive.read(name) for name in archive.namelist()} == {"b/1": b"one", "b/2": b"two"}


def test_one_reader_for_real(script: ModuleType, tmp_path: Path) -> None:
    pytest.importorskip("atheris")
    found = script.search("style.json", tmp_path, 4.0)
    assert found["rounds"] > 10 and found["reached"] > 10 and found["faults"] == []
    assert (tmp_path / "valid").exists()
