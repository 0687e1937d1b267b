"""Light for 3D Gaussians: what reaches them, their normals, and colours in a new light."""
