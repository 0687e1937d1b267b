import itertools
from collections.abc import Callable, Hashable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from photographs import encoded
from pretend_cuda import CUDA, pretend_cuda
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
    LayerRenderer,
    Layers,
    ProgressiveRenderer,
    RenderedFrame,
    RenderRequest,
    Speed,
    composite_layers,
    resolutions,
)
from fprf.viewer.restyler import Restyler
from fprf.viewer.state import MAPS, Look, ViewSettings, set_rule


class Watched:
    """A sight whose frames are kept, and whose renders are counted."""

    def __init__(self, world: World) -> None:
        self.trained = world.load()
        self.restyler = Restyler(self.trained)
        self.transform = page_transform(self.trained.known.cameras)
        self.frames: list[RenderedFrame] = []
        self.renderer = ProgressiveRenderer(
            self.trained, self.restyler, self.transform, lambda client, frame: self.frames.append(frame)
        )
        self.rendered = 0
        march = self.renderer._march

        def counted(*args: object) -> object:
            self.rendered += 1
            return march(*args)  # type: ignore[arg-type]

        self.renderer._march = counted  # type: ignore[method-assign, assignment]

    def look(self, glance: RenderRequest, client: Hashable = 1) -> list[RenderedFrame]:
        self.frames.clear()
        for _ in self.renderer.render(client, glance):
            pass
        return list(self.frames)

    def glance(self, view: int = 2, shown: ViewSettings | None = None, pixels: int = 64) -> RenderRequest:
        eye = self.transform.camera_state(self.trained.known.cameras, view)
        return RenderRequest(eye, ViewSettings(Look()) if shown is None else shown, pixels)


@pytest.fixture
def watched(world: World) -> Watched:
    found = Watched(world)
    found.renderer._speed.seconds = found.renderer._cached_speed.seconds = 1.0  # as if slow: begin at the coarsest
    return found


def test_pictures_grow_sharper_and_the_last_is_what_is_rendered(watched: Watched) -> None:
    frames = watched.look(watched.glance())
    assert [frame.picture.shape for frame in frames] == [(12, 16, 3), (24, 32, 3), (48, 64, 3)]
    assert [frame.final for frame in frames] == [False, False, True]
    trained = watched.trained
    cameras = watched.transform.cameras([frames[-1].camera], (64, 48))
    wanted = render_view(trained.model, trained.known.facts, cameras, 0, trained.config.render)
    assert np.abs(frames[-1].picture.astype(int) - to_uint8(wanted.rgb)).max() <= 1


def test_a_slider_renders_nothing_anew(watched: Watched, world: World) -> None:
    a, _ = encoded(watched.restyler, world)
    watched.look(watched.glance())
    before = watched.rendered
    frames = watched.look(watched.glance(shown=ViewSettings(Look(mix=((a, 1.0),), clusters=2))))
    assert watched.rendered == before and frames[-1].final
    watched.look(watched.glance(view=3))
    assert watched.rendered > before


def test_a_wipe_that_is_dragged_paints_nothing_anew(watched: Watched, world: World) -> None:
    a, _ = encoded(watched.restyler, world)
    shown = ViewSettings(Look(mix=((a, 1.0),), clusters=2), wipe=0.5)
    watched.look(watched.glance(shown=shown))
    frames = watched.look(watched.glance(shown=shown._replace(wipe=0.25)))
    assert len(frames) == 1 and frames[0].final
    layers = frames[0].layers.pictures
    assert np.array_equal(frames[0].picture[:, :16], layers["plain"][:, :16])
    assert np.array_equal(frames[0].picture[:, 16:], layers["look"][:, 16:])
    assert len(watched.look(watched.glance(shown=shown._replace(wipe=None)))) == 1
    assert len(watched.look(watched.glance(shown=shown._replace(map="regions")))) > 1


def test_memory_is_bounded_over_all_clients(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(renderer, "CACHE_BYTES", 1 << 20)
    for client in range(6):
        watched.look(watched.glance(view=client), client)
        assert watched.renderer._bytes() <= 1 << 20
    for client in range(6):
        watched.renderer.forget(client)
    assert watched.renderer._bytes() == 0


def painted(restyler: Restyler, shown: ViewSettings, chunk: int = 100) -> Layers:
    trained = restyler.scene
    known, config = trained.known, replace(trained.config.render, chunk=chunk)
    layers_of = LayerRenderer(trained.model.decoder, restyler.encoders.scene, restyler.styled(shown.look), shown, (32, 24))
    steps = list(layers_of.render(view_parts(trained.model, known.facts, known.cameras, 2, config)))
    assert len(steps) == -(-32 * 24 // chunk)
    return layers_of.finish()


@pytest.fixture
def restyler(world: World) -> Restyler:
    return Restyler(world.load())


def test_layers_are_what_the_command_line_renders(restyler: Restyler, world: World) -> None:
    a, b = encoded(restyler, world)
    look = set_rule(Look(mix=((a, 1.0), (b, 1.0)), clusters=3), 0, "keep")
    layers = painted(restyler, ViewSettings(look, "matches", wipe=0.5))
    trained, styled = restyler.scene, restyler.styled(look)
    assert styled is not None
    known, config = trained.known, trained.config.render
    for name, restyle in (("look", styled.restyle), ("plain", None)):
        view = render_view(trained.model, known.facts, known.cameras, 2, config, restyle)
        assert np.abs(layers.pictures[name].astype(int) - to_uint8(view.rgb)).max() <= 1
    found = match_map(trained, styled, 2)
    wanted = match_image(found.attention, styled.codes.reference, styled.codes.names, found.opacity, found.kept)
    assert np.abs(layers.pictures["matches"].astype(int) - wanted).mean() < 0.5


def test_a_picked_region_stands_out(restyler: Restyler) -> None:
    whole = painted(restyler, ViewSettings(Look()))
    shares = []
    for region in range(restyler.regions):
        shown = ViewSettings(Look(), region=region)
        layers = painted(restyler, shown)
        assert layers.share is not None and layers.share.shape == (24, 32)
        shares.append(layers.share)
        picture = composite_layers(layers, shown)
        inside, outside = layers.share > 0.99, layers.share < 0.01
        assert np.array_equal(picture[inside], whole.pictures["look"][inside])
        assert (np.ptp(picture[outside].astype(int), axis=-1) <= 1).all()  # grey
    assert np.allclose(sum(shares), 1, atol=1e-3)


def layers_on(world: World, device: str) -> dict[str, Any]:
    """Every layer of a view, and what there is to say of a region in it."""
    trained = load_run(world.run, device)
    restyler, known = Restyler(trained), trained.known
    a, b = encoded(restyler, world)
    look = set_rule(Look(mix=((a, 1.0), (b, 0.5)), clusters=3, towards=Look(mix=((b, 1.0),), clusters=3), at=0.4), 0, "keep")
    parts = list(view_parts(trained.model, known.facts, known.cameras, 2, trained.config.render))
    found: dict[str, Any] = {"picked": restyler.region_info(look, 1), "region": restyler.region_at(known.cameras, (16.5, 12.5))}
    for map_ in MAPS:
        layers_of = LayerRenderer(
            trained.model.decoder,
            restyler.encoders.scene,
            restyler.styled(look),
            ViewSettings(look, map_, 1.0, 0.5, 1),
            (32, 24),
        )
        assert len(list(layers_of.render(parts))) == len(parts)
        layers = layers_of.finish()
        found |= {f"{map_} {name}": picture for name, picture in layers.pictures.items()}
        found |= {f"{map_} share": layers.share, f"{map_} depth": layers.depth.numpy()}
    return found


def test_every_layer(world: World) -> None:
    with backend.plain():
        expected = layers_on(world, "cpu")
    with pretend_cuda() as seen:
        found = layers_on(world, str(CUDA))
    assert seen.uploads and found.keys() == expected.keys()
    same: Callable[[Any, Any], bool] = lambda a, b: np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b  # noqa: E731
    assert all(same(found[name], expected[name]) for name in expected), [n for n in expected if not same(found[n], expected[n])]
    assert torch.is_inference_mode_enabled() is False


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow], max_examples=60)
@given(st.integers(1, 4096), st.integers(1, 4096))
def test_rungs_double_up_to_the_very_size(width: int, height: int) -> None:
    found = resolutions((width, height))
    assert found[-1] == (width, height)
    assert found == sorted(found) and all(min(size) >= 1 for size in found)
    for small, large in itertools.pairwise(found):
        assert abs(small[0] - large[0] / 2) <= 1 and abs(small[1] - large[1] / 2) <= 1
    assert max(found[0]) < 33 or len(found) == 1


def test_a_slow_machine_begins_coarse_and_a_fast_one_sharp() -> None:
    sizes = resolutions((640, 480))
    assert Speed(1e-9).first(sizes) == len(sizes) - 1
    assert Speed(1.0).first(sizes) == 0
    middle = Speed(1e-5).first(sizes)  # 0.1 s are 10 000 pixels
    assert sizes[middle] == (80, 60)


def test_without_a_style_the_match_map_is_grey(restyler: Restyler) -> None:
    assert (painted(restyler, ViewSettings(Look(), "matches")).pictures["matches"] == 128).all()
