from collections.abc import Hashable
from dataclasses import replace

import numpy as np
import pytest
from shelves import cards_of
from tiny_world import World

from fprf.io.images import to_uint8
from fprf.training.views import render_view
from fprf.viewer import renderer as eyes
from fprf.viewer.cameras import stage_of
from fprf.viewer.looks import Look
from fprf.viewer.painter import Shown
from fprf.viewer.renderer import Frame, Glance, Sight
from fprf.viewer.restyler import Studio


class Watched:
    """A sight whose frames are kept, and whose renders are counted."""

    def __init__(self, world: World) -> None:
        self.trained = world.load()
        self.studio = Studio(self.trained)
        self.stage = stage_of(self.trained.known.cameras)
        self.frames: list[Frame] = []
        self.sight = Sight(self.trained, self.studio, self.stage, lambda client, frame: self.frames.append(frame))
        self.rendered = 0
        render = self.sight._render

        def counted(*args: object) -> object:
            self.rendered += 1
            return render(*args)  # type: ignore[arg-type]

        self.sight._render = counted  # type: ignore[method-assign, assignment]

    def look(self, glance: Glance, client: Hashable = 1) -> list[Frame]:
        self.frames.clear()
        for _ in self.sight.look(client, glance):
            pass
        return list(self.frames)

    def glance(self, view: int = 2, shown: Shown | None = None, pixels: int = 64) -> Glance:
        eye = self.stage.eye(self.trained.known.cameras, view)
        return Glance(eye, Shown(Look()) if shown is None else shown, pixels)


@pytest.fixture
def watched(world: World) -> Watched:
    found = Watched(world)
    found.sight._fresh.seconds = found.sight._again.seconds = 1.0  # as if slow: begin at the coarsest
    return found


def test_pictures_grow_sharper_and_the_last_is_what_is_rendered(watched: Watched) -> None:
    frames = watched.look(watched.glance())
    assert [frame.picture.shape for frame in frames] == [(12, 16, 3), (24, 32, 3), (48, 64, 3)]
    assert [frame.final for frame in frames] == [False, False, True]
    trained = watched.trained
    cameras = watched.stage.cameras([frames[-1].eye], (64, 48))
    wanted = render_view(trained.model, trained.known.facts, cameras, 0, trained.config.render)
    assert np.abs(frames[-1].picture.astype(int) - to_uint8(wanted.rgb)).max() <= 1


def test_a_slider_renders_nothing_anew(watched: Watched, world: World) -> None:
    a, _ = cards_of(watched.studio, world)
    watched.look(watched.glance())
    before = watched.rendered
    frames = watched.look(watched.glance(shown=Shown(Look(mix=((a, 1.0),), clusters=2))))
    assert watched.rendered == before and frames[-1].final
    watched.look(watched.glance(view=3))
    assert watched.rendered > before


def test_a_wipe_that_is_dragged_paints_nothing_anew(watched: Watched, world: World) -> None:
    a, _ = cards_of(watched.studio, world)
    shown = Shown(Look(mix=((a, 1.0),), clusters=2), wipe=0.5)
    watched.look(watched.glance(shown=shown))
    frames = watched.look(watched.glance(shown=shown._replace(wipe=0.25)))
    assert len(frames) == 1 and frames[0].final
    layers = frames[0].layers.pictures
    assert np.array_equal(frames[0].picture[:, :16], layers["plain"][:, :16])
    assert np.array_equal(frames[0].picture[:, 16:], layers["look"][:, 16:])
    assert len(watched.look(watched.glance(shown=shown._replace(wipe=None)))) == 1
    assert len(watched.look(watched.glance(shown=shown._replace(map="regions")))) > 1


def test_memory_is_bounded_over_all_clients(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(eyes, "KEPT", 1 << 20)
    for client in range(6):
        watched.look(watched.glance(view=client), client)
        assert watched.sight._bytes() <= 1 << 20
    for client in range(6):
        watched.sight.forget(client)
    assert watched.sight._bytes() == 0


def test_work_that_is_dropped_keeps_nothing_half(watched: Watched) -> None:
    work = watched.sight.look(1, watched.glance(pixels=256))
    for _ in range(4):
        next(work)
    work.close()  # type: ignore[attr-defined]
    for size, parts in watched.sight._memory[1].parts.items():
        assert sum(part.rays for part in parts) == size[0] * size[1]
    assert watched.look(watched.glance(pixels=256))[-1].final


def test_a_fast_machine_begins_sharp(watched: Watched) -> None:
    watched.sight._fresh.seconds = 1e-9
    assert len(watched.look(watched.glance())) == 1
    watched.sight.renew(watched.trained)
    assert replace(watched.sight._trained.config.render, chunk=10).chunk == 10
