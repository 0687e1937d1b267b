"""`fprf plugins` lists and checks what is installed; verbs that packages add are parsed and called like built-in ones."""

import pytest
from fake_packages import ENCODER, Packages

from fprf.cli import main as cli
from fprf.cli.config import CommandConfig
from fprf.cli.plugins import faults, run


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


COUNT = '''
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar
from fprf.cli.config import CommandConfig
from fprf.errors import DataError
from fprf.plugins.samplers.config import SamplerConfig, UniformConfig

@dataclass(frozen=True, kw_only=True)
class CountConfig(CommandConfig):
    """Count the files of a folder."""

    positional: ClassVar[tuple[str, ...]] = ("folder",)
    folder: Path = Path()
    step: int = 1
    sampler: SamplerConfig = UniformConfig()

    def run(self) -> int:
        if not self.folder.is_dir():
            raise DataError(f"{self.folder}: no such folder")
        print(len(list(self.folder.iterdir())) * self.step, type(self.sampler).__name__)
        return 3
'''


@pytest.fixture
def counting(packages: Packages) -> Packages:
    point = {CommandConfig.group: {"count": "acme_count:CountConfig"}}
    packages.install("acme-count", point, code={"acme_count": COUNT}, version="0.2")
    return packages


def test_it_is_parsed_and_called_like_a_built_in_one(counting: Packages, capsys: pytest.CaptureFixture[str]) -> None:
    folder = counting.root / "some"
    folder.mkdir()
    (folder / "a").touch()
    assert cli.main(["count", "--step", "4", str(folder), "--sampler", "proposal"]) == 3
    assert capsys.readouterr().out == "4 ProposalConfig\n"
    assert cli.main(["count", str(folder / "b")]) == 2
    assert capsys.readouterr().err == f"error: {folder / 'b'}: no such folder\n"
    assert cli.main(["count", str(folder), "--stp", "2"]) == 2 and "did you mean --step?" in capsys.readouterr().err
    assert cli.main(["count", "--help"]) == 0
    shown = capsys.readouterr().out
    assert "usage: fprf count" in shown and "Count the files of a folder." in shown and "--step INT" in shown
    assert cli.main(["cuont"]) == 2 and "did you mean 'count'?" in capsys.readouterr().err


def test_a_broken_verb_harms_only_its_callers(counting: Packages, capsys: pytest.CaptureFixture[str]) -> None:
    counting.install("acme-bad", {CommandConfig.group: {"bad": "acme_bad5:C"}}, code={"acme_bad5": "1 / 0"})
    for k in (1, 2):
        counting.install(f"acme-twice-{k}", {CommandConfig.group: {"twice": "acme_count:CountConfig"}})
    counting.install("acme-train", {CommandConfig.group: {"plugins": "acme_bad5:C"}})
    assert cli.main(["--help"]) == 0
    assert "of acme-twice-1 1 and acme-twice-2 1" in capsys.readouterr().out
    assert cli.main(["bad"]) == 2
    assert "'bad' (acme_bad5:C from acme-bad 1) failed to import: ZeroDivisionError" in capsys.readouterr().err
    assert cli.main(["twice"]) == 2 and "several packages provide 'twice'" in capsys.readouterr().err
    assert cli.main(["plugins", "--help"]) == 0, "ours wins"
