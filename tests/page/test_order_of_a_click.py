from pathlib import Path

from pages import seen
from session_helpers import Listener
from splat_ball import ball
from tiny_world import World
from traced import codes, lane, order_of_calls

from fprf.page.messages import read_message
from fprf.page.render_worker import Steps
from fprf.page.session import Session, Viewed
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.restyle import apply_style
from fprf.training.views import render_view


def test_a_style_of_a_field_goes_as_it_is_drawn(world: World) -> None:
    trained = world.load()
    steps = [*lane("style", 0), lane("style", 1)[0]]

    def restyled() -> None:
        look = apply_style(trained, StyleFile(StyleConfig(references=world.references))).restyle
        facts = trained.known.facts
        render_view(trained.model, facts, trained.known.cameras, 0, trained.config.render, look)

    assert order_of_calls(steps, restyled) == codes(steps)


def test_a_slider_of_gaussians_goes_as_it_is_drawn(listener: Listener, world: World, tmp_path: Path) -> None:
    steps = lane("click", 0)
    viewed = Viewed(seen(ball(400, 2)), "ball", 1, tmp_path / "ball", pixels=64)

    def times_coloured() -> int:
        return [kind for _, kind, _ in listener.sent].count("colours Now")

    def nothing() -> Steps[None]:
        yield

    def moved() -> None:
        with Session(viewed, listener.post) as session:
            session.upload(world.references[0].read_bytes(), "dusk.png")
            # All that the photograph began is over, else its colours could be taken for the slider's.
            session._worker.result_when_idle(nothing())
            before = times_coloured()
            session.handle(1, read_message('{"type": "set", "name": "strength", "value": 0.5}'))
            listener.until(lambda: times_coloured() > before)

    # The last call of each is that of the slider; before it the photograph came.
    called = order_of_calls(steps, moved, first=False)
    assert called == [step.code for step in steps if not step.code.startswith("page.server")]
