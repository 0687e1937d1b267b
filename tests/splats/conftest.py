"""A small town, and Gaussians that are trained on it; a photograph for styles."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.town.write import write_town
from fprf.datamanagers.parsers.config import parse_scene
from fprf.datamanagers.scene import ParsedScene
from fprf.splats.config import GaussiansConfig


@pytest.fixture(scope="session")
def config(tmp_path_factory: pytest.TempPathFactory) -> GaussiansConfig:
    town = tmp_path_factory.mktemp("splats") / "town"
    write_town(town, seed=0, palette="day", views=10, width=32, height=24)
    small = GaussiansConfig(data=town, initial=300, cap=600, surroundings=50, pixels_per_gaussian=1)
    return replace(small, relocate_every=20, degree=1)


@pytest.fixture(scope="session")
def scene(config: GaussiansConfig) -> ParsedScene:
    return parse_scene(config.data, 1, None)


@pytest.fixture
def photograph(tmp_path: Path) -> Path:
    noise = np.random.default_rng(0).integers(0, 120, (64, 96, 3), np.uint8)
    noise[:32] += 100
    cv2.imwrite(str(tmp_path / "style.png"), noise)
    return tmp_path / "style.png"
