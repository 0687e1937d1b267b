from dataclasses import replace

import pytest
from traced import codes, lane, order_of_calls

from fprf.datamanagers.scene import ParsedScene
from fprf.splats import learner as learning
from fprf.splats.config import GaussiansConfig
from fprf.splats.setup import build
from fprf.training.driver import learn, schedule_of


def test_a_step_of_gaussians_goes_as_it_is_drawn(
    config: GaussiansConfig, scene: ParsedScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learning, "_MIN_RELOCATION_STEP", 0)
    asked = replace(config, steps=25)
    learner = build(asked, scene)
    steps = lane("training-step", 1)
    schedule = schedule_of(asked, len(scene.train))
    called = order_of_calls(steps, lambda: learn(learner, None, schedule, lambda report: None))
    assert called == codes(steps)
