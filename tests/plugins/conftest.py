from collections.abc import Iterator
from pathlib import Path

import pytest
from fake_packages import Packages, packages_in


@pytest.fixture
def packages(tmp_path: Path) -> Iterator[Packages]:
    folder = tmp_path / "site"
    folder.mkdir()
    with packages_in(folder) as found:
        yield found
