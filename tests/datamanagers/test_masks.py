"""Masks: found beside images or by name, read as what they mean, and what they leave out is never drawn or judged."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from capture_files import Capture, write_colmap, write_image, write_transforms
from test_batches import SIZES, make, make_scene

from fprf.datamanagers.config import RayBatchesConfig
from fprf.datamanagers.images import load_mask
from fprf.datamanagers.parsers.config import ColmapConfig, PhotoTourismConfig, TransformsConfig
from fprf.datamanagers.parsers.views import masks_beside
from fprf.errors import DataError


def write_mask(path: Path, pixels: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels)
    return path


@pytest.mark.parametrize("name", ["{}.png.png", "{}.png"])
def test_masks_beside_the_images_are_found(tmp_path: Path, name: str) -> None:
    write_transforms(tmp_path, Capture.make(5))
    write_mask(tmp_path / "masks" / name.format("0002"), np.zeros((16, 24), np.uint8))
    scene = TransformsConfig().build().parse(tmp_path, 1)
    assert scene.sky_masks == ()
    assert [path is not None for path in scene.masks] == [False, False, True, False, False]


def test_frames_name_their_masks(tmp_path: Path) -> None:
    content = write_transforms(tmp_path, Capture.make(4))
    frames = content["frames"]
    assert isinstance(frames, list)
    frames[1]["mask_path"], frames[3]["sky_mask_path"] = "people/a.png", "sky/b.png"
    write_mask(tmp_path / "people/a.png", np.ones((16, 24), np.uint8))
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match=r"b\.png"):
        TransformsConfig().build().parse(tmp_path, 1)
    write_mask(tmp_path / "sky/b.png", np.ones((16, 24), np.uint8))
    scene = TransformsConfig().build().parse(tmp_path, 1)
    assert scene.masks == (None, tmp_path / "people/a.png", None, None)
    assert scene.sky_masks == (None, None, None, tmp_path / "sky/b.png")
    frames[1]["mask_path"] = "../a.png"
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match="leaves"):
        TransformsConfig().build().parse(tmp_path, 1)


def test_folders_of_cameras_and_splits_have_theirs(tmp_path: Path) -> None:
    images = [
        tmp_path / "images/left/1.jpg",
        tmp_path / "images/right/1.jpg",
        tmp_path / "train/rgbs/7.jpg",
        Path("/other/8.jpg"),
    ]
    wanted = [
        write_mask(tmp_path / "masks/left/1.jpg.png", np.ones((2, 2), np.uint8)),
        None,
        write_mask(tmp_path / "train/masks/7.png", np.ones((2, 2), np.uint8)),
        None,
    ]
    assert list(masks_beside(tmp_path, images, "masks")) == wanted
    assert masks_beside(tmp_path, images, "sky_masks") == ()


def test_lists_of_photographs_keep_masks_with_their_views(tmp_path: Path) -> None:
    capture = Capture.make(4)
    write_colmap(tmp_path, capture)
    for name in capture.names:
        write_mask(tmp_path / "masks" / name, np.ones((16, 24), np.uint8))
    (tmp_path / "list.tsv").write_text(
        "filename\tid\tsplit\tdataset\n" + "".join(f"{n}\t{k}\ttrain\tx\n" for k, n in enumerate(capture.names) if k != 1)
    )
    whole = ColmapConfig().build().parse(tmp_path, 1)
    scene = PhotoTourismConfig().build().parse(tmp_path, 1)
    assert len(whole.masks) == 4 and scene.masks == (whole.masks[0], *whole.masks[2:])


@pytest.mark.parametrize(
    ("low", "high", "kind"), [(0, 255, np.uint8), (0, 1, np.uint8), (20, 200, np.uint8), (0, 65535, np.uint16)]
)
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_bright_is_true(tmp_path: Path, low: int, high: int, kind: type, channels: int) -> None:
    mask = np.random.default_rng(0).random((9, 7)) > 0.5
    pixels = np.repeat(np.where(mask, high, low)[..., None], channels, 2).astype(kind)
    path = write_mask(tmp_path / "m.png", pixels)
    assert np.array_equal(load_mask(path, (7, 9)), mask)
    double = load_mask(path, (14, 18))
    assert np.array_equal(double, mask.repeat(2, 0).repeat(2, 1))


def test_a_mask_of_another_shape_is_refused(tmp_path: Path) -> None:
    path = write_mask(tmp_path / "m.png", np.ones((40, 10), np.uint8))
    with pytest.raises(DataError, match="10x40 pixels do not fit an image of 60x40"):
        load_mask(path, (60, 40))


def test_pixels_that_are_left_out_are_never_drawn(tmp_path: Path) -> None:
    scene, _ = make_scene(tmp_path)
    allowed = [np.random.default_rng(9 + view).random((height, width)) > 0.7 for view, (width, height) in enumerate(SIZES)]
    paths = [write_mask(tmp_path / f"mask{view}.png", np.uint8(255) * mask) for view, mask in enumerate(allowed)]
    masked = replace(scene, masks=(paths[0], None, paths[2], None, paths[4]))
    batch = make(masked, tmp_path, rays=60_000).batch(0)
    seen = {view: np.zeros_like(mask) for view, mask in enumerate(allowed)}
    for view, (x, y) in zip(batch.view.tolist(), batch.pixel.long().tolist(), strict=True):
        seen[view][y, x] = True
    for view in (0, 2, 4):
        assert np.array_equal(seen[view], allowed[view])
    assert seen[3].all() and batch.sky is None
    plain = RayBatchesConfig(rays=64, masks=False)
    build = {"content": None, "semantic": None, "dim": 4, "cache": tmp_path, "seed": 0}
    ours, theirs = (plain.build(scene=each, **build).batch(1) for each in (masked, scene))  # type: ignore[arg-type]
    assert torch.equal(ours.pixel, theirs.pixel)


def test_a_block_s_pixels_are_masked_too(tmp_path: Path) -> None:
    scene, _ = make_scene(tmp_path)
    left = np.zeros((16, 24), np.uint8)
    left[:, :12] = 255
    path = write_mask(tmp_path / "left.png", left)

    def top(view: int) -> torch.Tensor:
        width, height = SIZES[view]
        return (torch.arange(height) < 4)[:, None].expand(height, width)

    masked = replace(scene, masks=(path, None, None, None, None))
    config = RayBatchesConfig(rays=4000)
    batch = config.build(scene=masked, content=None, semantic=None, dim=4, cache=tmp_path, seed=0, seen=top).batch(0)
    assert bool((batch.pixel[:, 1] < 4).all()) and bool((batch.pixel[batch.view == 0, 0] < 12).all())
    assert len(torch.unique(batch.pixel[batch.view == 0], dim=0)) == 48


def test_a_mask_that_leaves_nothing_is_told(tmp_path: Path) -> None:
    scene, _ = make_scene(tmp_path)
    paths = tuple(write_mask(tmp_path / f"n{k}.png", np.zeros((h, w), np.uint8)) for k, (w, h) in enumerate(SIZES))
    with pytest.raises(DataError, match="none of 4 training views"):
        make(replace(scene, masks=paths), tmp_path)


def test_rays_know_whether_they_look_into_the_sky(tmp_path: Path) -> None:
    scene, _ = make_scene(tmp_path)
    upper = np.zeros((16, 24), np.uint8)
    upper[:5] = 1
    path = write_mask(tmp_path / "sky.png", upper)
    batch = make(replace(scene, sky_masks=(path, None, None, None, None)), tmp_path, rays=3000).batch(0)
    assert batch.sky is not None and batch.sky.dtype == torch.bool
    assert torch.equal(batch.sky, (batch.view == 0) & (batch.pixel[:, 1] < 5)) and bool(batch.sky.any())


def test_the_image_of_a_mask_is_checked_when_it_is_read(tmp_path: Path) -> None:
    write_image(tmp_path / "m.png", (8, 8))
    (tmp_path / "m.png").write_bytes((tmp_path / "m.png").read_bytes()[:60])
    with pytest.raises(DataError, match=r"m\.png"):
        load_mask(tmp_path / "m.png", (8, 8))
