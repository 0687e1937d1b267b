"""Distils the semantic encoder: one small network learns what several large ones say together, in any light.

The student sees a photograph in a random light, the teachers saw it as it is: so day and night agree.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import UsageError
from ..interfaces import Encoder
from ..ops.precision import double
from ..plugins.encoders.bundled import SEMANTIC_KIND, load_semantic_encoder
from ..plugins.encoders.students import SemanticStudent
from ..plugins.weightfiles import write_weights
from ..training.prepare import device_of
from .config import SemanticDistilConfig
from .ensemble import COMPONENTS, Ensemble, semantic_ensemble, taught
from .loop import generator_of, train
from .photos import crop, find_photos, load_photo, split
from .prepared import prepared, prepared_path
from .teachers import load_teacher
from .toning import nightfall, toned
from .towns import render_streets, street_targets

__all__ = ["pretrain_semantic", "relations", "semantic_report", "view"]

BASIS_CROPS = 100
SCALES = (1.0, 1.5)
"""Photographs to learn from are small: scene images show the same things larger."""
STRIDE = 8
WINDOW = (0.5, 0.95)
"""Share of a crop's side that the student sees at a time; it sees all of them at one size."""
SEEN = 0.6
"""That size, as a share of the crop's side."""
RELATED = 512
"""Cells of a batch that are compared with each other."""
RELATIONS = 2.0
"""Weight of that comparison."""
Report = dict[str, float | int | str]


def pretrain_semantic(config: SemanticDistilConfig, output: Path, say: Callable[[str], None]) -> Report:
    """Train, write `output`, and measure it on held-out photographs."""
    if not config.teachers:
        raise UsageError("--teachers: none; `semantic` takes the weights of MobileNetV2, of DeepLab's backbone, or both")
    if config.size % STRIDE:
        raise UsageError(f"--size: {config.size}; `semantic` takes multiples of {STRIDE}, its stride")
    device = device_of(config.device)
    teachers = [load_teacher(path).to(device) for path in config.teachers]
    photos, held = split(find_photos(config.images)[: config.photos])
    say(f"{len(photos)} photographs to learn from, {len(held)} held out")
    samples = [
        crop(load_photo(p), config.size, SCALES, generator_of(config.seed + 2, i)) for i, p in enumerate(photos[:BASIS_CROPS])
    ]
    ensemble = semantic_ensemble(teachers, samples, STRIDE)
    kept = ", ".join(f"{100 * basis.kept:.1f} %" for _, basis in ensemble)
    say(f"{COMPONENTS} components of each teacher keep {kept} of its energy")
    images, targets = prepared(lambda: _examples(ensemble, photos, config), config, output)
    say(f"{len(images)} crops prepared")

    torch.manual_seed(config.seed)
    student = SemanticStudent(sum(len(basis.axes) for _, basis in ensemble)).to(device)

    def loss(generator: torch.Generator) -> Tensor:
        index = torch.randint(0, len(images), (config.batch,), generator=generator).tolist()
        views = [view(images[i], targets[i], generator) for i in index]
        seen, wanted = (torch.stack(part).to(device) for part in zip(*views, strict=True))
        found = student(seen)
        own = F.mse_loss(found, wanted) + (1 - F.cosine_similarity(found, wanted, dim=1).mean())
        return own + RELATIONS * relations(found, wanted, RELATED, generator)

    steps = train(student, loss, config, output, say)
    metadata = {
        "kind": SEMANTIC_KIND,
        "imitates": f"{COMPONENTS} principal components each of {', '.join(teacher.name for teacher in teachers)}",
        "made_by": f"fprf pretrain semantic, {steps} steps on {len(photos)} photographs and {config.towns} rendered streets, "
        f"seed {config.seed}",
        "licence": "Apache-2.0; trained by this project, holds no weights of its teachers",
    }
    write_weights(output, {name: _stored(value) for name, value in student.state_dict().items()}, metadata)
    report = semantic_report(load_semantic_encoder(output).to(device), ensemble, held, config)
    prepared_path(output).unlink(missing_ok=True)
    return {"steps": steps, **report}


def relations(
    found: Annotated[Tensor, "B C h w"], wanted: Annotated[Tensor, "B C h w"], cells: int, generator: torch.Generator
) -> Annotated[Tensor, ""]:
    """Mean square difference of the cosines between `cells` random cells of a batch: what matching goes by.

    Each side is centred on its own mean, as the matching of scenes and references is.
    """
    index = torch.randint(0, found[:, 0].numel(), (cells,), generator=generator)
    sides = [side.permute(0, 2, 3, 1).flatten(0, 2)[index.to(side.device)] for side in (found, wanted)]
    unit = [F.normalize(side - side.mean(0), dim=1) for side in sides]
    return F.mse_loss(unit[0] @ unit[0].T, unit[1] @ unit[1].T)


@torch.no_grad()
def semantic_report(student: Encoder, ensemble: Ensemble, photos: Sequence[Path], config: SemanticDistilConfig) -> Report:
    """Agreement with the teachers on held-out crops, and of each crop with itself at night; mean cosines."""
    images, wanted = _crops(ensemble, photos, config, config.seed + 3)
    generator, device = generator_of(config.seed + 4, 0), device_of(config.device)
    cosines, nights, error, energy = 0.0, 0.0, 0.0, 0.0
    for image, target in zip(images, wanted.float(), strict=True):
        day = image[None].float() / 255
        target = target.to(device)
        found = student(day.to(device))
        night = student(nightfall(day[0], generator)[None].to(device))
        cosines += float(F.cosine_similarity(found, target[None], dim=1).mean())
        nights += float(F.cosine_similarity(found, night, dim=1).mean())
        error += float(double(found - target).square().mean())
        energy += float(double(target).square().mean())
    return {
        "crops": len(images),
        "relative_l2": round((error / energy) ** 0.5, 4),
        "teacher_cosine": round(cosines / len(images), 4),
        "night_cosine": round(nights / len(images), 4),
    }


def view(
    image: Annotated[Tensor, "3 s s"], target: Annotated[Tensor, "C t t"], generator: torch.Generator
) -> tuple[Annotated[Tensor, "3 v v"], Annotated[Tensor, "C u u"]]:
    """A random part of a crop in a random light, mirrored half the time, and what the teachers said of it.

    Parts differ in size and are shown at one: near and far must look alike.
    """
    cells = target.shape[-1]
    least, most = (max(1, round(share * cells)) for share in WINDOW)
    side = int(torch.randint(least, most + 1, (), generator=generator))
    top, left = torch.randint(0, cells - side + 1, (2,), generator=generator).tolist()
    right = target[:, top : top + side, left : left + side].float()
    rows, columns = (slice(STRIDE * first, STRIDE * (first + side)) for first in (top, left))
    seen = toned(image[:, rows, columns].float() / 255, generator)
    shown = max(1, round(SEEN * cells))
    seen = F.interpolate(seen[None], (STRIDE * shown,) * 2, mode="bilinear", align_corners=False, antialias=shown < side)[0]
    right = F.interpolate(right[None], (shown, shown), mode="bilinear", align_corners=False, antialias=shown < side)[0]
    if torch.rand(1, generator=generator) < 0.5:
        return seen.flip(-1), right.flip(-1)
    return seen, right


def _examples(ensemble: Ensemble, photos: Sequence[Path], config: SemanticDistilConfig) -> tuple[Tensor, Tensor]:
    """Crops of photographs, then streets: every palette of a view with the same target."""
    images, targets = _crops(ensemble, photos, config, config.seed + 1)
    if config.towns == 0:
        return images, targets
    streets = render_streets(config.towns, config.size, STRIDE)
    palettes = streets.images.shape[1]
    said = street_targets(ensemble, streets, STRIDE).half().repeat_interleave(palettes, 0)
    return torch.cat([images, streets.images.flatten(0, 1)]), torch.cat([targets, said])


@torch.no_grad()
def _crops(
    ensemble: Ensemble, photos: Sequence[Path], config: SemanticDistilConfig, seed: int
) -> tuple[Annotated[Tensor, "N 3 s s"], Annotated[Tensor, "N C t t"]]:
    """Crops as bytes and their targets in half precision."""
    images, targets = [], []
    for index, path in enumerate(photos):
        generator, photo = generator_of(seed, index), load_photo(path)
        batch = torch.stack([crop(photo, config.size, SCALES, generator) for _ in range(config.crops)])
        batch = (batch * 255).round()
        images.append(batch.byte())
        targets.append(taught(ensemble, batch / 255, STRIDE).half().cpu())
    return torch.cat(images), torch.cat(targets)


def _stored(value: Tensor) -> Tensor:
    """Kernels in half precision; statistics keep their range."""
    return value.half() if value.ndim > 1 else value
