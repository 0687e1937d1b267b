import shutil
import subprocess
from pathlib import Path

import pytest

from fprf.cli import main as cli
from fprf.cli.completion import SHELLS, Offer, offers

FEW = {
    "train": Offer("train a scene, or go on where a run stopped", ("fprf", "fprf-lite"), ("--data", "--help", "--steps")),
    "view": Offer("it's a view", (), ("--help", "--port")),
}


def test_every_verb_has_its_flags() -> None:
    known = offers()
    assert known.keys() == cli.VERBS.keys()
    assert {"fprf", "fprf-lite"} <= set(known["train"].words)
    assert {"--data", "--steps", "--sampler", "--content.field.resolutions", "--help"} <= set(known["train"].flags)
    assert {"--references", "--strength", "--keep-below", "--stylizer", "--quality"} <= set(known["stylize"].flags)
    for verb in ("render", "export", "gallery", "process", "report", "eval", "demo", "doctor", "bench", "pretrain"):
        assert len(known[verb].flags) > 1, verb
    assert not [flag for offer in known.values() for flag in offer.flags if "_" in flag or not flag.startswith("--")]


def completed(words: list[str], folder: Path) -> list[str]:
    """What bash offers for the last of the words."""
    code = SHELLS["bash"](FEW) + f"COMP_WORDS=({' '.join(repr(word) for word in words)})\nCOMP_CWORD={len(words) - 1}\n"
    code += "_fprf\nprintf '%s\\n' \"${COMPREPLY[@]}\"\n"
    bash = shutil.which("bash")
    assert bash
    ended = subprocess.run([bash, "--norc"], input=code, capture_output=True, text=True, cwd=folder, timeout=60, check=True)
    assert ended.stderr == ""
    return [line for line in ended.stdout.splitlines() if line]


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash here")
def test_bash_completes(tmp_path: Path) -> None:
    (tmp_path / "fern").mkdir()
    assert completed(["fprf", ""], tmp_path) == ["train", "view", "--help", "--version"]
    assert completed(["fprf", "v"], tmp_path) == ["view"]
    assert completed(["fprf", "train", "f"], tmp_path) == ["fprf", "fprf-lite", "fern"]
    assert completed(["fprf", "train", "fprf-lite", "--s"], tmp_path) == ["--steps"]
    assert completed(["fprf", "train", "fprf-lite", "--data", "fe"], tmp_path) == ["fern"]
    assert completed(["fprf", "nothing", "--"], tmp_path) == []


@pytest.mark.parametrize("shell", sorted(SHELLS))
def test_the_scripts_are_whole(shell: str) -> None:
    text = SHELLS[shell](FEW)
    assert text.endswith("\n") and all(word in text for word in ("fprf-lite", "steps", "port"))
    found = shutil.which(shell)
    if found is not None:
        ended = subprocess.run([found, "-n"], input=text, capture_output=True, text=True, timeout=60, check=False)
        assert ended.returncode == 0, ended.stderr
