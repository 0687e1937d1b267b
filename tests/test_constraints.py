"""The pinned versions must be installable together with every extra: what is declared, and what installed
packages want.
"""

import importlib.metadata as metadata
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[1]


def pins(name: str) -> dict[str, str]:
    """Package to version of a file of constraints, each line of which is one version."""
    found = {}
    for line in (ROOT / name).read_text().splitlines():
        if line and not line.startswith("#"):
            package, equal, version = line.partition("==")
            assert equal and version and canonicalize_name(package) not in found, line
            found[canonicalize_name(package)] = version
    return found


PINS = pins("constraints.txt")
LOWEST = pins("constraints-lowest.txt")
UNTESTED = ("docs", "dev", "cuda")
"""Extras that the lowest versions are not tested of."""
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


def installed(name: str) -> str | None:
    try:
        return metadata.version(name).partition("+")[0]
    except metadata.PackageNotFoundError:
        return None


@pytest.mark.parametrize("need", [need for need in DECLARED if need.name != PROJECT["name"]], ids=str)
def test_what_is_declared_is_pinned_and_the_pin_is_allowed(need: Requirement) -> None:
    assert need.specifier.contains(PINS[canonicalize_name(need.name)])


def test_the_lowest_versions_are_the_floors_of_what_is_declared() -> None:
    extras = PROJECT["optional-dependencies"]
    parts = [PROJECT["dependencies"], *(extras[name] for name in extras if name not in UNTESTED)]
    floors = {}
    for part in parts:
        for text in part:
            need = Requirement(text)
            (floor,) = (each.version for each in need.specifier if each.operator == ">=")
            floors[canonicalize_name(need.name)] = floor
    assert floors.keys() == LOWEST.keys()
    for name, floor in floors.items():
        assert Version(floor) == Version(LOWEST[name]), name


@pytest.mark.parametrize("name", sorted(PINS))
def test_no_pinned_package_refuses_the_pin_of_another(name: str) -> None:
    if installed(name) != PINS[name]:
        pytest.skip(f"{name} {PINS[name]} is not installed: what it wants isn't known")
    for need in wanted(name):
        pin = PINS.get(canonicalize_name(need.name))
        assert pin is None or need.specifier.contains(pin), f"{name} needs {need}, pinned is {pin}"
