"""What shells are told of a command line that is being written, and their scripts."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from tiny_world import World

from fprf.cli.completion import SHELLS, complete, install, script
from fprf.cli.main import VERBS, main
from fprf.errors import UsageError


@pytest.fixture
def place(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a run in `runs` whose style has named a region."""
    run = tmp_path / "runs" / "town-fprf-lite"
    shutil.copytree(world.run, run)
    (run / "styles" / "dusk").mkdir(parents=True)
    (run / "styles" / "dusk" / "style.json").write_text(json.dumps({"regions": {"roofs": [1.0]}}))
    monkeypatch.chdir(tmp_path)
    return tmp_path


RUN = "runs/town-fprf-lite"


@pytest.mark.parametrize(
    ("line", "some", "others"),
    [
        ("st", ["stylize"], ["train"]),
        ("", [*VERBS, "--install-completion"], ["--pin"]),
        ("train ", ["fprf", "fprf-lite", "fprf-splats"], ["demo"]),
        ("pretrain ", ["decoder"], []),
        ("train fprf-lite --semantic.encoder ", ["vgg19", "bundled-semantic", "none"], ["adain"]),
        ("train fprf-lite --semantic.encoder vgg19 --semantic.encoder.", ["--semantic.encoder.weights"], []),
        ("train --device c", ["cpu", "cuda"], ["auto"]),
        ("process photos --matching ", ["exhaustive", "sequential"], []),
        ("stylize ", [RUN], ["--pin"]),
        (f"stylize {RUN} --g", ["--gentle"], []),
        (f"stylize {RUN} --stylizer ", ["adain", "region-ot"], ["vgg19"]),
        (f"stylize {RUN} --pin ", ["0=", "roofs="], ["roofs", "town"]),
        (f"stylize {RUN} --keep 0 r", ["roofs"], ["0"]),
        (f"stylize {RUN} --views 000", ["0005", "0008"], ["0"]),
        (f"render {RUN} --explain", [], ["true"]),
        ("plugins ", ["new"], []),
        ("plugins new x --kind ", ["encoder", "loss"], ["verb"]),
        ("--install-completion ", list(SHELLS), ["demo"]),
        # Files, which the shell itself completes, and what is wrong already.
        (f"stylize {RUN} --references ", [], []),
        ("restyle ", [], []),
        ("nonsense ", [], []),
        ("train nonsense --", [], []),
        ("train fprf-lite --semantic.encoder nonsense --semantic.encoder.", [], []),
    ],
)
def test_words_that_may_come(place: Path, line: str, some: list[str], others: list[str]) -> None:
    *words, word = line.split(" ")
    found = complete([f"--word={word}", *words])
    assert set(some) <= set(found) and not set(others) & set(found)
    assert all(each.startswith(word) for each in found)
    if not some and not others:
        assert found == []


def test_it_imports_no_torch_and_finds_flags_of_every_verb(place: Path) -> None:
    for verb in VERBS:
        words = [verb, *{"train": ["fprf-splats"], "pretrain": ["decoder"]}.get(verb, [])]
        assert "--help" in complete(["--word=--", *words]), verb
    code = "import sys; from fprf.cli.main import main; main(sys.argv[1:]); print('torch' in sys.modules)"
    words = ["--complete", "--word=", "stylize", RUN, "--pin"]
    ended = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, check=True, env=dict(os.environ)
    )
    assert ended.stdout.splitlines()[0] == "roofs=" and ended.stdout.splitlines()[-1] == "False"


def shell_of(name: str, place: Path) -> dict[str, str]:
    """An environment with a program `fprf` in it. Skips where there is no such shell."""
    if shutil.which(name) is None:
        pytest.skip(f"there is no {name} here")
    program = place / "bin" / "fprf"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m fprf "$@"\n')
    program.chmod(0o755)
    path = f"{program.parent}{os.pathsep}{os.environ['PATH']}"
    return {**os.environ, "PATH": path, "PYTHONPATH": os.pathsep.join(sys.path), "HOME": str(place)}


def heard(command: list[str], environment: dict[str, str]) -> list[str]:
    ended = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, timeout=120)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout.split()


def test_bash_completes(place: Path) -> None:
    environment = shell_of("bash", place)
    ask = (
        'eval "$(fprf --show-completion bash)"; '
        'compopt() { :; }; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _fprf; printf "%s\\n" "${COMPREPLY[@]}"'
    )
    assert heard(["bash", "-c", ask, "bash", "fprf", "sty"], environment) == ["stylize"]
    assert "roofs=" in heard(["bash", "-c", ask, "bash", "fprf", "stylize", RUN, "--pin", ""], environment)
    assert heard(["bash", "-c", ask, "bash", "fprf", "restyle", ""], environment) == []


def test_fish_completes(place: Path) -> None:
    environment = shell_of("fish", place)
    assert "fish" in install("fish")
    ask = "source {}; complete -C {}"
    text = place / "fprf.fish"
    text.write_text(script("fish"))
    assert heard(["fish", "-c", ask.format(text, "'fprf sty'")], environment) == ["stylize"]
    assert "roofs=" in heard(["fish", "-c", ask.format(text, f"'fprf stylize {RUN} --pin '")], environment)


def test_zsh_reads_its_script(place: Path) -> None:
    environment = shell_of("zsh", place)
    text = place / "fprf.zsh"
    text.write_text(script("zsh"))
    ask = "autoload -Uz compinit; compinit -u -d $HOME/dump; source $1; print ${_comps[fprf]}"
    assert heard(["zsh", "-f", "-c", ask, "zsh", str(text)], environment) == ["_fprf"]


def test_scripts_go_where_shells_look(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("SHELL", "/usr/bin/fish")
    assert main(["--install-completion"]) == 0
    for shell in SHELLS:
        assert main(["--install-completion", shell]) == 0
    places = [
        "config/fish/completions/fprf.fish",
        "data/bash-completion/completions/fprf",
        "data/fprf/completion.zsh",
        "data/fprf/completion.ps1",
    ]
    told = capsys.readouterr().out
    for each in places:
        assert (tmp_path / each).is_file() and str(tmp_path / each) in told
    with pytest.raises(UsageError, match="tcsh is not known"):
        script("tcsh")
