"""Distillation of the semantic encoder: one small network learns what several large ones say together, in any
light.

The student sees a photograph in a random light, the teachers saw it as it is. Teachers are averaged over
scales and mirror images, which is steadier and finer than a single pass: on 40 pairs of photographs two
MobileNetV2s averaged find the right region in 83 % of the cells, the better one alone in 77 %. Rendered
streets of the town, each in every palette, are learnt as well.
"""

from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.town.layout import build_town
from benchmarks.town.palettes import PALETTES
from benchmarks.town.render import geometry, render, walk
from benchmarks.town.surface import CLASSES
from fprf.errors import UsageError, WeightsError
from fprf.interfaces import Encoder
from fprf.ops.backend import double
from fprf.plugins.encoders.bundled import SEMANTIC_KIND, SemanticStudent, load_semantic_encoder
from fprf.plugins.encoders.frozen import replicate_to_multiple
from fprf.plugins.weights import read_weights, write_weights
from fprf.pretraining.loop import generator_of, train
from fprf.pretraining.photos import find_photos, load_photo, split
from fprf.training.prepare import device_of

from .config import SemanticDistilConfig
from .content import Basis, fit_basis
from .examples import crop, nightfall, prepared, prepared_path, toned
from .mobilenet import CLASSIFIER, DEEPLAB, MobileNetV2, fold

CELL = 16
"""Pixels per feature."""


class MobileNetTeacher:
    """A network that is not resized to: borders are repeated until cells cover the image."""

    def __init__(self, name: str, network: MobileNetV2) -> None:
        self.name = name
        self._network = network

    def to(self, device: torch.device) -> "MobileNetTeacher":
        """Move the network to a device."""
        self._network.to(device)
        return self

    @property
    def device(self) -> torch.device:
        """Device of the network."""
        return next(chain(self._network.parameters(), self._network.buffers())).device

    @torch.no_grad()
    def __call__(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B F h w"]:
        """Features of sRGB images in [0, 1], one per 16 pixels, rounded up."""
        features: Tensor = self._network(replicate_to_multiple(image, CELL))
        return features


def load_teacher(path: Path) -> MobileNetTeacher:
    """MobileNetV2 (`features.N`, up to block 13) or DeepLab's backbone (`backbone.N`, folded, up to block
    17).
    """
    tensors, _ = read_weights(path)
    if "backbone.17.conv.2.weight" in tensors:
        network = MobileNetV2(fold(tensors, "backbone."), layout=DEEPLAB, last=17)
        return MobileNetTeacher("deeplab-mobilenetv2:backbone.17", network)
    if "features.13.conv.3.running_var" in tensors:
        network = MobileNetV2(fold(tensors, "features."), layout=CLASSIFIER, last=13)
        return MobileNetTeacher("mobilenetv2:features.13", network)
    raise WeightsError(
        f"{path}: neither MobileNetV2 (features.N) nor DeepLab's MobileNetV2 backbone (backbone.N)"
    )


COMPONENTS = 32
"""Principal components kept of each teacher."""
LOOKS = (0.75, 1.0)
"""Sizes at which a teacher sees an image."""
Ensemble = Sequence[tuple[MobileNetTeacher, Basis]]


@torch.no_grad()
def look(
    teacher: MobileNetTeacher, images: Annotated[Tensor, "B 3 H W"], stride: int
) -> Annotated[Tensor, "B F h w"]:
    """Mean of a teacher's features over scales and mirror images, one per `stride` pixels, rounded up, on its
    device.
    """
    images = images.to(teacher.device)
    cells = [-(-n // stride) for n in images.shape[-2:]]
    total: Tensor | float = 0.0
    for scale in LOOKS:
        size = [max(1, round(n * scale)) for n in images.shape[-2:]]
        seen = F.interpolate(images, size, mode="bilinear", align_corners=False, antialias=scale < 1)
        both = teacher(seen) + teacher(seen.flip(-1)).flip(-1)
        total = total + F.interpolate(both, cells, mode="bilinear", align_corners=False)
    assert isinstance(total, Tensor)
    return total / (2 * len(LOOKS))


def semantic_ensemble(
    teachers: Sequence[MobileNetTeacher], images: Sequence[Annotated[Tensor, "3 H W"]], stride: int
) -> Ensemble:
    """The principal components of each teacher; each is scaled to unit variance per channel, so that all
    weigh the same.
    """
    samples = [
        [look(teacher, image[None], stride).flatten(2)[0].T for image in images] for teacher in teachers
    ]
    return [
        (teacher, fit_basis(torch.cat(found), (COMPONENTS,), 1.0))
        for teacher, found in zip(teachers, samples, strict=True)
    ]


def taught(
    ensemble: Ensemble, images: Annotated[Tensor, "B 3 H W"], stride: int
) -> Annotated[Tensor, "B C h w"]:
    """What the teachers say together: their components, one after the other."""
    return torch.cat([basis.project(look(teacher, images, stride)) for teacher, basis in ensemble], dim=1)


FIRST_SEED = 7000
"""Far from the seeds that users and tests take, so that no town is measured that was learned."""
VIEWS = 5
"""Views of each street, spread over the walk."""
TO_CLASS = 0.5
"""How far a target is drawn to the mean of its class."""


class Streets(NamedTuple):
    """V views in P palettes."""

    images: Annotated[Tensor, "V P 3 s s"]
    """Bytes; palettes in the order of `PALETTES`, day first."""
    classes: Annotated[Tensor, "V K t t"]
    """Share of each class in each cell."""


def render_streets(count: int, size: int, stride: int) -> Streets:
    """`count` streets, the same ones every time."""
    images = []
    classes = []
    for number in range(count):
        town = build_town(FIRST_SEED + number)
        for view in walk(seed=FIRST_SEED + number, views=VIEWS, width=size, height=size):
            pictures = [render(town, view, look).rgb for look in PALETTES.values()]
            images.append(torch.from_numpy(np.stack(pictures)).permute(0, 3, 1, 2))
            label = torch.from_numpy(geometry(town, view)[1]).long()
            share = F.one_hot(label, len(CLASSES)).permute(2, 0, 1)[None].float()
            classes.append(F.avg_pool2d(share, stride)[0])
    return Streets(torch.stack(images), torch.stack(classes))


def street_targets(ensemble: Ensemble, streets: Streets, stride: int) -> Annotated[Tensor, "V C t t"]:
    """What the teachers say of each view by day, half-way to the mean of the cell's classes over all
    views.
    """
    said = torch.cat([taught(ensemble, views[:1].float() / 255, stride).cpu() for views in streets.images])
    weight = streets.classes.sum((0, 2, 3)).clamp_min(
        1e-6
    )  # a class that no view shows has no mean, and needs none
    mean = torch.einsum("vkij,vcij->kc", streets.classes, said) / weight[:, None]
    return torch.lerp(said, torch.einsum("vkij,kc->vcij", streets.classes, mean), TO_CLASS)


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
        raise UsageError(
            "--teachers: none; `semantic` takes the weights of MobileNetV2, of DeepLab's backbone, or both"
        )
    if config.size % STRIDE:
        raise UsageError(f"--size: {config.size}; `semantic` takes multiples of {STRIDE}, its stride")
    device = device_of(config.device)
    teachers = [load_teacher(path).to(device) for path in config.teachers]
    photos, held = split(find_photos(config.images)[: config.photos])
    say(f"{len(photos)} photographs to learn from, {len(held)} held out")
    samples = [
        crop(load_photo(p), config.size, SCALES, generator_of(config.seed + 2, i))
        for i, p in enumerate(photos[:BASIS_CROPS])
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
        "made_by": f"python -m tools.distil semantic, {steps} steps on {len(photos)} photographs and {config.towns} rendered "
        f"streets, seed {config.seed}",
        "licence": "Apache-2.0; trained by this project, holds no weights of its teachers",
    }
    write_weights(output, {name: _stored(value) for name, value in student.state_dict().items()}, metadata)
    report = semantic_report(load_semantic_encoder(output).to(device), ensemble, held, config)
    prepared_path(output).unlink(missing_ok=True)
    return {"steps": steps, **report}


def relations(
    found: Annotated[Tensor, "B C h w"],
    wanted: Annotated[Tensor, "B C h w"],
    cells: int,
    generator: torch.Generator,
) -> Annotated[Tensor, ""]:
    """Mean square difference of the cosines between `cells` random cells of a batch: what matching goes by.

    Each side is centred on its own mean, as the matching of scenes and references is.
    """
    index = torch.randint(0, found[:, 0].numel(), (cells,), generator=generator)
    sides = [side.permute(0, 2, 3, 1).flatten(0, 2)[index.to(side.device)] for side in (found, wanted)]
    unit = [F.normalize(side - side.mean(0), dim=1) for side in sides]
    return F.mse_loss(unit[0] @ unit[0].T, unit[1] @ unit[1].T)


@torch.no_grad()
def semantic_report(
    student: Encoder, ensemble: Ensemble, photos: Sequence[Path], config: SemanticDistilConfig
) -> Report:
    """Agreement with the teachers on held-out crops, and of each crop with itself at night; mean cosines."""
    images, wanted = _crops(ensemble, photos, config, config.seed + 3)
    generator = generator_of(config.seed + 4, 0)
    device = device_of(config.device)
    cosines = 0.0
    nights = 0.0
    error = 0.0
    energy = 0.0
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
    seen = F.interpolate(
        seen[None], (STRIDE * shown,) * 2, mode="bilinear", align_corners=False, antialias=shown < side
    )[0]
    right = F.interpolate(
        right[None], (shown, shown), mode="bilinear", align_corners=False, antialias=shown < side
    )[0]
    if torch.rand(1, generator=generator) < 0.5:
        return seen.flip(-1), right.flip(-1)
    return seen, right


def _examples(
    ensemble: Ensemble, photos: Sequence[Path], config: SemanticDistilConfig
) -> tuple[Tensor, Tensor]:
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
    images = []
    targets = []
    for index, path in enumerate(photos):
        generator = generator_of(seed, index)
        photo = load_photo(path)
        batch = torch.stack([crop(photo, config.size, SCALES, generator) for _ in range(config.crops)])
        batch = (batch * 255).round()
        images.append(batch.byte())
        targets.append(taught(ensemble, batch / 255, STRIDE).half().cpu())
    return torch.cat(images), torch.cat(targets)


def _stored(value: Tensor) -> Tensor:
    """Kernels in half precision; statistics keep their range."""
    return value.half() if value.ndim > 1 else value
