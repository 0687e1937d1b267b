"""Training batches: pure in (seed, step), uniform over pixels, right at every pixel."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from pretend_cuda import CUDA, pretend_cuda
from torch import Tensor

from fprf.datamanagers.batches import RayBatches, generator_of
from fprf.datamanagers.config import RayBatchesConfig
from fprf.datamanagers.scene import Scene
from fprf.errors import DataError
from fprf.interfaces import Encoder
from fprf.plugins.encoders.config import RandomConfig
from fprf.rendering.cameras import Cameras

SIZES = [(24, 16), (30, 20), (18, 26), (24, 16), (12, 10)]
"""Width, height; views 0, 2, 3, 4 are for training."""


def make_scene(folder: Path, channels: int = 3) -> tuple[Scene, list[np.ndarray]]:
    """A scene of PNG files of noise, and the files as RGB(A)."""
    images, paths = [], []
    for view, (width, height) in enumerate(SIZES):
        image = np.random.default_rng(view).integers(0, 256, (height, width, channels), dtype=np.uint8)
        paths.append(folder / f"{view}.png")
        assert cv2.imwrite(str(paths[-1]), image)
        images.append(image[..., [2, 1, 0, 3][:channels]])
    count = len(SIZES)
    cameras = Cameras(
        pose=torch.eye(4, dtype=torch.float64)[:3].repeat(count, 1, 1),
        focal=torch.full((count, 2), 20.0, dtype=torch.float64),
        centre=torch.tensor(SIZES, dtype=torch.float64) / 2,
        size=torch.tensor(SIZES),
        distortion=torch.zeros(count, 6, dtype=torch.float64),
        lens=torch.zeros(count, dtype=torch.long),
    )
    scene = Scene(
        name="noise",
        paths=tuple(paths),
        cameras=cameras,
        train=torch.tensor([0, 2, 3, 4]),
        test=torch.tensor([1]),
        alpha=channels == 4,
    )
    return scene, images


def make(
    scene: Scene,
    cache: Path,
    *,
    seed: int = 0,
    rays: int = 512,
    share: float = 1.0,
    content: Encoder | None = None,
    semantic: Encoder | None = None,
) -> RayBatches:
    config = RayBatchesConfig(rays=rays, semantic_share=share)
    return RayBatches(config, scene=scene, content=content, semantic=semantic, dim=4, cache=cache, seed=seed)


def same(one: Tensor | None, two: Tensor | None) -> bool:
    return (one is None and two is None) or (one is not None and two is not None and torch.equal(one, two))


def test_colours_are_those_of_the_files_at_the_pixel_centres(tmp_path: Path) -> None:
    scene, images = make_scene(tmp_path)
    batch = make(scene, tmp_path).batch(0)
    assert batch.view.dtype == torch.int64 and batch.rgb.dtype == torch.float32
    assert batch.content is None and batch.semantic is None
    assert set(batch.view.tolist()) == {0, 2, 3, 4}
    for view, (x, y), rgb in zip(batch.view.tolist(), batch.pixel.tolist(), batch.rgb, strict=True):
        assert x % 1 == 0.5 and y % 1 == 0.5
        assert torch.equal(rgb, torch.from_numpy(images[view][int(y), int(x)].copy()).float() / 255)


def test_a_batch_is_a_function_of_seed_and_step(tmp_path: Path) -> None:
    scene, _ = make_scene(tmp_path)
    content, semantic = RandomConfig(channels=3, stride=2).build(), RandomConfig(channels=6, stride=4).build()
    one = make(scene, tmp_path, content=content, semantic=semantic)
    torch.randn(7)
    two = make(scene, tmp_path, content=content, semantic=semantic)
    for _ in range(3):
        two.batch(5)
    assert all(same(a, b) for a, b in zip(one.batch(7), two.batch(7), strict=True))
    assert not torch.equal(one.batch(7).pixel, one.batch(8).pixel)
    assert not torch.equal(one.batch(7).pixel, make(scene, tmp_path, seed=1).batch(7).pixel)
    before = torch.get_rng_state()
    one.batch(1)
    assert torch.equal(before, torch.get_rng_state())


def test_generators_of_neighbours_share_nothing() -> None:
    draws = {int(torch.randint(1 << 62, (), generator=generator_of(s, t))) for s in range(20) for t in range(20)}
    assert len(draws) == 400


def test_every_training_pixel_is_as_likely(tmp_path: Path) -> None:
    scene, _ = make_scene(tmp_path)
    batch = make(scene, tmp_path, rays=200_000).batch(3)
    flat = batch.view * 10_000 + batch.pixel[:, 1].long() * 100 + batch.pixel[:, 0].long()
    _, counts = flat.unique(return_counts=True)
    total = sum(w * h for v, (w, h) in enumerate(SIZES) if v != 1)
    expected = 200_000 / total
    assert len(counts) == total
    # Chi-squared over `total` cells: mean total, deviation sqrt(2 total); five of those.
    assert abs(float(((counts - expected) ** 2 / expected).sum()) - total) <= 5 * (2 * total) ** 0.5


@pytest.mark.parametrize(("share", "expected"), [(1.0, 512), (0.25, 128), (0.001, 1), (0.0, None)])
def test_the_share_of_semantic_rays(tmp_path: Path, share: float, expected: int | None) -> None:
    scene, _ = make_scene(tmp_path)
    content, semantic = RandomConfig(channels=3, stride=2).build(), RandomConfig(channels=6, stride=4).build()
    manager = make(scene, tmp_path, share=share, content=content, semantic=semantic)
    batch = manager.batch(2)
    assert batch.content is not None and batch.content.shape == (512, 3)
    if expected is None:
        assert batch.semantic is None
        return
    assert batch.semantic is not None and batch.semantic.shape == (expected, 4)
    store = manager.semantic_store
    assert store is not None and store.basis is not None
    assert torch.equal(batch.semantic, store.at(batch.view[:expected], batch.pixel[:expected], batch.rgb[:expected]))


def test_images_of_all_views(tmp_path: Path) -> None:
    scene, images = make_scene(tmp_path)
    manager = make(scene, tmp_path)
    assert manager.background is None
    for view, image in enumerate(images):
        assert torch.equal(manager.image(view), torch.from_numpy(image.copy()).float() / 255)


def test_transparency_shows_white(tmp_path: Path) -> None:
    scene, images = make_scene(tmp_path, channels=4)
    manager = make(scene, tmp_path)
    assert manager.background == (1.0, 1.0, 1.0)
    for view in (0, 1):
        alpha = images[view][..., 3:] / 255
        expected = torch.from_numpy(images[view][..., :3] / 255 * alpha + 1 - alpha).float()
        assert (manager.image(view) - expected).abs().max() <= 0.51 / 255


@pytest.mark.parametrize("channels", [3, 4])
def test_transparency_shows_the_background_that_is_given(tmp_path: Path, channels: int) -> None:
    scene, images = make_scene(tmp_path, channels=channels)
    given = (0.2, 0.0, 1.0)
    config = RayBatchesConfig(rays=64)
    manager = config.build(scene=scene, content=None, semantic=None, dim=4, cache=tmp_path, seed=0, background=given)
    batch = manager.batch(0)
    for view in range(len(SIZES)):
        alpha = images[view][..., 3:] / 255 if channels == 4 else np.ones((*images[view].shape[:2], 1))
        expected = torch.from_numpy(images[view][..., :3] / 255 * alpha + np.array(given) * (1 - alpha)).float()
        assert (manager.image(view) - expected).abs().max() <= 0.51 / 255
        for pixel, rgb in zip(batch.pixel[batch.view == view].long(), batch.rgb[batch.view == view], strict=True):
            assert (rgb - expected[pixel[1], pixel[0]]).abs().max() <= 0.51 / 255


def test_features_are_made_for_training_views_only(tmp_path: Path) -> None:
    scene, _ = make_scene(tmp_path)
    told: list[int] = []
    manager = RayBatches(
        RayBatchesConfig(),
        scene=scene,
        content=RandomConfig(channels=3, stride=2).build(),
        semantic=None,
        dim=4,
        cache=tmp_path / "cache",
        seed=0,
        progress=lambda done, total, what: told.append(total),
    )
    assert set(told) == {4} and manager.semantic_store is None
    assert manager.content_store is not None and manager.content_store.channels == 3
    assert len(list((tmp_path / "cache" / "content").glob("*.safetensors"))) == 4


def test_a_scene_without_training_views_is_refused(tmp_path: Path) -> None:
    scene, _ = make_scene(tmp_path)
    empty = Scene(
        name="empty", paths=scene.paths, cameras=scene.cameras, train=torch.zeros(0, dtype=torch.long), test=scene.train
    )
    with pytest.raises(DataError, match="empty: no training views"):
        make(empty, tmp_path)


def test_a_device_draws_what_the_host_draws(tmp_path: Path) -> None:
    """Pixels, colours, features, masks, sky and depths; its generator is the CPU's here, which on a card is another one."""
    scene, _ = make_scene(tmp_path)
    masks = tuple(tmp_path / f"half-{view}.png" for view in range(len(SIZES)))
    for mask, (width, height) in zip(masks, SIZES, strict=True):
        half = np.zeros((height, width), np.uint8)
        half[: height // 2 + 1] = 255
        assert cv2.imwrite(str(mask), half)
    points = torch.tensor([[0.1, 0.2, -2.0], [-0.3, 0.1, -3.0], [0.0, 0.0, -1.0]], dtype=torch.float64)
    scene = replace(scene, masks=masks, sky_masks=(None, None, *masks[2:]), points=points)
    config = RayBatchesConfig(rays=200, semantic_share=0.5, depth_share=0.2)
    encoder = RandomConfig().build()
    manager = RayBatches(config, scene=scene, content=encoder, semantic=encoder, dim=4, cache=tmp_path, seed=3)
    with pretend_cuda() as seen:
        assert manager.to(CUDA, room=manager.held_bytes - 1) is manager is manager.to(torch.device("mps"), room=1 << 40)
        there = manager.to(CUDA, room=manager.held_bytes)
        seen.syncs.clear()
        seen.uploads.clear()
        for step in (0, 7):
            found = there.batch(step)
            assert not seen.syncs and not seen.uploads
            here = manager.batch(step)
            for name, value, other in zip(found._fields, found, here, strict=True):
                assert value.device == CUDA and other.device.type == "cpu"
                if name in ("content", "semantic"):
                    assert (value.cpu() - other).abs().max() <= 1e-5 * other.abs().max()
                else:
                    assert torch.equal(value.cpu().nan_to_num(-1.0), other.nan_to_num(-1.0)), name
            seen.syncs.clear()
        assert torch.equal(there.image(2), manager.image(2)), "views stay in host memory"
