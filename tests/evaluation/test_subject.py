import json
import shutil
from dataclasses import replace
from pathlib import Path

import torch
from tiny_world import World

from fprf.evaluation.config import SpeedConfig
from fprf.evaluation.subject import (
    attempt,
    batch_rays,
    colour_gradient,
    find,
    fresh_model,
    loop_of,
    stepper,
)


def test_a_run_without_images_can_be_measured_but_for_training(world: World, tmp_path: Path) -> None:
    shutil.copytree(world.run, tmp_path / "run")
    config = tmp_path / "run" / "config.json"
    config.write_text(config.read_text().replace(str(world.town), str(tmp_path / "gone")))
    asked = SpeedConfig(references=world.references, device="cpu")
    prepared, missing = attempt(find(tmp_path / "run", asked, tmp_path))
    assert prepared is None and f"{tmp_path / 'gone'}: no such folder" in missing
    prepared, missing = attempt(find(tmp_path / "run", replace(asked, data=world.town), tmp_path))
    assert prepared is not None and missing == ""


def test_other_encoders_than_the_runs_are_refused(world: World, tmp_path: Path) -> None:
    shutil.copytree(world.run, tmp_path / "run")
    scene = tmp_path / "run" / "scene.json"
    known = json.loads(scene.read_text())
    known["facts"]["semantic_encoder"] = "another:1234"
    scene.write_text(json.dumps(known))
    _, missing = attempt(find(tmp_path / "run", SpeedConfig(references=world.references, device="cpu"), tmp_path))
    assert missing.startswith("semantic encoder: the run was trained with another:1234")


def test_steps_train_a_copy(world: World) -> None:
    trained = world.load()
    before = {name: tensor.clone() for name, tensor in trained.model.state_dict().items()}
    model = fresh_model(trained)
    assert model.learned() and all(torch.equal(before[name], t) for name, t in model.state_dict().items())
    take = stepper(loop_of(trained.config, world.prepared, model), trained.step)
    for _ in range(3):
        take()
    assert all(torch.equal(before[name], t) for name, t in trained.model.state_dict().items())
    assert any(not torch.equal(before[name], t) for name, t in model.state_dict().items())


def test_skipping_moves_the_gradient_and_exactness_does_not(world: World) -> None:
    trained, prepared = world.load(), world.prepared
    batch = prepared.manager.batch(3)

    def gradient(budget: float, dtype: torch.dtype) -> torch.Tensor:
        model = fresh_model(trained).to(dtype)
        config = replace(trained.config, render=replace(trained.config.render, train_budget=budget))
        rays = batch_rays(model, prepared, batch)
        rays = type(rays)(*(x.to(dtype) for x in rays))
        return colour_gradient(model, prepared, config, batch, rays, 3).double()

    truth = gradient(0.0, torch.float64)
    errors = [float((gradient(b, torch.float32) - truth).norm() / truth.norm()) for b in (0.0, 0.2, 0.45)]
    assert errors[0] < 1e-4 < errors[1] < errors[2]
