"""What start-up may cost: help, parsing and every built-in config are free of the heavy packages."""

import subprocess
import sys

import pytest

from fprf.cli.main import VERBS

HEAVY = ("torch", "numpy", "cv2", "kornia", "trimesh", "numba", "safetensors", "transformers", "av")
BUILT_INS = """
from fprf.plugins import registry
for group in registry.groups():
    # Of formats and kinds of scenes the names are all that is asked before a file is read.
    for name in registry.installed(group) if group not in ("fprf.captures", "fprf.scenes") else ():
        if registry.entry(group, name).package.startswith("fprf "):
            registry.load_object(group, name)()
            report(f"{group} {name}")
"""
COMMANDS = [
    ["--help"],
    ["plugins"],
    ["train"],
    ["train", "--help"],
    ["train", "fprf", "--help"],
    ["train", "fprf-lite", "--sampler", "uniform", "--help"],
    ["train", "fprf", "--stpes", "3"],
    *([verb, "--help"] for verb in VERBS if verb != "train"),
]


def _fresh(code: str) -> list[str]:
    """Run in a new interpreter, in which warnings are errors; lines on standard error."""
    before = f"import sys\ndef report(what): print(what, *({{*{HEAVY!r}}} & {{*sys.modules}}), sep='|', file=sys.stderr)\n"
    ended = subprocess.run(
        [sys.executable, "-W", "error", "-c", before + code], capture_output=True, text=True, timeout=240, check=False
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stderr.splitlines()


@pytest.mark.parametrize("code", ["import fprf.config, fprf.methods\nreport('configs')", BUILT_INS])
def test_configs_import_nothing_heavy(code: str) -> None:
    lines = _fresh(code)
    assert lines and not [line for line in lines if "|" in line]


def test_help_and_parsing_import_nothing_heavy() -> None:
    code = f"from fprf.cli.main import main\nfor args in {COMMANDS!r}:\n    report(f'{{args}} {{main(args)}}')"
    lines = [line for line in _fresh(code) if line.startswith("[")]
    codes = [2 if args in (["train"], ["train", "fprf", "--stpes", "3"]) else 0 for args in COMMANDS]
    assert lines == [f"{args} {code}" for args, code in zip(COMMANDS, codes, strict=True)]


@pytest.mark.parametrize(("args", "seconds"), [(["--help"], 0.4), (["train", "fprf", "--help"], 1.5)])
def test_help_takes_little_processor_time(args: list[str], seconds: float) -> None:
    code = f"import time\nfrom fprf.cli.main import main\nmain({args!r})\nreport(time.process_time())"
    spent = [float(_fresh(code)[-1])]
    if spent[0] >= seconds:  # the machine may have been busy
        spent.append(float(_fresh(code)[-1]))
    assert min(spent) < seconds, f"fprf {' '.join(args)}: {spent} s of processor time"
