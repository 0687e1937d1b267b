"""Training batches: pure in (seed, step), uniform over the pixels that masks leave, right at every pixel,
through points.
"""

import errno
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from capture_files import cameras_of, write_image
from hypothesis import given
from hypothesis import strategies as st
from tiny_world import World

import fprf.datamanagers.batches as pixel_file
from fprf.datamanagers.batches import PixelRuns, RayBatches, allocate_pixels
from fprf.datamanagers.config import FeatureTargets, RayBatchesConfig, TrainingPixels
from fprf.datamanagers.scene import ParsedScene
from fprf.errors import DataError
from fprf.plugins.encoders.config import RandomConfig
from fprf.rendering.cameras import rays_through

SIZES = [(24, 16), (30, 20), (18, 26), (24, 16), (12, 10)]
"""Width, height; views 0, 2, 3, 4 are for training."""


@pytest.fixture
def scene(tmp_path: Path) -> ParsedScene:
    """A scene of PNG files of noise."""
    for view, size in enumerate(SIZES):
        write_image(tmp_path / f"{view}.png", size, seed=view)
    return ParsedScene(
        name="noise",
        paths=tuple(tmp_path / f"{view}.png" for view in range(len(SIZES))),
        cameras=cameras_of(
            torch.eye(4, dtype=torch.float64)[:3].repeat(len(SIZES), 1, 1), SIZES, (20.0, 20.0)
        ),
        train=torch.tensor([0, 2, 3, 4]),
        test=torch.tensor([1]),
    )


def write_mask(path: Path, pixels: np.ndarray) -> Path:
    assert cv2.imwrite(str(path), pixels)
    return path


def make(
    scene: ParsedScene,
    cache: Path,
    *,
    seed: int = 0,
    content: bool = False,
    semantic: bool = False,
    **fields: Any,
) -> RayBatches:
    config = RayBatchesConfig(**{"rays": 512} | fields)
    encoders = (RandomConfig(channels=3, stride=2).build(), RandomConfig(channels=6, stride=4).build())
    one, two = (
        encoder if asked else None for encoder, asked in zip(encoders, (content, semantic), strict=True)
    )
    targets = FeatureTargets(content=one, semantic=two, dim=4)
    return RayBatches(config, TrainingPixels(scene=scene), targets, cache=cache, seed=seed)


def test_colours_are_those_of_the_files_at_the_pixel_centres(scene: ParsedScene, tmp_path: Path) -> None:
    images = [cv2.imread(str(path))[..., ::-1].copy() for path in scene.paths]
    batch = make(scene, tmp_path).batch(0)
    assert batch.view.dtype == torch.int64 and batch.rgb.dtype == torch.float32
    assert batch.content is None and batch.semantic is None
    assert set(batch.view.tolist()) == {0, 2, 3, 4}
    for view, (x, y), rgb in zip(batch.view.tolist(), batch.pixel.tolist(), batch.rgb, strict=True):
        assert x % 1 == 0.5 and y % 1 == 0.5
        assert torch.equal(rgb, torch.from_numpy(images[view])[int(y), int(x)].float() / 255)


def test_a_batch_is_a_function_of_seed_and_step(scene: ParsedScene, tmp_path: Path) -> None:
    one = make(scene, tmp_path, content=True, semantic=True)
    torch.randn(7)
    two = make(scene, tmp_path, content=True, semantic=True)
    for _ in range(3):
        two.batch(5)
    before = torch.get_rng_state()
    for a, b in zip(one.batch(7), two.batch(7), strict=True):
        assert (a is None and b is None) or torch.equal(a, b)
    assert torch.equal(before, torch.get_rng_state())
    assert not torch.equal(one.batch(7).pixel, one.batch(8).pixel)
    assert not torch.equal(one.batch(7).pixel, make(scene, tmp_path, seed=1).batch(7).pixel)


def test_every_training_pixel_is_as_likely(scene: ParsedScene, tmp_path: Path) -> None:
    batch = make(scene, tmp_path, rays=200_000).batch(3)
    flat = batch.view * 10_000 + batch.pixel[:, 1].long() * 100 + batch.pixel[:, 0].long()
    _, counts = flat.unique(return_counts=True)
    total = sum(w * h for v, (w, h) in enumerate(SIZES) if v != 1)
    expected = 200_000 / total
    assert len(counts) == total
    # Chi-squared over `total` cells: mean total, deviation sqrt(2 total); five of those.
    assert abs(float(((counts - expected) ** 2 / expected).sum()) - total) <= 5 * (2 * total) ** 0.5


@pytest.mark.parametrize(("share", "expected"), [(1.0, 512), (0.25, 128), (0.001, 1), (0.0, None)])
def test_the_share_of_semantic_rays(
    scene: ParsedScene, tmp_path: Path, share: float, expected: int | None
) -> None:
    manager = make(scene, tmp_path, semantic_share=share, content=True, semantic=True)
    batch = manager.batch(2)
    assert batch.content is not None and batch.content.shape == (512, 3)
    if expected is None:
        assert batch.semantic is None
        return
    assert batch.semantic is not None and batch.semantic.shape == (expected, 4)
    store = manager.semantic_store
    assert store is not None and store.basis is not None
    assert torch.equal(
        batch.semantic, store.at(batch.view[:expected], batch.pixel[:expected], batch.rgb[:expected])
    )


MASKS = st.lists(st.lists(st.booleans(), min_size=1, max_size=12), max_size=5)


@given(MASKS, st.integers(0, 7))
def test_runs_are_the_list(masks: list[list[bool]], first: int) -> None:
    parts = []
    start = first
    wanted = []
    for mask in masks:
        parts.append((start, torch.tensor(mask)))
        wanted += [start + k for k, each in enumerate(mask) if each]
        start += len(mask)
    runs = PixelRuns.of(parts)
    assert len(runs) == len(wanted)
    assert runs.pick(torch.arange(len(wanted))).tolist() == wanted
    everything = torch.arange(start + 3)
    assert everything[runs.holds(everything)].tolist() == wanted


def test_on_a_full_disk_pixels_stay_in_memory_where_that_holds_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(file: int, offset: int, size: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(pixel_file.os, "posix_fallocate", full, raising=False)
    pixels = allocate_pixels(1000, tmp_path, held=0)
    assert pixels.shape == (1000, 3) and not list(tmp_path.iterdir())
    assert f"{tmp_path}: No space left" in capsys.readouterr().err
    monkeypatch.setattr(pixel_file, "available_memory", lambda: 5999)
    with pytest.raises(DataError, match="No space left"):
        allocate_pixels(1000, tmp_path, held=0)


def test_marked_rays_pass_their_points_at_the_distance_told(world: World, tmp_path: Path) -> None:
    scene = world.prepared.scene
    assert scene.points is not None
    # Points that any view may see.
    batch = make(replace(scene, seen=None), tmp_path, rays=64, depth_share=0.25).batch(7)
    assert batch.distance is not None
    known = torch.isfinite(batch.distance)
    assert known.tolist() == [False] * 48 + [True] * 16
    origin, direction = rays_through(scene.cameras, batch.view[known], batch.pixel[known])
    end = origin + direction * batch.distance[known].double()[:, None]
    # Points lie anywhere in the pixel, rays in its middle: half a diagonal of a pixel away at most.
    apart = torch.cdist(end, scene.points).amin(1)
    pixel = batch.distance[known].double() / scene.cameras.focal[batch.view[known], 0]
    assert bool((apart <= 0.75 * pixel + 1e-6).all())


def test_points_of_a_reconstruction_count_where_two_views_saw_them(world: World, tmp_path: Path) -> None:
    scene = world.prepared.scene
    first, second = scene.train.tolist()[:2]
    held = int(scene.test[0])
    both = torch.tensor([[first, 0], [second, 0]])
    alone = torch.tensor(
        [[first, point] for point in range(1, 50)] + [[held, point] for point in range(1, 50)]
    )
    pairs, wanted, none = (
        make(replace(scene, seen=seen), tmp_path, rays=64, depth_share=0.5).batch(0).distance
        for seen in (torch.cat([both, alone]), both, alone)
    )
    assert pairs is not None and wanted is not None and none is None
    torch.testing.assert_close(pairs, wanted, equal_nan=True)


def test_pixels_that_are_left_out_are_never_drawn(scene: ParsedScene, tmp_path: Path) -> None:
    allowed = [
        np.random.default_rng(9 + view).random((height, width)) > 0.7
        for view, (width, height) in enumerate(SIZES)
    ]
    paths = [
        write_mask(tmp_path / f"mask{view}.png", np.uint8(255) * mask) for view, mask in enumerate(allowed)
    ]
    masked = replace(scene, masks=(paths[0], None, paths[2], None, paths[4]))
    batch = make(masked, tmp_path, rays=60_000).batch(0)
    seen = {view: np.zeros_like(mask) for view, mask in enumerate(allowed)}
    for view, (x, y) in zip(batch.view.tolist(), batch.pixel.long().tolist(), strict=True):
        seen[view][y, x] = True
    for view in (0, 2, 4):
        assert np.array_equal(seen[view], allowed[view])
    assert seen[3].all() and batch.sky is None
    sky = make(replace(scene, sky_masks=(paths[0], None, None, None, None)), tmp_path, rays=3000).batch(0)
    places = zip(sky.view.tolist(), sky.pixel.long().tolist(), strict=True)
    wanted = [view == 0 and bool(allowed[0][y, x]) for view, (x, y) in places]
    assert sky.sky is not None and sky.sky.tolist() == wanted and any(wanted)
    ours, theirs = (make(each, tmp_path, masks=False).batch(1) for each in (masked, scene))
    assert torch.equal(ours.pixel, theirs.pixel)


def test_scenes_that_leave_nothing_to_learn_are_refused(scene: ParsedScene, tmp_path: Path) -> None:
    dark = tuple(
        write_mask(tmp_path / f"n{k}.png", np.zeros((h, w), np.uint8)) for k, (w, h) in enumerate(SIZES)
    )
    other = write_mask(tmp_path / "m.png", np.ones((40, 10), np.uint8))
    for wrong in ({"train": scene.train[:0]}, {"masks": dark}, {"masks": (other,) * len(SIZES)}):
        with pytest.raises(DataError):
            make(replace(scene, **wrong), tmp_path)  # type: ignore[arg-type]
