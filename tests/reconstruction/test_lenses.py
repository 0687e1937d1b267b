"""Lenses of images without EXIF: by clusters of focal lengths, by names, by residuals; two of them by the real COLMAP."""

import json
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from fprf.cli import main as cli
from fprf.datamanagers.parsers.config import parse_scene
from fprf.reconstruction.images import read_encoder
from fprf.reconstruction.lenses import (
    Grouping,
    Trial,
    better_models,
    choose_trial,
    cluster_values,
    clustered_groupings,
    hinted_groupings,
    own_lenses,
    shared_lenses,
    unsaid_lenses,
)


def images(*names: str, lens: tuple[str, float, int] = ("", 0.0, 0), **more: Any) -> dict[str, Any]:
    return {name: {"width": 640, "height": 480, "lens": list(lens), **more} for name in names}


def groups(lenses: Mapping[str, str]) -> set[frozenset[str]]:
    found: dict[str, set[str]] = {}
    for name, lens in lenses.items():
        found.setdefault(lens, set()).add(name)
    return {frozenset(each) for each in found.values()}


@settings(deadline=None)
@given(st.integers(0, 999), st.integers(3, 20), st.integers(3, 20), st.floats(1.07, 3.0))
def test_two_lenses_are_two_clusters(seed: int, one: int, other: int, ratio: float) -> None:
    drawn = np.random.default_rng(seed)
    place = drawn.permutation(one + other)
    value = np.log(np.where(place < one, 600.0, 600.0 * ratio))
    found = cluster_values(value + drawn.uniform(-0.005, 0.005, len(value)), 2)
    assert found is not None and np.array_equal(found == 1, place >= one)


def test_one_lens_is_no_two_clusters() -> None:
    taken = 0
    for seed in range(200):
        drawn = np.random.default_rng(seed)
        for spread in (drawn.uniform(-0.2, 0.2, 60), drawn.normal(0, 0.1, 60)):
            taken += cluster_values(np.log(600.0) + spread, 2) is not None
    assert taken <= 1


def test_three_clusters_and_too_few_images() -> None:
    value = np.log(np.repeat([13.0, 26.0, 77.0], 4)) + np.tile([0.0, 0.003, -0.002, 0.001], 3)
    found = cluster_values(value, 3)
    assert found is not None and found.tolist() == [0] * 4 + [1] * 4 + [2] * 4
    assert cluster_values(np.log([600.0, 600.0, 600.0, 800.0, 800.0]), 2) is None, "two of one lens"
    assert cluster_values(np.zeros(0), 2) is None


def test_only_what_says_no_focal_length_is_in_question() -> None:
    known = images(*[f"k{k}.jpg" for k in range(9)], lens=("Phone 9", 4.2, 26))
    unsaid = images(*[f"u{k}.jpg" for k in range(6)])
    few = {name: {**row, "width": 480} for name, row in images("f0.jpg", "f1.jpg").items()}
    everything = {**known, **unsaid, **few}
    assert unsaid_lenses(everything) == list(unsaid)
    assert groups(shared_lenses(everything)) == {frozenset(known), frozenset(unsaid), frozenset(few)}
    assert own_lenses(everything).count == 2 + 6
    focal = dict(zip(unsaid, [600, 602, 601, 779, 780, 781], strict=True)) | dict.fromkeys(known, 500.0)
    (found,) = clustered_groupings(everything, focal)
    assert groups(found.lenses) == {
        frozenset(known), frozenset(few), frozenset(list(unsaid)[:3]), frozenset(list(unsaid)[3:])
    }  # fmt: skip


def test_names_folders_and_encoders_hint_at_cameras(tmp_path: Path) -> None:
    anna = [f"anna_{k}.jpg" for k in range(4)]
    ben = [f"ben_{k}.jpg" for k in range(5)]
    found = hinted_groupings(images(*anna, *ben))
    assert [each.reason for each in found] == ["names"]
    assert groups(found[0].lenses) == {frozenset(anna), frozenset(ben)}
    found = hinted_groupings(images(*[f"a/{k}.jpg" for k in range(4)], *[f"b/{k}.jpg" for k in range(3)]))
    assert [each.reason for each in found] == ["folders"]
    pixels = np.random.default_rng(0).integers(0, 255, (16, 16, 3), dtype=np.uint8)
    for name, options in {"a": {"quality": 80}, "b": {"quality": 80}, "c": {"quality": 91}}.items():
        Image.fromarray(pixels).save(tmp_path / f"{name}.jpg", **options)
    Image.fromarray(pixels).save(tmp_path / "d.png")
    one, same, other, none = (read_encoder(tmp_path / name) for name in ("a.jpg", "b.jpg", "c.jpg", "d.png"))
    assert one == same != other and one and not none
    mixed = images(*[f"{k}.jpg" for k in range(3)], encoder=one)
    mixed |= images(*[f"{k}.jpg" for k in range(3, 6)], encoder=other)
    assert [each.reason for each in hinted_groupings(mixed)] == ["encoders"]
    assert hinted_groupings(images(*[f"{k}.jpg" for k in range(9)])) == []


def trial(count: int, error: float) -> Trial:
    lenses = {f"{k}.jpg": str(k % count) for k in range(60)}
    return Trial(grouping=Grouping(lenses=lenses, reason="test"), error=error, focal={})


@pytest.mark.parametrize(
    ("trials", "count"),
    [
        ([(1, 0.83), (60, 0.59), (2, 0.59), (3, 0.585)], 2),  # two lenses
        ([(1, 0.593), (60, 0.592), (2, 0.593)], 1),  # one
        ([(1, 0.307), (60, 0.249)], 1),  # a lens an image fits noise
        ([(1, 0.9), (60, 0.33), (2, 0.7)], 60),  # a zoom
        ([(1, 0.9), (2, 0.7), (3, 0.4), (60, 0.39)], 3),
    ],
)
def test_more_lenses_are_believed_where_the_error_falls_clearly(
    trials: list[tuple[int, float]], count: int
) -> None:
    assert choose_trial([trial(*each) for each in trials]).grouping.count == count


def test_the_better_reconstruction_is_kept() -> None:
    def model(posed: int, error: float) -> list[dict[str, Any]]:
        return [{"images": [str(k) for k in range(posed)], "error_pixels": error}]

    assert better_models(model(20, 0.69), model(20, 0.33))
    assert not better_models(model(20, 0.33), model(20, 0.325))
    assert not better_models(model(20, 0.69), model(12, 0.2))
    assert better_models(model(12, 0.3), model(20, 0.4))
    assert not better_models(model(3, 0.3), [])


def wall_and_floor(place: tuple[float, float, float], focal: float, seed: int = 0) -> np.ndarray:
    """A view of a textured wall (z = 0) and floor (y = 1.2, down), 400 x 300 pixels, of a camera that looks at
    the middle of both.
    """
    width, height = 400, 300
    drawn = np.random.default_rng(seed)
    texture = np.zeros((2, 720, 720, 3))
    for cells in (20, 60, 180, 360):
        coarse = drawn.uniform(-60, 60, (2, cells, cells, 3))
        texture += coarse.repeat(720 // cells, 1).repeat(720 // cells, 2)
    eye = np.array(place)
    ahead = np.array([0.1, 0.3, -0.3]) - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross([0, 1.0, 0], ahead)
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(ahead, right), ahead])
    # Four rays a pixel, so that no texture flickers.
    v, u = np.mgrid[0 : 2 * height, 0 : 2 * width] / 2 + 0.25
    rays = np.stack([(u - width / 2) / focal, (v - height / 2) / focal, np.ones_like(u)], -1) @ turn
    with np.errstate(divide="ignore"):
        wall = -eye[2] / rays[..., 2]
        floor = (1.2 - eye[1]) / rays[..., 1]
    wall[wall <= 0] = np.inf
    floor[floor <= 0] = np.inf
    point = eye + rays * np.minimum(wall, floor)[..., None]
    column = ((point[..., 0] + 3) / 6 * 720).clip(0, 719).astype(int)
    row = np.where(wall < floor, point[..., 1] + 3, point[..., 2] + 6) / 6 * 720
    seen = texture[(wall >= floor).astype(int), row.clip(0, 719).astype(int), column] + 128
    return seen.reshape(height, 2, width, 2, 3).mean((1, 3)).clip(0, 255).astype(np.uint8)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is not installed")
@pytest.mark.parametrize("focal", [(360.0, 460.0), (280.0, 560.0)])
def test_two_phones_of_one_size_get_a_lens_each(tmp_path: Path, focal: tuple[float, float]) -> None:
    source = tmp_path / "photos"
    source.mkdir()
    truth = []
    for k in range(16):
        place = (-1.3 + 2.6 * k / 15, -0.2 + 0.15 * (k % 3), -3.5 + 0.25 * (k // 2 % 2))
        truth.append(place)
        picture = Image.fromarray(wall_and_floor(place, focal[k % 2]))
        picture.save(source / f"IMG-WA{k:04d}.jpg", quality=92)
    scene = tmp_path / "scene"
    assert cli.main(["process", str(source), "--output", str(scene)]) == 0
    found = parse_scene(scene, 1, None)
    assert len(found.paths) == 16
    for k, path in enumerate(found.paths):
        number = int(path.stem[-4:])
        assert float(found.cameras.focal[k, 0]) == pytest.approx(focal[number % 2], rel=0.01)
    # Places after the similarity that brings them closest.
    a = found.cameras.pose[:, :, 3].double().numpy()
    b = np.array([truth[int(path.stem[-4:])] for path in found.paths])
    a -= a.mean(0)
    b -= b.mean(0)
    u, size, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    moved = (size * sign).sum() / (a**2).sum() * a @ (u * sign @ vt).T
    assert np.linalg.norm(moved - b, axis=1).max() < 0.02
    notes = json.loads((scene / "process.json").read_text())["notes"]
    assert sum(note.startswith("lenses: 2") for note in notes) == 1
