"""Distils the semantic encoder: one small network learns the principal components of two large ones, in any light.

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
from ..plugins.encoders.bundled import SEMANTIC_KIND, load_semantic_encoder
from ..plugins.encoders.students import SemanticStudent
from ..plugins.weightfiles import write_weights
from .basis import Basis, fit_basis
from .config import DistilConfig
from .loop import generator_of, train
from .photos import crop, find_photos, load_photo, split
from .prepared import prepared, prepared_path
from .teachers import MobileNetTeacher, load_teacher
from .toning import nightfall, toned

__all__ = ["pretrain_semantic", "semantic_bases", "semantic_report", "view"]

COMPONENTS = 24
"""Principal components kept of each teacher."""
BASIS_CROPS = 200
SCALES = (1.0, 1.8)
"""Photographs to learn from are small: scene images show the same things larger."""
TEACHER_SCALE = 1.25
"""Teachers see the crop enlarged, which makes their stride of 16 finer."""
STRIDE = 8
WINDOW = 0.75
"""Share of a crop's side that the student sees at a time."""
Report = dict[str, float | int | str]
Teachers = Sequence[tuple[MobileNetTeacher, Basis]]


def pretrain_semantic(config: DistilConfig, output: Path, say: Callable[[str], None]) -> Report:
    """Train, write `output`, and measure it on held-out photographs."""
    if not config.teachers:
        raise UsageError("--teachers: none; `semantic` takes the weights of MobileNetV2, of DeepLab's backbone, or both")
    if config.size % STRIDE:
        raise UsageError(f"--size: {config.size}; `semantic` takes multiples of {STRIDE}, its stride")
    names = [load_teacher(path) for path in config.teachers]
    photos, held = split(find_photos(config.images)[: config.photos])
    say(f"{len(photos)} photographs to learn from, {len(held)} held out")
    teachers = semantic_bases(names, photos[:BASIS_CROPS], config)
    kept = ", ".join(f"{100 * basis.kept:.1f} %" for _, basis in teachers)
    say(f"{COMPONENTS} components of each teacher keep {kept} of its energy")
    images, targets = prepared(lambda: _crops(teachers, photos, config, config.seed + 1), config, output)
    say(f"{len(images)} crops prepared")

    torch.manual_seed(config.seed)
    student = SemanticStudent(sum(len(basis.axes) for _, basis in teachers))

    def loss(generator: torch.Generator) -> Tensor:
        index = torch.randint(0, len(images), (config.batch,), generator=generator).tolist()
        views = [view(images[i], targets[i], generator) for i in index]
        found, wanted = student(torch.stack([seen for seen, _ in views])), torch.stack([right for _, right in views])
        return F.mse_loss(found, wanted) + (1 - F.cosine_similarity(found, wanted, dim=1).mean())

    steps = train(student, loss, config, output, say)
    metadata = {
        "kind": SEMANTIC_KIND,
        "imitates": f"{COMPONENTS} principal components each of {', '.join(teacher.name for teacher in names)}",
        "made_by": f"fprf pretrain semantic, {steps} steps on {len(photos)} photographs, seed {config.seed}",
        "licence": "Apache-2.0; trained by this project, holds no weights of its teachers",
    }
    write_weights(output, {name: _stored(value) for name, value in student.state_dict().items()}, metadata)
    report = semantic_report(load_semantic_encoder(output), teachers, held, config)
    prepared_path(output).unlink(missing_ok=True)
    return {"steps": steps, **report}


def semantic_bases(names: Sequence[MobileNetTeacher], photos: Sequence[Path], config: DistilConfig) -> Teachers:
    """The principal components of each teacher; each is scaled to unit variance per channel, so that both weigh the same."""
    samples: list[list[Tensor]] = [[] for _ in names]
    for index, path in enumerate(photos):
        image = crop(load_photo(path), config.size, SCALES, generator_of(config.seed + 2, index))[None]
        for place, teacher in enumerate(names):
            samples[place].append(_seen(teacher, image).flatten(2)[0].T)
    return [(teacher, fit_basis(torch.cat(found), (COMPONENTS,), 1.0)) for teacher, found in zip(names, samples, strict=True)]


@torch.no_grad()
def semantic_report(student: Encoder, teachers: Teachers, photos: Sequence[Path], config: DistilConfig) -> Report:
    """Agreement with the teachers on held-out crops, and of each crop with itself at night; mean cosines."""
    images, wanted = _crops(teachers, photos, config, config.seed + 3)
    generator = generator_of(config.seed + 4, 0)
    cosines, nights, error, energy = 0.0, 0.0, 0.0, 0.0
    for image, target in zip(images, wanted.float(), strict=True):
        day = image[None].float() / 255
        found = student(day)
        night = student(nightfall(day[0], generator)[None])
        cosines += float(F.cosine_similarity(found, target[None], dim=1).mean())
        nights += float(F.cosine_similarity(found, night, dim=1).mean())
        error += float((found - target).double().square().mean())
        energy += float(target.double().square().mean())
    return {
        "crops": len(images),
        "relative_l2": round((error / energy) ** 0.5, 4),
        "teacher_cosine": round(cosines / len(images), 4),
        "night_cosine": round(nights / len(images), 4),
    }


def view(
    image: Annotated[Tensor, "3 s s"], target: Annotated[Tensor, "C t t"], generator: torch.Generator
) -> tuple[Annotated[Tensor, "3 v v"], Annotated[Tensor, "C u u"]]:
    """A random part of a crop in a random light, mirrored half the time, and what the teachers said of it."""
    cells = target.shape[-1]
    side = max(1, round(WINDOW * cells))
    top, left = torch.randint(0, cells - side + 1, (2,), generator=generator).tolist()
    right = target[:, top : top + side, left : left + side].float()
    rows, columns = (slice(STRIDE * first, STRIDE * (first + side)) for first in (top, left))
    seen = toned(image[:, rows, columns].float() / 255, generator)
    if torch.rand(1, generator=generator) < 0.5:
        return seen.flip(-1), right.flip(-1)
    return seen, right


def _seen(teacher: MobileNetTeacher, images: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B F h w"]:
    size = [round(n * TEACHER_SCALE) for n in images.shape[-2:]]
    return teacher(F.interpolate(images, size, mode="bilinear", align_corners=False))


@torch.no_grad()
def _crops(
    teachers: Teachers, photos: Sequence[Path], config: DistilConfig, seed: int
) -> tuple[Annotated[Tensor, "N 3 s s"], Annotated[Tensor, "N C t t"]]:
    """Crops as bytes and their targets in half precision."""
    images, targets = [], []
    cells = -(-config.size // STRIDE)
    for index, path in enumerate(photos):
        generator, photo = generator_of(seed, index), load_photo(path)
        batch = torch.stack([crop(photo, config.size, SCALES, generator) for _ in range(config.crops)])
        batch = (batch * 255).round()
        maps = [basis.project(_seen(teacher, batch / 255)) for teacher, basis in teachers]
        maps = [F.interpolate(each, (cells, cells), mode="bilinear", align_corners=False) for each in maps]
        images.append(batch.byte())
        targets.append(torch.cat(maps, dim=1).half())
    return torch.cat(images), torch.cat(targets)


def _stored(value: Tensor) -> Tensor:
    """Kernels in half precision; statistics keep their range."""
    return value.half() if value.ndim > 1 else value
