"""SSIM written out, and pictures to compare."""

import numpy as np
import torch


def noise(height: int, width: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))


def ssim_oracle(a: np.ndarray, b: np.ndarray, *, means: bool = True) -> float:
    """Wang et al. 2004 in float64, window by window; or its second factor alone."""
    g = np.exp(-((np.arange(11) - 5) ** 2) / (2 * 1.5**2))
    window = np.outer(g, g)[..., None] / g.sum() ** 2
    found = []
    for i in range(a.shape[0] - 10):
        for j in range(a.shape[1] - 10):
            p = a[i : i + 11, j : j + 11]
            q = b[i : i + 11, j : j + 11]
            mp = (window * p).sum((0, 1))
            mq = (window * q).sum((0, 1))
            vp = (window * (p - mp) ** 2).sum((0, 1))
            vq = (window * (q - mq) ** 2).sum((0, 1))
            first = (2 * mp * mq + 1e-4) / (mp**2 + mq**2 + 1e-4) if means else 1.0
            found.append(first * (2 * (window * (p - mp) * (q - mq)).sum((0, 1)) + 9e-4) / (vp + vq + 9e-4))
    return float(np.mean(found))
