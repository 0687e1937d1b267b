from pathlib import Path

import pytest
from photo_folder import photo_folder


@pytest.fixture(scope="session")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of five photographs."""
    return photo_folder(tmp_path_factory.mktemp("photos") / "all", 5)
