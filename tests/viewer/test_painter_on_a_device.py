"""The viewer's pictures on the pretended device: the CPU's, bit for bit, where both take plain torch."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from pretend_cuda import CUDA, pretend_cuda
from shelves import cards_of
from tiny_world import World

from fprf.ops import backend
from fprf.training.cached_view import view_parts
from fprf.training.loading import load_run
from fprf.viewer.looks import Look, ordered
from fprf.viewer.painter import MAPS, Painter, Shown
from fprf.viewer.restyler import Studio


def painted(world: World, device: str) -> dict[str, Any]:
    """Every layer of a view, and what there is to say of a region in it."""
    trained = load_run(world.run, device)
    studio, known = Studio(trained), trained.known
    a, b = cards_of(studio, world)
    look = ordered(Look(mix=((a, 1.0), (b, 0.5)), clusters=3, towards=Look(mix=((b, 1.0),), clusters=3), at=0.4), 0, "keep")
    parts = list(view_parts(trained.model, known.facts, known.cameras, 2, trained.config.render))
    found: dict[str, Any] = {"picked": studio.picked(look, 1), "region": studio.region_at(known.cameras, (16.5, 12.5))}
    for map_ in MAPS:
        painter = Painter(
            trained.model.decoder, studio.encoders.scene, studio.styled(look), Shown(look, map_, 1.0, 0.5, 1), (32, 24)
        )
        assert len(list(painter.paint(parts))) == len(parts)
        layers = painter.layers()
        found |= {f"{map_} {name}": picture for name, picture in layers.pictures.items()}
        found |= {f"{map_} share": layers.share, f"{map_} depth": layers.depth.numpy()}
    return found


def test_every_layer(world: World) -> None:
    with backend.plain():
        expected = painted(world, "cpu")
    with pretend_cuda() as seen:
        found = painted(world, str(CUDA))
    assert seen.uploads and found.keys() == expected.keys()
    same: Callable[[Any, Any], bool] = lambda a, b: np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b  # noqa: E731
    assert all(same(found[name], expected[name]) for name in expected), [n for n in expected if not same(found[n], expected[n])]
    assert torch.is_inference_mode_enabled() is False
