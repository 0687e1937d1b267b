import urllib.error
from collections.abc import Iterator
from pathlib import Path

import pytest
from fake_packages import Packages, packages_in

from fprf.plugins.encoders import vgg


@pytest.fixture
def packages(tmp_path: Path) -> Iterator[Packages]:
    folder = tmp_path / "site"
    folder.mkdir()
    with packages_in(folder) as found:
        yield found


@pytest.fixture
def home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A home of its own, and no network."""

    def refuse(*_: object, **__: object) -> None:
        raise urllib.error.URLError("no network in tests")

    monkeypatch.setattr(vgg.urllib.request, "urlopen", refuse)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return tmp_path / "home"
