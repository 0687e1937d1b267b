"""What feeds training knows nothing of what trains, and blocks know nothing of training either: imports point one way."""

import ast
from pathlib import Path

import pytest

import fprf

ROOT = Path(fprf.__file__).parent
ABOVE = {
    "datamanagers": {
        "blocks",
        "training",
        "style",
        "evaluation",
        "cli",
        "viewer",
        "export",
        "api",
    },
    "blocks": {"training", "style", "evaluation", "cli", "viewer", "export", "api"},
    "ops": {"fields", "rendering", "datamanagers", "blocks", "training", "style", "evaluation", "cli", "viewer"},
}
"""Packages, and what they must not import."""


def imported(file: Path) -> set[str]:
    """Packages of ours that a file names, at its top or inside of a function."""
    here = file.relative_to(ROOT).parts[:-1]
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            whole = [*here[: len(here) - node.level + 1], *(node.module or "").split(".")]
            names = [alias.name for alias in node.names] if not whole[0] else [whole[0]]
            found |= set(names)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("fprf."):
            found.add((node.module or "").split(".")[1])
        elif isinstance(node, ast.Import):
            found |= {alias.name.split(".")[1] for alias in node.names if alias.name.startswith("fprf.")}
    return found


@pytest.mark.parametrize("package", list(ABOVE))
def test_imports_point_downwards(package: str) -> None:
    files = list((ROOT / package).rglob("*.py"))
    assert files
    breaches = {str(file.relative_to(ROOT)): sorted(wrong) for file in files if (wrong := imported(file) & ABOVE[package])}
    assert not breaches
