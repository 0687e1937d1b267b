from dataclasses import replace
from pathlib import Path

import pytest
from tiny_world import World

from benchmarks.knobs import VARIANTS, trained_points, variants
from benchmarks.pareto import ParetoConfig, Scenes
from fprf.datamanagers.config import DataManagerConfig
from fprf.evaluation.report import Watch
from fprf.evaluation.subject import find, small_view
from fprf.methods import fprf, fprf_lite
from fprf.plugins.samplers.config import UniformConfig


@pytest.mark.parametrize("method", [fprf, fprf_lite])
def test_each_variant_of_a_method_changes_one_knob(method: object) -> None:
    assert callable(method)
    config = method()
    found = variants(config)
    assert found.pop("as it is") == config and len(found) == len(VARIANTS)
    for path, (name, changed) in zip(VARIANTS, found.items(), strict=True):
        assert name.startswith(f"{path} ") and changed != config
        top = path.partition(".")[0]
        assert replace(changed, **{top: getattr(config, top)}) == config


def test_knobs_that_a_plug_in_lacks_are_left_out() -> None:
    config = replace(fprf_lite(), sampler=UniformConfig(), datamanager=DataManagerConfig())
    assert not [name for name in variants(config) if name.startswith(("sampler.", "datamanager."))]


def test_variants_are_trained_and_judged(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.knobs.VARIANTS", {"semantic.samples": VARIANTS["semantic.samples"]})
    subject = find(world.run, ParetoConfig(references=world.references, device="cpu"), tmp_path)
    trained = subject.trained
    camera = small_view(trained.known.cameras, trained.known.test[0], 200)
    width, height = camera.size[0].tolist()
    photograph = world.prepared.manager.image(trained.known.test[0])[:height, :width]
    scenes, watch = Scenes([camera], [photograph], None), Watch(1, next(trained.model.parameters()).device)
    told: list[str] = []
    points = trained_points(0.005, subject, scenes, watch, tmp_path, lambda done, total, what: told.append(what))
    assert [point.value.rpartition(" (")[0] for point in points] == ["as it is", "semantic.samples 48"]
    for point in points:
        assert point.psnr is not None and 5 < point.psnr < 60 and point.rms is None
        assert point.train_seconds is not None and point.train_seconds >= 0.3
    assert set(told) == {"training variants"}
