import itertools
from collections.abc import Hashable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pretend_cuda import CUDA, pretend_cuda
from session_helpers import camera_of
from tiny_world import World

from fprf.io.images import to_uint8
from fprf.io.maps import match_image
from fprf.ops import backend
from fprf.style.match_maps import match_map
from fprf.training.loading import load_run
from fprf.training.views import render_view, view_parts
from fprf.viewer import renderer
from fprf.viewer.cameras import page_transform
from fprf.viewer.renderer import (
    Layers,
    ProgressiveRenderer,
    RenderedFrame,
    RenderRequest,
    Speed,
    composite_layers,
    join_layers,
    render_layers,
    resolutions,
)
from fprf.viewer.restyler import Restyler
from fprf.viewer.state import MAPS, Look, Photograph, ViewSettings, set_rule

Pair = tuple[Photograph, Photograph]


class Watched(ProgressiveRenderer):
    """A renderer, as slow at first, whose frames are kept, and whose marches are counted."""

    def __init__(self, restyler: Restyler) -> None:
        transform = page_transform(restyler.scene.cameras)
        show = lambda client, frame: self.frames.append(frame)  # noqa: E731
        super().__init__(restyler.scene, restyler, transform, show, (Speed(1.0), Speed(1.0)))
        self.frames: list[RenderedFrame] = []
        self.marched = 0

    def _march(self, *args: Any) -> Any:
        self.marched += 1
        return super()._march(*args)

    def look(self, shown: ViewSettings | None = None, view: int = 2, client: Hashable = 1) -> list[RenderedFrame]:
        self.frames.clear()
        request = RenderRequest(camera_of(self._trained, view), shown or ViewSettings(Look()), 64)
        for _ in self.render(client, request):
            pass
        return list(self.frames)


@pytest.fixture
def watched(restyler: Restyler) -> Watched:
    return Watched(restyler)


def test_pictures_grow_sharper_and_the_last_is_what_is_rendered(watched: Watched, restyler: Restyler) -> None:
    frames = watched.look()
    assert [frame.picture.shape for frame in frames] == [(12, 16, 3), (24, 32, 3), (48, 64, 3)]
    assert [frame.final for frame in frames] == [False, False, True]
    trained = restyler.scene
    cameras = page_transform(trained.cameras).cameras([frames[-1].camera], (64, 48))
    wanted = render_view(trained.model, trained.known.facts, cameras, 0, trained.config.render)
    assert np.abs(frames[-1].picture.astype(int) - to_uint8(wanted.rgb)).max() <= 1


def test_another_look_marches_nothing_and_another_wipe_decodes_nothing(watched: Watched, encoded: Pair) -> None:
    watched.look()
    before = watched.marched
    shown = ViewSettings(Look(mix=((encoded[0], 1.0),), clusters=2), wipe=0.5)
    assert watched.look(shown)[-1].final and watched.marched == before
    [frame] = watched.look(shown._replace(wipe=0.25))
    layers = frame.layers.pictures
    assert frame.final and np.array_equal(frame.picture[:, :16], layers["plain"][:, :16])
    assert np.array_equal(frame.picture[:, 16:], layers["look"][:, 16:])
    assert len(watched.look(shown._replace(wipe=None))) == 1 < len(watched.look(shown._replace(map="regions")))
    assert watched.marched == before
    watched.look(view=3)
    assert watched.marched > before


def test_memory_is_bounded_over_all_clients(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(renderer, "CACHE_BYTES", 1 << 20)
    for client in range(6):
        watched.look(view=client, client=client)
        assert 0 < watched._bytes() <= 1 << 20
    for client in range(6):
        watched.forget(client)
    assert watched._bytes() == 0


def layers_of(restyler: Restyler, shown: ViewSettings, chunk: int = 100) -> Layers:
    trained = restyler.scene
    config, styled = replace(trained.config.render, chunk=chunk), restyler.styled(shown.look)
    parts = view_parts(trained.model, trained.known.facts, trained.known.cameras, 2, config)
    chunks = [render_layers(part, trained.model.decoder, restyler.encoders.scene, styled, shown) for part in parts]
    return join_layers(chunks, shown, (32, 24))


def test_layers_are_what_the_command_line_renders(restyler: Restyler, encoded: Pair) -> None:
    a, b = encoded
    look = set_rule(Look(mix=((a, 1.0), (b, 1.0)), clusters=3), 0, "keep")
    layers = layers_of(restyler, ViewSettings(look, "matches", wipe=0.5))
    trained, styled = restyler.scene, restyler.styled(look)
    for name, restyle in (("look", styled.restyle), ("plain", None)):
        view = render_view(trained.model, trained.known.facts, trained.known.cameras, 2, trained.config.render, restyle)
        assert np.abs(layers.pictures[name].astype(int) - to_uint8(view.rgb)).max() <= 1
    found = match_map(trained, styled, 2)
    wanted = match_image(found.attention, styled.codes.reference, styled.codes.names, found.opacity, found.kept)
    assert np.abs(layers.pictures["matches"].astype(int) - wanted).mean() < 0.5
    assert (layers_of(restyler, ViewSettings(Look(), "matches")).pictures["matches"] == 128).all()  # grey without a style


def test_a_picked_region_stands_out(restyler: Restyler) -> None:
    whole = layers_of(restyler, ViewSettings(Look())).pictures["look"]
    shares = []
    for region in range(restyler.regions):
        shown = ViewSettings(Look(), region=region)
        layers = layers_of(restyler, shown)
        assert layers.share is not None and layers.share.shape == (24, 32)
        shares.append(layers.share)
        picture = composite_layers(layers, shown)
        inside, outside = layers.share > 0.99, layers.share < 0.01
        assert np.array_equal(picture[inside], whole[inside])
        assert (np.ptp(picture[outside].astype(int), axis=-1) <= 1).all()  # grey
    assert np.allclose(sum(shares), 1, atol=1e-3)


def everything(world: World, device: str) -> dict[str, Any]:
    """Every layer of a view, and what there is to say of a region in it."""
    restyler = Restyler(load_run(world.run, device))
    a, b = (restyler.encode(path, path.name) for path in world.references)
    look = set_rule(Look(mix=((a, 1.0), (b, 0.5)), clusters=3, towards=Look(mix=((b, 1.0),), clusters=3), at=0.4), 0, "keep")
    cameras = restyler.scene.known.cameras
    found: dict[str, Any] = {"picked": restyler.region_info(look, 1), "region": restyler.region_at(cameras, (16.5, 12.5))}
    for name in MAPS:
        layers = layers_of(restyler, ViewSettings(look, name, 1.0, 0.5, 1), restyler.scene.config.render.chunk)
        found |= {f"{name} {layer}": picture for layer, picture in layers.pictures.items()}
        found |= {f"{name} share": layers.share, f"{name} depth": layers.depth.numpy()}
    return found


def test_every_layer_is_the_same_on_another_device(world: World) -> None:
    with backend.plain():
        expected = everything(world, "cpu")
    with pretend_cuda() as seen:
        found = everything(world, str(CUDA))
    assert seen.uploads and found.keys() == expected.keys() and found.pop("picked") == expected.pop("picked")
    assert [name for name in expected if not np.array_equal(found[name], expected[name])] == []
    assert torch.is_inference_mode_enabled() is False


@given(st.integers(1, 4096), st.integers(1, 4096))
def test_resolutions_double_up_to_the_very_size(width: int, height: int) -> None:
    found = resolutions((width, height))
    assert found[-1] == (width, height)
    assert found == sorted(found) and all(min(size) >= 1 for size in found)
    for small, large in itertools.pairwise(found):
        assert abs(small[0] - large[0] / 2) <= 1 and abs(small[1] - large[1] / 2) <= 1
    assert max(found[0]) < 33 or len(found) == 1


def test_a_slow_machine_begins_coarse_and_a_fast_one_sharp() -> None:
    sizes = resolutions((640, 480))
    for seconds, first in ((1e-9, sizes[-1]), (1.0, sizes[0]), (1e-5, (80, 60))):  # 0.1 s are 10 000 pixels
        assert sizes[Speed(seconds).first(sizes)] == first
