"""Steps of a learner of Gaussians, and how good it is."""

import numpy as np
import torch

from fprf.datamanagers.images import load_images
from fprf.datamanagers.scene import ParsedScene
from fprf.evaluation.metrics import psnr
from fprf.splats.drawing import draw
from fprf.splats.gaussians import Gaussians
from fprf.splats.learner import GaussianLearner
from fprf.splats.pinholes import camera_of

STEPS = 260


def stepped(learner: GaussianLearner, begin: int = 0, end: int = STEPS) -> GaussianLearner:
    for step in range(begin, end):
        learner.step(step, step / STEPS)
        assert not learner.failed
    return learner


def quality(found: Gaussians, scene: ParsedScene) -> float:
    """Mean PSNR of the held-out views, drawn by the CPU's kernels."""
    images = load_images(scene)
    drawn = {
        view: draw(found, camera_of(scene.cameras, view), antialiased=True).image
        for view in scene.test.tolist()
    }
    return float(
        np.mean(
            [psnr(x.clamp(0, 1), torch.from_numpy(images[view]).float() / 255) for view, x in drawn.items()]
        )
    )
