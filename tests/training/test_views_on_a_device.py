"""Renders, restyles, match maps and blocks on the pretended device: the CPU's, bit for bit, where both take plain torch."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from block_world import BlockWorld
from pretend_cuda import CUDA, pretend_cuda
from tiny_world import World

from fprf.ops import backend
from fprf.plugins.stylizers.config import AdainConfig, LocalAdainConfig, RegionOtConfig, RegionToneConfig, StylizerConfig
from fprf.style.config import StyleConfig
from fprf.style.dictionary import StyleDictionary, build_dictionary
from fprf.style.files import StyleFile
from fprf.style.match_maps import match_map
from fprf.style.references import Encoders, encode_photograph
from fprf.style.restyle import dress
from fprf.training.loading import Trained, load_run
from fprf.training.views import cache_view, render_view

STYLIZERS = (AdainConfig(colours=0.5), LocalAdainConfig(similarity="dot"), RegionOtConfig(), RegionToneConfig())
PLACES: tuple[tuple[str, Callable[[], Any]], ...] = (("cpu", backend.plain), (str(CUDA), pretend_cuda))


class Here:
    """The tiny world on a device with its encoders and a dictionary, made once."""

    def __init__(self, world: World, device: str) -> None:
        self.trained: Trained = load_run(world.run, device)
        self.encoders: Encoders = self.trained.encoders()
        read = [encode_photograph(path, self.encoders, name=path.name) for path in world.references]
        assert all(part.device == torch.device(device) for r in read for part in (r.content, r.semantic, r.colour))
        self.dictionary: StyleDictionary = build_dictionary(read, clusters=3, seed=0)
        self.paths = world.references


@pytest.fixture(scope="module")
def _made() -> dict[str, Here]:
    return {}


def here(world: World, made: dict[str, Here], device: str) -> Here:
    """Within the device's own rules."""
    if device not in made:
        made[device] = Here(world, device)
    return made[device]


def shown(at: Here, stylizer: StylizerConfig, references: tuple[Path, ...]) -> list[torch.Tensor]:
    """What a view shows in a look: rendered, from a cached view, as a match map; and what is kept of it."""
    trained, facts = at.trained, at.trained.known.facts
    cameras, config = trained.known.cameras, trained.config.render
    style = StyleConfig(references=references, stylizer=stylizer, keep=("0",), strength=0.8, luminance=0.2)
    styled = dress(trained, StyleFile(style), at.encoders, at.dictionary)
    view = render_view(trained.model, facts, cameras, 3, config, styled.restyle)
    again = cache_view(trained.model, facts, cameras, 3, config).restyled(styled.restyle)
    return [*view[:3], again.rgb, *match_map(trained, styled, 3)]


@pytest.mark.parametrize("stylizer", STYLIZERS, ids=lambda config: type(config).__name__)
def test_every_stylizer(world: World, _made: dict[str, Here], stylizer: StylizerConfig) -> None:
    found = []
    for device, within in PLACES:
        with within():
            found.append(shown(here(world, _made, device), stylizer, world.references))
    assert all(torch.equal(a, b) and b.device.type == "cpu" for a, b in zip(*found, strict=True))
    ours, theirs = (_made[device].dictionary for device, _ in PLACES)
    assert all(torch.equal(a, b) for a, b in zip(ours[:6], theirs[:6], strict=True)), "tables lie on the CPU"


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


def test_a_device_without_float64(world: World, _made: dict[str, Here]) -> None:
    found = []
    for device, within in (PLACES[0], ("mps:0", lambda: pretend_cuda(mps=True))):
        with within():
            found.append(shown(here(world, _made, device), RegionToneConfig(), world.references))
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_blocks_of_a_large_scene(block_world: BlockWorld) -> None:
    found = []
    for device, within in PLACES:
        with within():
            trained = load_run(block_world.root, device, max_memory=1.0)
            view = render_view(trained.model, trained.known.facts, trained.known.cameras, 2, trained.config.render)
            found.append(view[:3])
    # Off the CPU points are turned into a block without a matrix product: sums of three, in another order.
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5)
