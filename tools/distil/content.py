"""Distillation of the content encoder: a slim network learns the principal components of normalised VGG-19
relu2_1.

The components are those of guided-filtered features, which is what scenes learn; the student imitates the raw
ones. Components are accumulated in float64.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from fprf.errors import UsageError
from fprf.interfaces import Encoder
from fprf.ops.backend import double
from fprf.plugins.encoders.bundled import CONTENT_KIND, ContentStudent, load_content_encoder
from fprf.plugins.encoders.config import Vgg19Config
from fprf.plugins.weights import write_weights
from fprf.pretraining.loop import generator_of, train
from fprf.pretraining.photos import filtered_at, filtered_whole, find_photos, load_photo, random_pixels, split
from fprf.training.prepare import device_of

from .config import DistilConfig
from .examples import crop, prepared, prepared_path, toned


@dataclass(frozen=True, kw_only=True)
class Basis:
    """y = (x - mean) @ axes.T / scale. One scale for all channels: distances keep their proportions."""

    mean: Annotated[Tensor, "F"]
    axes: Annotated[Tensor, "C F"]
    """Orthonormal rows, most energy first."""
    scale: float
    """Makes the mean variance per channel 1."""
    kept: float
    """Share of the centred energy on the axes."""

    def project(self, x: Annotated[Tensor, "B F h w"]) -> Annotated[Tensor, "B C h w"]:
        """Feature maps on the axes."""
        centred = x - self.mean.to(x).view(1, -1, 1, 1)
        return torch.einsum("cf,bfhw->bchw", self.axes.to(x) / self.scale, centred)


def fit_basis(samples: Annotated[Tensor, "N F"], choices: tuple[int, ...], energy: float) -> Basis:
    """The fewest channels among `choices` that keep `energy` of the centred variance (or the most, if none
    does).
    """
    x = double(samples)
    mean = x.mean(0)
    centred = x - mean
    values, vectors = torch.linalg.eigh(centred.T @ centred / len(x))
    values = values.flip(0).clamp_min(0)
    vectors = vectors.flip(1)
    shares = values.cumsum(0) / values.sum()
    enough = [n for n in sorted(choices) if n <= len(values) and float(shares[n - 1]) >= energy]
    channels = enough[0] if enough else min(max(choices), len(values))
    axes = vectors[:, :channels].T
    axes = axes * axes.sum(1, keepdim=True).sign()  # eigenvectors have no sign of their own
    return Basis(
        mean=mean.float(),
        axes=axes.float(),
        scale=float((values[:channels].mean()).sqrt()),
        kept=float(shares[channels - 1]),
    )


CHOICES = (24, 32, 48)
ENERGY = 0.99
BASIS_PHOTOS = 60
BASIS_PIXELS = 1000
SCALES = (0.6, 1.5)
"""Crops are that much larger or smaller than the photograph."""
REPORT_PHOTOS = 16
Report = dict[str, float | int | str]


def pretrain_content(config: DistilConfig, output: Path, say: Callable[[str], None]) -> Report:
    """Train, write `output`, and measure it on held-out photographs."""
    if len(config.teachers) != 1:
        raise UsageError(
            f"--teachers: {len(config.teachers)} files; `content` takes one, the weights of VGG-19"
        )
    device = device_of(config.device)
    teacher = Vgg19Config(weights=config.teachers[0]).build().to(device)
    photos, held = split(find_photos(config.images)[: config.photos])
    say(f"{len(photos)} photographs to learn from, {len(held)} held out")
    basis = content_basis(teacher, photos[:BASIS_PHOTOS], config.seed, device)
    say(f"{len(basis.axes)} channels keep {100 * basis.kept:.2f} % of the filtered energy")
    images, targets = prepared(lambda: _crops(teacher, basis, photos, config, device), config, output)
    say(f"{len(images)} crops prepared")

    torch.manual_seed(config.seed)
    student = ContentStudent(len(basis.axes)).to(device)

    def loss(generator: torch.Generator) -> Tensor:
        index = torch.randint(0, len(images), (config.batch,), generator=generator)
        return F.mse_loss(student(images[index].to(device).float() / 255), targets[index].to(device).float())

    steps = train(student, loss, config, output, say)
    metadata = {
        "kind": CONTENT_KIND,
        "imitates": f"{len(basis.axes)} principal components of {teacher.identity}",
        "made_by": f"python -m tools.distil content, {steps} steps on {len(photos)} photographs, seed {config.seed}",
        "licence": "Apache-2.0; trained by this project, holds no weights of its teacher",
    }
    write_weights(output, {name: value.half() for name, value in student.state_dict().items()}, metadata)
    report = content_report(
        load_content_encoder(output).to(device), teacher, basis, held[:REPORT_PHOTOS], device
    )
    prepared_path(output).unlink(missing_ok=True)
    return {"steps": steps, "channels": len(basis.axes), "energy_kept": round(basis.kept, 5), **report}


def content_basis(
    teacher: Encoder, photos: Sequence[Path], seed: int, device: torch.device | None = None
) -> Basis:
    """Principal components of the teacher's guided-filtered features."""
    samples = []
    for index, path in enumerate(photos):
        photo = load_photo(path).to(device)
        pixels = random_pixels(photo, BASIS_PIXELS, generator_of(seed, index))
        samples.append(filtered_at(teacher, photo, pixels)[0])
    return fit_basis(torch.cat(samples), CHOICES, ENERGY)


def content_report(
    student: Encoder,
    teacher: Encoder,
    basis: Basis,
    photos: Sequence[Path],
    device: torch.device | None = None,
) -> Report:
    """Relative L2 error of the student against its projected teacher, raw and guided-filtered, over whole
    photographs.
    """
    error = torch.zeros(2, dtype=torch.float64)
    energy = torch.zeros(2, dtype=torch.float64)
    projected = _Projected(teacher, basis)
    for path in photos:
        photo = load_photo(path).to(device)
        image = photo.permute(2, 0, 1)[None]
        pairs = [
            (student(image), projected(image)),
            (filtered_whole(student, photo), filtered_whole(projected, photo)),
        ]
        for row, (found, wanted) in enumerate(pairs):
            error[row] += double(found - wanted).square().mean().cpu()
            energy[row] += double(wanted).square().mean().cpu()
    raw, filtered = (error / energy).sqrt().tolist()
    return {"photos": len(photos), "relative_l2": round(raw, 4), "relative_l2_filtered": round(filtered, 4)}


class _Projected(Encoder):
    """The teacher, projected."""

    def __init__(self, teacher: Encoder, basis: Basis) -> None:
        super().__init__()
        self.teacher = teacher
        self.basis = basis

    @property
    def identity(self) -> str:
        return f"{self.teacher.identity}:projected"

    @property
    def channels(self) -> int:
        return len(self.basis.axes)

    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B C h w"]:
        return self.basis.project(self.teacher(image))


@torch.no_grad()
def _crops(
    teacher: Encoder, basis: Basis, photos: Sequence[Path], config: DistilConfig, device: torch.device
) -> tuple[Annotated[Tensor, "N 3 s s"], Annotated[Tensor, "N C t t"]]:
    """Crops as bytes and their targets in half precision; some darker, flatter or tinted, as night scenes
    are.
    """
    images = []
    targets = []
    for index, path in enumerate(photos):
        generator = generator_of(config.seed + 1, index)
        photo = load_photo(path)
        batch = torch.stack(
            [toned(crop(photo, config.size, SCALES, generator), generator) for _ in range(config.crops)]
        )
        batch = (batch * 255).round()
        images.append(batch.byte())
        targets.append(basis.project(teacher((batch / 255).to(device))).half().cpu())
    return torch.cat(images), torch.cat(targets)
