from collections.abc import Iterator
from pathlib import Path

import pytest
from fake_packages import ENCODER, Packages, packages_in

from fprf.cli.plugins import faults, run


@pytest.fixture
def packages(tmp_path: Path) -> Iterator[Packages]:
    with packages_in(tmp_path) as found:
        yield found


def test_built_ins_are_listed_and_load(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "140")
    assert run([]) == 0
    text = capsys.readouterr().out
    assert "vgg19" in text and "fprf.plugins.encoders.config:Vgg19Config" in text and "state" not in text
    assert run(["--check"]) == 0
    assert "broken" not in capsys.readouterr().out


MINE = ENCODER.format(name="N") + "\nthing = NConfig"


@pytest.mark.parametrize(
    ("group", "name", "source", "shown"),
    [
        ("fprf.encoders", "x", "import not_there", "ModuleNotFoundError"),
        ("fprf.encoders", "x", "from fprf.blocks.config import SingleConfig as thing", "is SingleConfig, not a EncoderConfig"),
        ("fprf.encoders", "none", MINE, "can never be chosen"),
        ("fprf.encoders", "x", MINE.replace("int = 224", "int"), "no defaults"),
        ("fprf.encoders", "vgg19", MINE, "several packages provide 'vgg19'"),
        ("fprf.commands", "train", "from fprf.cli.config import CommandConfig as thing", "is never called: fprf has a verb"),
        ("fprf.methods", "x", "def thing(): return None", "gives NoneType, not a RunConfig"),
    ],
)
def test_what_is_broken_is_told_and_nothing_else(
    packages: Packages, capsys: pytest.CaptureFixture[str], group: str, name: str, source: str, shown: str
) -> None:
    packages.install("acme", {group: {name: "acme_check:thing"}}, code={"acme_check": source})
    assert {row.name for row, _ in faults()} == {name}
    assert run(["--check"]) == 1
    assert shown in " ".join(capsys.readouterr().out.split())
    assert run([]) == 0, "listing loads nothing"
