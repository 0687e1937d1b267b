"""What `--precision` costs: colours and gradients of one batch in bfloat16 and TF32, against float32, on the CPU.

    python -m benchmarks precision RUN [--data DIR] [--rays 1024] [--output benchmarks/results/precision.json]

bfloat16 is autocast as training on a GPU enters it, on the plain forms. The CPU has no TF32: factors of the networks' products
are rounded to its 11 bits, sums are float32, as in tensor cores.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from unittest import mock

import torch
import torch.nn.functional as F
from torch import Tensor

from fprf.config import TrainConfig
from fprf.datamanagers.parsers.config import parse_scene
from fprf.ops.backend import plain
from fprf.rendering.renderer import render_rays
from fprf.training import checkpoint
from fprf.training.model import Model, background_of, build_model
from fprf.training.prepare import Prepared, cache_folder
from fprf.training.run import Run
from fprf.types import Want

from .common import RESULTS, arguments, report
from .report import machine
from .subject import batch_rays


class Rounded(torch.autograd.Function):
    """x W^T with factors of 11 bits, forward and backward."""

    @staticmethod
    def forward(ctx, x: Tensor, weight: Tensor) -> Tensor:  # type: ignore[no-untyped-def]
        ctx.save_for_backward(x, weight)
        return tf32(x) @ tf32(weight).T

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[no-untyped-def]
        x, weight = ctx.saved_tensors
        return tf32(grad) @ tf32(weight), tf32(grad).T @ tf32(x)


def tf32(x: Tensor) -> Tensor:
    """Rounded to a mantissa of 10 bits after the first."""
    bits = x.contiguous().view(torch.int32)
    return ((bits + 0x1000) & ~0x1FFF).view(torch.float32)


@contextmanager
def rounded() -> Iterator[None]:
    """TF32 in the networks of `ops.dense`."""

    def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
        product: Tensor = Rounded.apply(x, weight)  # type: ignore[no-untyped-call]
        return product if bias is None else product + bias

    with mock.patch.object(F, "linear", linear):
        yield


def answers(model: Model, prepared: Prepared, config: TrainConfig, step: int) -> tuple[Tensor, Tensor]:
    """Colours of a batch, and the gradient of their loss in all that is learnt, flat."""
    batch = prepared.manager.batch(step)
    background = background_of(prepared.facts, torch.device("cpu"))
    rays, budget = batch_rays(model, prepared, batch), config.render.train_budget
    rgb = render_rays(rays, model.parts, want=Want.COLOUR, budget=budget, background=background, step=step).rgb
    assert rgb is not None
    parameters = model.learned()
    found = torch.autograd.grad(F.mse_loss(rgb, batch.rgb), parameters, allow_unused=True)
    flat = torch.cat([(torch.zeros_like(p) if g is None else g).flatten() for p, g in zip(parameters, found, strict=True)])
    return rgb.detach(), flat


def main(argv: list[str]) -> None:
    """Measure and write."""
    parser = arguments("precision", __doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--rays", type=int, default=1024)
    parser.add_argument("--output", type=Path, default=RESULTS / "precision.json")
    args = parser.parse_args(argv)
    run = Run(args.run)
    config, method = run.load_config()
    known = run.load_known()
    saved, _ = checkpoint.load_latest(run.checkpoints)
    assert saved is not None, "a run with a checkpoint is needed"
    scene = parse_scene(args.data or config.data, config.downscale, config.datamanager.parser)
    batches = type(config.datamanager)(rays=args.rays)  # type: ignore[call-arg]
    manager = batches.build(scene=scene, content=None, semantic=None, dim=1, cache=cache_folder(), seed=config.seed)
    prepared = Prepared(scene, manager, known.facts, None)
    model = build_model(config, known.facts)
    checkpoint.restore(saved, model, None)
    forms: dict[str, AbstractContextManager[object]] = {
        "tf32": rounded(),
        "bfloat16": torch.autocast("cpu", torch.bfloat16),
    }
    with plain():
        rgb, gradient = answers(model, prepared, config, saved.step)
        rows = {}
        for name, form in forms.items():
            with form:
                colours, slopes = answers(model, prepared, config, saved.step)
            off = (colours - rgb).abs()
            rows[name] = {
                "largest_colour_error": float(off.max()),
                "rms_colour_error": float(off.square().mean().sqrt()),
                "gradient_relative_l2": float((slopes - gradient).norm() / gradient.norm()),
                "gradient_cosine": float(F.cosine_similarity(slopes.double(), gradient.double(), dim=0)),
            }
            print(name, rows[name])
    about = {"method": method, "scene": known.name, "step": saved.step, "rays": args.rays}
    report(args.output, {"machine": machine(torch.device("cpu")), "run": about, "errors": rows})
