from collections.abc import Hashable
from typing import Any

import numpy as np
import pytest
from session_helpers import camera_of

from fprf.io.images import Picture, to_uint8
from fprf.io.maps import match_image
from fprf.page import drawing
from fprf.page.drawing import Restyler, ScenePainter
from fprf.page.messages import View
from fprf.page.state import Look, Photograph, Shown
from fprf.style.config import StyleConfig
from fprf.style.match_maps import match_map
from fprf.training.views import render_view

Pair = tuple[Photograph, Photograph]


class Watched(ScenePainter):
    """A painter whose pictures are kept."""

    def __init__(self, restyler: Restyler) -> None:
        super().__init__(restyler.scene, restyler, lambda client, *picture: self.pictures.append(picture), 32)
        self.pictures: list[tuple[str, Picture, bool]] = []

    def look(self, shown: Shown | None = None, view: int = 2, client: Hashable = 1, captured: bool = False) -> list[Any]:
        self.pictures.clear()
        camera = camera_of(self._scene, view)
        for _ in self.render(client, View(camera=camera, captured=captured), shown or Shown(Look())):
            pass
        return list(self.pictures)


@pytest.fixture
def watched(restyler: Restyler) -> Watched:
    return Watched(restyler)


def rendered(restyler: Restyler, look: Look) -> Picture:
    trained, restyle = restyler.scene, restyler.restyle(look)
    view = render_view(trained.model, trained.known.facts, trained.known.cameras, 2, trained.config.render, restyle)
    return to_uint8(view.rgb)


def test_pictures_grow_sharper_and_the_last_is_what_is_rendered(watched: Watched, restyler: Restyler) -> None:
    pictures = watched.look()
    assert [picture.shape for _, picture, _ in pictures] == [(4, 5, 3), (24, 32, 3)]
    assert [final for _, _, final in pictures] == [False, True]
    assert np.abs(pictures[-1][1].astype(int) - rendered(restyler, Look())).max() <= 1


def test_another_look_marches_nothing(
    watched: Watched, restyler: Restyler, encoded: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    watched.look()
    look = Look(mix=((encoded[0], 1.0),), style=StyleConfig(clusters=2))
    with monkeypatch.context() as patch:
        patch.setattr(drawing, "_strips", None)
        found = watched.look(Shown(look), captured=True)
    assert [(kind, final) for kind, _, final in found] == [("look", True), ("captured", True)]
    for (_, picture, _), each in zip(found, (look, Look()), strict=True):
        assert np.abs(picture.astype(int) - rendered(restyler, each)).max() <= 1
    assert len(watched.look(view=3)) == 2, "another camera has a preview"
    watched.forget(1)
    assert len(watched.look(view=3)) == 2


def test_memory_is_bounded(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawing, "CACHE_BYTES", 1 << 10)
    assert len(watched.look()) == len(watched.look()) == 2, "nothing was kept"


def test_maps_are_what_the_command_line_renders(watched: Watched, restyler: Restyler, encoded: Pair) -> None:
    a, b = encoded
    look = Look(mix=((a, 1.0), (b, 1.0)), style=StyleConfig(clusters=3)).ruled(0, "keep")
    trained, styled = restyler.scene, restyler.styled(look)
    found = match_map(trained, styled, 2)
    wanted = match_image(found.attention, styled.codes.reference, styled.codes.names, found.opacity, found.kept)
    assert np.abs(watched.look(Shown(look, "matches"))[-1][1].astype(int) - wanted).mean() < 0.5
    assert (watched.look(Shown(Look(), "matches"))[-1][1] == 128).all(), "grey without a style"


def test_a_picked_region_stands_out(watched: Watched, restyler: Restyler) -> None:
    whole = watched.look()[-1][1].astype(int)
    shown = [
        watched.look(Shown(Look(), region=region))[-1][1].astype(int)
        for region in range(len(restyler.encoders.scene_style.share))
    ]
    # Each is grey but for its region's share, and the shares of all regions are the whole.
    grey = 0.45 * whole.mean(-1, keepdims=True)
    assert np.abs(sum(each - grey for each in shown) - (whole - grey)).max() <= len(shown)
    assert len(shown) > 1 and all(np.abs(each - whole).max() > 20 for each in shown)
