"""Subject of a benchmark: a trained run, its images where they are at hand, references; single training steps
and views.

The exact result of a view is the run's own image, sampled as it was trained, in float64 with nothing skipped.
"""

import copy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from fprf.config import RenderConfig, TrainConfig
from fprf.errors import FprfError, UsageError, WeightsError
from fprf.interfaces import Parts
from fprf.io.images import write_image
from fprf.ops import backend
from fprf.rendering.cameras import Cameras, PixelRays
from fprf.rendering.renderer import TrainingStep, march, render_rays
from fprf.style.look import Restyle
from fprf.training.facts import Facts
from fprf.training.field_learner import FieldLearner
from fprf.training.field_scene import Trained, load_run
from fprf.training.field_setup import Prepared, prepare
from fprf.training.model import Model, background_of, build_model
from fprf.training.prepare import read_scene
from fprf.training.run import view_names
from fprf.training.views import view_rays as world_rays
from fprf.types import Batch, Rays, Want

from .common import BenchConfig
from .report import Watch
from .town.layout import build_town
from .town.palettes import palette
from .town.render import render, walk

LOOKS = {"autumn": (3, 9), "winter": (5, 14), "night": (2, 4)}
"""Palette of each default reference, with the seed of the town that it shows and the view of it."""


class Subject(NamedTuple):
    """One run and what goes with it."""

    trained: Trained
    references: tuple[Path, ...]
    data: Path
    """Folder of its images."""
    prepare: Callable[[TrainConfig], Prepared]
    """Images and features for the run's config, or one that differs in its batches. Raises FprfError where
    they are not at hand.
    """


def find(root: Path, config: BenchConfig, folder: Path) -> Subject:
    """The run in `root`; `folder` takes what is made on the way."""
    trained = load_run(root, config.device)
    data = config.data or trained.config.data or Path(trained.known.data)

    def prepared(chosen: TrainConfig) -> Prepared:
        chosen = replace(chosen, data=data)
        saved = trained.known.facts
        made = prepare(chosen, read_scene(chosen, saved), saved)
        if tuple(view_names(made.scene.paths)) != trained.known.names:
            raise UsageError(f"{data}: its images are not those of the run; name the folder with --data")
        for kind in ("content_encoder", "semantic_encoder"):
            own = getattr(trained.known.facts.of_field, kind)
            now = getattr(made.facts.of_field, kind)
            if own != now:
                raise WeightsError(
                    f"{kind.replace('_', ' ')}: the run was trained with {own}, this is {now}; train it again"
                )
        return made

    return Subject(trained, config.references or town_references(folder / "references"), data, prepared)


def attempt(subject: Subject) -> tuple[Prepared | None, str]:
    """Data of training, or the reason why it is not at hand: rendering can be measured without."""
    try:
        return subject.prepare(subject.trained.config), ""
    except FprfError as error:
        return None, str(error)


def fresh_model(trained: Trained) -> Model:
    """A copy of the run's model that may be trained."""
    model = build_model(trained.config, trained.known.facts)
    model.load_state_dict(trained.model.state_dict())
    return model.to(trained.model.device)


def watch_of(config: BenchConfig, trained: Trained) -> Watch:
    """Timing of this run."""
    return Watch(config.repeats, trained.model.device, config.clock)


def settings(config: BenchConfig, trained: Trained, missing: str) -> dict[str, object]:
    """Settings that figures depend on; `missing` says why some are absent."""
    return {
        "method": trained.method,
        "scene": trained.known.name,
        "trained_steps": trained.step,
        "rounds": config.repeats,
        "clock": config.clock,
        "budget": trained.config.render.budget,
        "chunk": trained.config.render.chunk,
        "without": missing,
    }


def test_view(config: BenchConfig, trained: Trained) -> Cameras:
    """The first held-out view, no larger than `config.rays`."""
    known = trained.known
    return small_view(known.cameras, (known.test or known.train)[0], config.rays)


def size_of(cameras: Cameras) -> str:
    """Width and height of the first view."""
    width, height = (int(v) for v in cameras.size[0])
    return f"{width}x{height}"


def small_view(cameras: Cameras, view: int, rays: int) -> Cameras:
    """One view alone (as view 0), no larger than so many pixels."""
    one = cameras.select(torch.tensor([view]))
    area = float(one.size.prod())
    return one if area <= rays else one.resized((one.size * (rays / area) ** 0.5).floor().clamp_min(1))


def town_references(folder: Path) -> tuple[Path, ...]:
    """One picture of another town for each look."""
    paths = []
    for look, (seed, view) in LOOKS.items():
        path = folder / f"{look}.png"
        camera = walk(seed=seed, views=20, width=160, height=120)[view]
        write_image(path, render(build_town(seed), camera, palette(look)).rgb)
        paths.append(path)
    return tuple(paths)


SHARE = 0.5
"""Place in the learning-rate schedule at which a step is taken."""


def loop_of(config: TrainConfig, prepared: Prepared, model: Model) -> FieldLearner:
    """Parts of a training step around a model."""
    return FieldLearner(config, prepared, model.device, model)


def stepper(loop: FieldLearner, first: int) -> Callable[[], None]:
    """A call that takes the next step, from `first` on."""
    step = first

    def take() -> None:
        nonlocal step
        loop.step(step, SHARE)
        step += 1

    return take


def colour_gradient(
    model: Model, prepared: Prepared, config: TrainConfig, batch: Batch, rays: Rays, step: int
) -> Tensor:
    """Gradient of the colour loss of a batch in all that the content field learns, flat.

    Samples are not jittered: draws in float32 and float64 would differ.
    """
    out = render_rays(
        rays,
        model.parts,
        want=Want.COLOUR,
        budget=config.render.train_budget,
        background=background_of(prepared.facts, rays.near.device),
        training=TrainingStep(step=step),
    )
    assert out.rgb is not None
    loss = (out.rgb - batch.rgb.to(out.rgb)).square().mean()
    parameters = [p for p in model.field.parameters() if p.requires_grad]
    gradients = torch.autograd.grad(loss, parameters, allow_unused=True)
    return torch.cat(
        [
            (torch.zeros_like(p) if g is None else g).flatten()
            for p, g in zip(parameters, gradients, strict=True)
        ]
    )


def batch_rays(model: Model, prepared: Prepared, batch: Batch) -> Rays:
    """Rays of a batch, on the model's device."""
    rays = model.space.rays(*PixelRays(prepared.scene.cameras)(batch.view.cpu(), batch.pixel.cpu()))
    return Rays(*(x.to(model.device) for x in rays))


M = TypeVar("M", bound=nn.Module)
CHUNK = 4096


class Difference(NamedTuple):
    """Of two images in [0, 1]."""

    largest: float
    rms: float


def view_rays(model: Model, cameras: Cameras, view: int) -> Rays:
    """Rays of all pixels, on the model's device."""
    return world_rays(model, cameras, view)[0]


def exact(model: Model, facts: Facts, rays: Rays, restyle: Restyle | None = None) -> Annotated[Tensor, "R 3"]:
    """Colours in [0, 1] in float64, nothing skipped."""
    restyle = None if restyle is None else replace(restyle, stylizer=_double(restyle.stylizer))
    return _colours(_double(model), facts, Rays(*(x.double() for x in rays)), 0.0, CHUNK, restyle)


def plainly(
    model: Model, facts: Facts, rays: Rays, render: RenderConfig, look: Restyle | None = None
) -> Annotated[Tensor, "R 3"]:
    """Colours in [0, 1] without compiled kernels."""
    with backend.plain():
        return _colours(model, facts, rays, render.budget, render.chunk, look)


@torch.inference_mode()
def _colours(
    model: Model, facts: Facts, rays: Rays, budget: float, chunk: int, look: Restyle | None
) -> Tensor:
    background = background_of(facts, rays.near.device)
    rgb = []
    for part in _chunks(rays, chunk):
        out = render_rays(
            part, model.parts, want=Want.COLOUR, budget=budget, background=background, restyle=look
        )
        assert out.rgb is not None
        rgb.append(out.rgb)
    return torch.cat(rgb).clamp(0, 1)


@torch.inference_mode()
def count(parts: Parts, rays: Rays, budget: float) -> dict[str, float]:
    """Shares of the samples that a budget keeps (for the content network), of the rays that keep none; kept
    ones a ray.
    """
    samples = kept = empty = 0
    for part in _chunks(rays, CHUNK):
        marched = march(part, parts, budget=budget)
        samples = samples + marched.weights.numel()
        kept = kept + len(marched.kept.ray)
        empty += len(part.near) - len(torch.unique(marched.kept.ray))
    return {
        "kept_samples_share": kept / max(1, samples),
        "empty_rays_share": empty / max(1, len(rays.near)),
        "kept_samples_per_ray": kept / max(1, len(rays.near)),
    }


def difference(image: Tensor, truth: Tensor) -> Difference:
    """Largest and root-mean-square difference."""
    away = image.double().flatten() - truth.double().flatten()
    return Difference(float(away.abs().max()), float(away.square().mean().sqrt()))


def _double(module: M) -> M:
    return copy.deepcopy(module).double()


def _chunks(rays: Rays, size: int) -> list[Rays]:
    return [Rays(*(x[at : at + size] for x in rays)) for at in range(0, len(rays.near), size)]
