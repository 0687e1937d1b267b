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
"""Alphas up to this, a step of 8 bits, count as 0; as in the published code."""
MAX_ALPHA = 0.99
"""Alphas above this count as it, so that what is behind always has a gradient; as in the published code."""
TANGENT_MARGIN = 0.15
"""Share of the image beyond its edges up to which J is taken: further out the linear projection stretches
without bound. As in the published code.
"""
MAX_LOG = 30.0
"""Logarithms of scales and logits are cut at this and at its negative: e^30 and its square are finite in
float32.
"""
MAX_COORDINATE = 1e15
"""Means, quaternions and harmonics of at least this are invalid: their squares are finite in float32."""
MAX_SQUARE_PIXELS = 1e16
"""Gaussians whose squared half axes sum to at least this are invalid: 1e8 pixels wide."""
ADAM_DECAYS = (0.9, 0.99)
"""Of Adam's first and second moment; by eye, the second shorter than the usual 0.999."""
ADAM_EPSILON = 1e-15
"""Added to the root of the second moment, so that 0 / 0 is 0; as in the published code."""
