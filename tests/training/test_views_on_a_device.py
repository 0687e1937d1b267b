"""Renders, restyles, match maps and blocks on the pretended device: the CPU's, bit for bit, where both take plain torch."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from block_world import BlockWorld
from pretend_cuda import CUDA, pretend_cuda
from tiny_world import World

from fprf.ops import backend
from fprf.plugins.stylizers.config import AdainConfig, LocalAdainConfig, RegionOtConfig, RegionToneConfig, StylizerConfig
from fprf.style.config import StyleConfig
from fprf.style.dictionary import Encoders, StyleDictionary, build_dictionary, encode_photograph
from fprf.style.files import StyleFile
from fprf.style.match_maps import match_map
from fprf.style.restyle import apply_dictionary
from fprf.training.loading import Trained, load_run
from fprf.training.views import cache_view, render_view

STYLIZERS = (AdainConfig(colours=0.5), LocalAdainConfig(similarity="dot"), RegionOtConfig(), RegionToneConfig())
PLACES: tuple[tuple[str, Callable[[], Any]], ...] = (("cpu", backend.plain), (str(CUDA), pretend_cuda))


Made = tuple[Trained, Encoders, StyleDictionary]


@pytest.fixture(scope="module")
def _made() -> dict[str, Made]:
    return {}


def shown(world: World, made: dict[str, Made], device: str, stylizer: StylizerConfig) -> list[torch.Tensor]:
    """The tables of a style, and what a view shows in it: rendered, from a cached view, as a match map.

    Within the device's own rules; its run, encoders and dictionary are made once.
    """
    if device not in made:
        trained = load_run(world.run, device)
        encoders = trained.encoders()
        read = [encode_photograph(path, encoders, name=path.name) for path in world.references]
        assert all(part.device == torch.device(device) for r in read for part in (r.content, r.semantic, r.colour))
        made[device] = trained, encoders, build_dictionary(read, clusters=3, seed=0)
    trained, encoders, dictionary = made[device]
    style = StyleConfig(references=world.references, stylizer=stylizer, keep=("0",), strength=0.8, luminance=0.2)
    styled = apply_dictionary(trained, StyleFile(style), encoders, dictionary)
    view = trained.restyled(styled.restyle).render(trained.cameras, 3)
    again = trained.cached(trained.cameras, 3).restyled(styled.restyle)
    return [*dictionary[:6], *view[:3], again.rgb, *match_map(trained, styled, 3)]


@pytest.mark.parametrize(
    ("other", "stylizer"),
    [*((PLACES[1], each) for each in STYLIZERS), (("mps:0", lambda: pretend_cuda(mps=True)), RegionToneConfig())],
    ids=lambda given: type(given).__name__ if isinstance(given, StylizerConfig) else given[0],
)
def test_every_stylizer(
    world: World, _made: dict[str, Made], other: tuple[str, Callable[[], Any]], stylizer: StylizerConfig
) -> None:
    """Also on a device without float64."""
    found = []
    for device, within in (PLACES[0], other):
        with within():
            found.append(shown(world, _made, device, stylizer))
    assert all(torch.equal(a, b) and b.device.type == "cpu" for a, b in zip(*found, strict=True))


def test_a_frame_is_one_copy_whatever_its_chunks(world: World) -> None:
    with pretend_cuda() as seen:
        trained = load_run(world.run, str(CUDA))
        facts, cameras = trained.known.facts, trained.known.cameras
        render_view(trained.model, facts, cameras, 0, trained.config.render)
        pictures = []
        for memory, chunks in ((1 << 30, 1), (2 * 192 * 1024 * 300, 3)):
            torch.cuda.mem_get_info = lambda device=None, free=memory: (free, free)
            seen.syncs.clear()
            config = replace(trained.config.render, chunk=100)
            pictures.append(render_view(trained.model, facts, cameras, 1, config).rgb)
            assert seen.syncs == {"aten._to_copy.default": 1, "aten.nonzero.default": chunks}
        seen.syncs.clear()
        at_half = replace(trained.config.render, resolution=0.5, tone=(1.0, 0.9, 0.8))
        assert render_view(trained.model, facts, cameras, 1, at_half).rgb.shape == (24, 32, 3)
        assert seen.syncs["aten._to_copy.default"] == 1
        cached = cache_view(trained.model, facts, cameras, 1, trained.config.render)
        seen.syncs.clear()
        assert torch.equal(cached.restyled().rgb, pictures[0])
        assert seen.syncs == {"aten._to_copy.default": 1}
    assert torch.equal(*pictures)


def test_blocks_of_a_large_scene(block_world: BlockWorld) -> None:
    found = []
    for device, within in PLACES:
        with within():
            trained = load_run(block_world.root, device, max_memory=1.0)
            found.append(trained.render(trained.cameras, 2)[:3])
    # Off the CPU points are turned into a block without a matrix product: sums of three, in another order.
    torch.testing.assert_close(*found, rtol=1e-5, atol=1e-5)
