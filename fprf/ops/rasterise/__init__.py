"""The rasteriser of 3D Gaussians.

`reference` defines what is drawn, in plain torch. `rendering` is what others call: it chooses between that, the compiled
`forward_kernels` and `backward_kernels` on a CPU, and `gsplat` on CUDA. `training` holds Gaussians that learn. How parameters
lie in memory is known to `layout` alone. Browsers draw by a copy of the forward pass, `fprf/page/web/splats.js`.
"""
