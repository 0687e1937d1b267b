"""The pinned versions must be installable together with every extra: what is declared, and what installed
packages want.
"""

import importlib.metadata as metadata
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
LINES = [
    line for line in (ROOT / "constraints.txt").read_text().splitlines() if line and not line.startswith("#")
]
PINS = {canonicalize_name(line.partition("==")[0]): line.partition("==")[2] for line in LINES}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PARTS = (PROJECT["dependencies"], *PROJECT["optional-dependencies"].values())
DECLARED = [Requirement(text) for part in PARTS for text in part]


def wanted(name: str) -> list[Requirement]:
    """What an installed package needs on this machine, extras left out."""
    try:
        texts = metadata.requires(name) or []
    except metadata.PackageNotFoundError:
        return []
    found = [Requirement(text) for text in texts]
    return [each for each in found if each.marker is None or each.marker.evaluate({"extra": ""})]


def test_every_line_is_one_version() -> None:
    assert len(PINS) == len(LINES) and all(version for version in PINS.values())


@pytest.mark.parametrize("need", [need for need in DECLARED if need.name != PROJECT["name"]], ids=str)
def test_what_is_declared_is_pinned_and_the_pin_is_allowed(need: Requirement) -> None:
    assert need.specifier.contains(PINS[canonicalize_name(need.name)])


@pytest.mark.parametrize("name", sorted(PINS))
def test_no_pinned_package_refuses_the_pin_of_another(name: str) -> None:
    for need in wanted(name):
        pin = PINS.get(canonicalize_name(need.name))
        assert pin is None or need.specifier.contains(pin), f"{name} needs {need}, pinned is {pin}"
