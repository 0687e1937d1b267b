"""A small town, and Gaussians that are trained on it."""

from dataclasses import replace

import pytest

from benchmarks.town.write import write_town
from fprf.datamanagers.parsers.config import parse_scene
from fprf.datamanagers.scene import Scene
from fprf.splats.config import GaussiansConfig


@pytest.fixture(scope="session")
def config(tmp_path_factory: pytest.TempPathFactory) -> GaussiansConfig:
    town = tmp_path_factory.mktemp("splats") / "town"
    write_town(town, seed=0, palette="day", views=10, width=32, height=24)
    small = GaussiansConfig(data=town, initial=300, cap=600, surroundings=50, pixels_per_gaussian=1)
    return replace(small, relocate_every=20, degree=1)


@pytest.fixture(scope="session")
def scene(config: GaussiansConfig) -> Scene:
    return parse_scene(config.data, 1, None)
