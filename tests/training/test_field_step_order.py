from pathlib import Path

from tiny_world import World
from traced import codes, lane, order_of_calls

from fprf.training.driver import learn, schedule_of
from fprf.training.field_learner import FieldLearner
from fprf.training.prepare import device_of
from fprf.training.run import Run


def test_a_step_of_fields_goes_as_it_is_drawn(world: World, tmp_path: Path) -> None:
    steps = lane("training-step", 0)
    learner = FieldLearner(world.config, world.prepared, device_of("cpu"))
    schedule = schedule_of(world.config, len(world.prepared.scene.train))
    run = Run(tmp_path)
    assert order_of_calls(steps, lambda: learn(learner, run, schedule, lambda report: None)) == codes(steps)
