"""Cameras as transforms.json, read back by our own parser and as Nerfstudio reads them."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from analytic import ring

from fprf.datamanagers.parsers.config import parse_scene
from fprf.export.transforms import transforms
from fprf.rendering.cameras import Cameras


def written(folder: Path, cameras: Cameras, **more: object) -> dict[str, object]:
    files = [f"images/{k:02d}.png" for k in range(len(cameras))]
    (folder / "images").mkdir(parents=True)
    for file, (width, height) in zip(files, cameras.size.tolist(), strict=True):
        cv2.imwrite(str(folder / file), np.zeros((height, width, 3), dtype=np.uint8))
    document = transforms(cameras, files, train=[1, 2, 4], test=[0, 3], **more)  # type: ignore[arg-type]
    (folder / "transforms.json").write_text(json.dumps(document))
    return document


@pytest.mark.parametrize("kind", ["shared", "each", "opencv", "fisheye"])
def test_our_own_parser_reads_the_cameras_back(tmp_path: Path, kind: str) -> None:
    cameras = ring(5)
    if kind == "each":
        cameras = replace(cameras, focal=cameras.focal + torch.arange(5).double()[:, None])
    if kind == "opencv":
        bent = torch.tensor([0.1, -0.02, 0.003, -0.0004, 0.001, -0.002], dtype=torch.float64)
        cameras = replace(cameras, distortion=bent.repeat(5, 1), lens=torch.ones(5, dtype=torch.int64))
    if kind == "fisheye":
        bent = torch.tensor([0.1, -0.02, 0.003, -0.0004, 0.0, 0.0], dtype=torch.float64)
        cameras = replace(cameras, distortion=bent.repeat(5, 1), lens=torch.full((5,), 2))
    document = written(tmp_path, cameras)
    frames = document["frames"]
    assert isinstance(frames, list) and ("fl_x" in frames[0]) == (kind == "each") != ("fl_x" in document)
    scene = parse_scene(tmp_path, 1, None)
    for name in ("focal", "centre", "size", "distortion", "lens"):
        assert torch.equal(getattr(scene.cameras, name), getattr(cameras, name)), name
    assert torch.allclose(scene.cameras.pose, cameras.pose, atol=1e-12)
    assert scene.train.tolist() == [1, 2, 4] and scene.test.tolist() == [0, 3]
