"""The rasteriser of 3D Gaussians.

`reference` defines what is drawn, in plain torch. `rendering` is what others call: it chooses between that,
the compiled `forward_kernels` and `backward_kernels` on a CPU, and `gsplat` on CUDA. `training` holds
Gaussians that learn. How parameters lie in memory is said in `layout`, and relied on by `rendering`,
`training` and the kernels. Browsers draw by a copy of the forward pass, the shaders of
`fprf/page/web/splats.js`, where the constants below stand as numbers.
"""

BLUR = 0.3
"""Variance in square pixels that every projected Gaussian gets: the footprint of a pixel."""
MIN_ALPHA = 1 / 255
MAX_ALPHA = 0.99
"""Alphas up to the first count as 0, those above the second as it."""
