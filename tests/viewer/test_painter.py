from dataclasses import replace

import numpy as np
import pytest
import torch
from shelves import cards_of
from tiny_world import World

from fprf.io.images import to_uint8
from fprf.io.maps import match_image
from fprf.training.cached_view import view_parts
from fprf.training.matches import match_map
from fprf.training.views import render_view
from fprf.viewer.looks import Look, ordered
from fprf.viewer.painter import Layers, Painter, Shown, compose
from fprf.viewer.restyler import Studio


def painted(studio: Studio, shown: Shown, chunk: int = 100) -> Layers:
    trained = studio.trained
    known, config = trained.known, replace(trained.config.render, chunk=chunk)
    painter = Painter(trained.model.decoder, studio.encoders.scene, studio.styled(shown.look), shown, (32, 24))
    steps = list(painter.paint(view_parts(trained.model, known.facts, known.cameras, 2, config)))
    assert len(steps) == -(-32 * 24 // chunk)
    return painter.layers()


@pytest.fixture
def studio(world: World) -> Studio:
    return Studio(world.load())


def test_layers_are_what_the_command_line_renders(studio: Studio, world: World) -> None:
    a, b = cards_of(studio, world)
    look = ordered(Look(mix=((a, 1.0), (b, 1.0)), clusters=3), 0, "keep")
    layers = painted(studio, Shown(look, "matches", wipe=0.5))
    trained, styled = studio.trained, studio.styled(look)
    assert styled is not None
    known, config = trained.known, trained.config.render
    for name, restyle in (("look", styled.restyle), ("plain", None)):
        view = render_view(trained.model, known.facts, known.cameras, 2, config, restyle)
        assert np.abs(layers.pictures[name].astype(int) - to_uint8(view.rgb)).max() <= 1
    found = match_map(trained, styled, 2)
    wanted = match_image(found.attention, styled.codes.reference, styled.codes.names, found.opacity, found.kept)
    assert np.abs(layers.pictures["matches"].astype(int) - wanted).mean() < 0.5


@pytest.mark.parametrize("name", ["matches", "regions", "depth"])
def test_every_map_is_a_picture_and_not_of_one_colour(studio: Studio, world: World, name: str) -> None:
    a, b = cards_of(studio, world)
    layers = painted(studio, Shown(Look(mix=((a, 1.0), (b, 1.0)), clusters=3), name))  # type: ignore[arg-type]
    assert layers.pictures[name].shape == (24, 32, 3) and layers.pictures[name].std() > 1


def test_without_a_style_the_match_map_is_grey(studio: Studio) -> None:
    assert (painted(studio, Shown(Look(), "matches")).pictures["matches"] == 128).all()


def test_a_picked_region_stands_out(studio: Studio) -> None:
    whole = painted(studio, Shown(Look()))
    shares = []
    for region in range(studio.regions):
        shown = Shown(Look(), region=region)
        layers = painted(studio, shown)
        assert layers.share is not None and layers.share.shape == (24, 32)
        shares.append(layers.share)
        picture = compose(layers, shown)
        inside, outside = layers.share > 0.99, layers.share < 0.01
        assert np.array_equal(picture[inside], whole.pictures["look"][inside])
        assert (np.ptp(picture[outside].astype(int), axis=-1) <= 1).all()  # grey
    assert np.allclose(sum(shares), 1, atol=1e-3)


def test_composing_is_arithmetic() -> None:
    look, plain, over = (np.full((4, 10, 3), value, np.uint8) for value in (100, 200, 50))
    layers = Layers({"look": look, "plain": plain, "matches": over}, None, torch.ones(4, 10))
    assert np.array_equal(compose(layers, Shown(Look())), look)
    wiped = compose(layers, Shown(Look(), wipe=0.3))
    assert (wiped[:, :3] == 200).all() and (wiped[:, 3:] == 100).all()
    assert (compose(layers, Shown(Look(), wipe=0.0)) == 100).all() and (compose(layers, Shown(Look(), wipe=1.0)) == 200).all()
    assert (compose(layers, Shown(Look(), "matches", cover=0.5)) == 75).all()
    assert (compose(layers, Shown(Look(), "depth")) == 100).all()  # not painted


def test_depth_is_infinite_where_nothing_is(studio: Studio) -> None:
    layers = painted(studio, Shown(Look()))
    assert layers.depth.shape == (24, 32) and bool((layers.depth > 0).all())
