import torch
from analytic import globe

from fprf.export.point_cloud import fuse, sky_dome
from fprf.rendering.cameras import pixel_grid, rays_through


def test_the_dome_lies_where_views_see_nothing() -> None:
    maps = globe(6)
    cloud = fuse(maps, edge=0.2, most=10**6, tolerance=0.02, agree=2)
    sky = sky_dome(maps, cloud)
    assert sky is not None
    centre = maps.cameras.pose[:, :, 3].mean(0)
    away = (sky.point - centre).norm(dim=-1)
    farthest = (cloud.point - centre).norm(dim=-1).amax()
    assert torch.allclose(away, 3 * farthest.expand(len(away)), rtol=1e-9)
    out = (sky.point - centre) / away[:, None]
    assert torch.allclose(sky.normal.double(), -out, atol=1e-6)
    assert float((sky.space / sky.edge).amin()) > 1
    for view, depth in enumerate(maps.depth):
        pixel = pixel_grid(maps.cameras, view)[depth.isinf().view(-1)]
        _, direction = rays_through(maps.cameras, torch.full((len(pixel),), view), pixel)
        # Every direction of open sky has a point of the dome within a cell's diagonal, 2 pixels of 1/50 wide.
        assert float((direction @ out.T).amax(1).amin()) > 1 - (2 / 50 * 3**0.5) ** 2 / 2
    # ... and the view that is to colour it looks there.
    to = torch.nn.functional.normalize(out, dim=-1)
    ahead = -(maps.cameras.pose[sky.view, :, 2] * to).sum(-1)
    assert float(ahead.amin()) > 0.7


def test_no_dome_without_sky() -> None:
    maps = globe(4, floor=-1.5)
    closed = maps._replace(depth=tuple(d.clamp(max=9.0) for d in maps.depth))
    cloud = fuse(maps, edge=0.3, most=10**6, tolerance=0.02, agree=2)
    assert sky_dome(closed, cloud) is None
