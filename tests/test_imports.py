"""What start-up may cost: help, parsing and every built-in config are free of the heavy packages."""

import subprocess
import sys

import pytest

HEAVY = ("torch", "numpy", "cv2", "kornia", "trimesh", "numba", "safetensors", "transformers", "av")
WATCH = f"\nimport sys\nprint(sorted(set({HEAVY!r}) & set(sys.modules)), file=sys.stderr)"


def _fresh(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code + WATCH], capture_output=True, text=True, timeout=120, check=False
    )


def _verb(*args: str) -> str:
    return f"from fprf.cli import main\nassert main({list(args)!r}) in (0, 2)"


@pytest.mark.parametrize(
    "code",
    [
        "import fprf.config, fprf.methods",
        "from fprf.plugins import registry\n"
        "for g in registry.groups():\n"
        "    for n in registry.installed(g):\n"
        "        if registry.entry(g, n).package.startswith('fprf '):\n"
        "            registry.load_object(g, n)()",
        _verb("--help"),
        _verb("plugins"),
        _verb("plugins", "--help"),
        _verb("doctor", "--help"),
        _verb("train"),
        _verb("train", "--help"),
        _verb("train", "fprf", "--help"),
        _verb("train", "fprf-lite", "--sampler", "uniform", "--help"),
        _verb("train", "fprf", "--stpes", "3"),
        *(_verb(verb, "--help") for verb in ("demo", "eval", "stylize", "render", "pretrain")),
    ],
)
def test_nothing_heavy_is_imported(code: str) -> None:
    ended = _fresh(code)
    assert ended.stderr.splitlines()[-1] == "[]", ended.stderr
    assert "Traceback" not in ended.stderr


def test_help_takes_little_processor_time() -> None:
    for args, seconds in ((["--help"], 0.4), (["train", "fprf", "--help"], 1.5)):
        code = f"import time\n{_verb(*args)}\nimport sys; print(f'{{time.process_time():.3f}}', file=sys.stderr)"
        spent = min(float(_fresh(code).stderr.splitlines()[-2]) for _ in range(2))
        assert spent < seconds, f"fprf {' '.join(args)}: {spent} s of processor time"
